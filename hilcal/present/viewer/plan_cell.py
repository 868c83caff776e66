"""What stands still in the 3-D view of a plan: the arm's shapes, the cell, a bead per reading."""

import numpy as np
import rerun as rr

from hilcal.config import Obstacle
from hilcal.present.viewer import arm_shapes, plan_style, style
from hilcal.present.viewer.plan_digest import PlanDigest
from hilcal.robot import body
from hilcal.types import Floats, Ints

BEAD, BEAD_GAP = 0.0075, 0.016
"""Radius of a bead and distance of two in a stack, shares of the reach."""
_OBSTACLE = (122, 112, 104)
_SOLID = 90  # of 255: what stands behind an obstacle shows through
_BOX = (64, 82, 108)
_TRACKER = (235, 235, 240)
_HEAD = 0.07  # m, of the drawn tracker


def static_scene(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Log what never changes: shapes of the arm, what stands around, and a bead per reading."""
    rec.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    own = len(body.capsules(d.cell.arm))
    arm_shapes.log_bodies(rec, d.shapes.scene.parts[:own], d.shapes.scene.parts[own:])
    _obstacles(rec, d.config.obstacles)
    _workspace(rec, d)
    _beads(rec, d)
    if d.tracker is not None:
        _tracker(rec, d.tracker)


def bead_places(d: PlanDigest, steps: Ints) -> Floats:
    """(K, 3) where the beads of some steps are: stacked upwards from the target, m."""
    up = np.zeros((len(steps), 3))
    up[:, 2] = d.rank[steps] * BEAD_GAP * d.reach
    return np.asarray(d.target[steps] + up)


def _obstacles(rec: rr.RecordingStream, things: tuple[Obstacle, ...]) -> None:
    boxes = [x for x in things if x.center_m is not None]
    if boxes:
        for part, mode, alpha in (("body", "solid", _SOLID), ("edge", "majorwireframe", 255)):
            rec.log(
                f"world/obstacles/box/{part}",
                rr.Boxes3D(
                    centers=[x.center_m or () for x in boxes],
                    sizes=[x.size_m or () for x in boxes],
                    colors=[(*_OBSTACLE, alpha)],
                    fill_mode=mode,  # type: ignore[arg-type]
                ),
                static=True,
            )
    stood = [x for x in things if x.bottom_m is not None]
    if stood:
        bottom = np.array([x.bottom_m for x in stood])
        height = np.array([x.height_m for x in stood], dtype=float)
        rec.log(
            "world/obstacles/cylinder",
            rr.Cylinders3D(
                centers=bottom + 0.5 * height[:, None] * [0.0, 0.0, 1.0],
                lengths=height,
                radii=[x.radius_m or 0.0 for x in stood],
                colors=[(*_OBSTACLE, _SOLID)],
                fill_mode="solid",
            ),
            static=True,
        )
    if things:
        rec.log(
            "world/obstacles/names",
            rr.Points3D(
                [_named_at(x) for x in things],
                labels=[style.safe(x.name) for x in things],
                colors=[style.LABEL],
                radii=[1e-4],
                show_labels=True,
            ),
            static=True,
        )


def _named_at(thing: Obstacle) -> Floats:
    """(3,) where an obstacle's name is written: on its top, or on a flat one's front edge."""
    if thing.center_m is not None and thing.size_m is not None:
        center, half = np.array(thing.center_m), 0.5 * np.array(thing.size_m)
        flat = half[2] < 0.5 * min(half[:2])
        return np.asarray(center + half * ([0.7, -0.7, 1.0] if flat else [0.0, 0.0, 1.0]))
    up = np.array([0.0, 0.0, thing.height_m or 0.0])
    return np.asarray(np.array(thing.bottom_m) + up)


def _workspace(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Log the outline of every side of the workspace that is given."""
    limits = d.config.limits
    reach = 1.1 * d.reach
    low = np.array(limits.workspace_min_m or (-reach, -reach, 0.0), dtype=float)
    high = np.array(limits.workspace_max_m or (reach, reach, reach), dtype=float)
    low, high = np.minimum(low, high), np.maximum(low, high)
    sides = []
    for given, at in ((limits.workspace_min_m, low), (limits.workspace_max_m, high)):
        for axis in range(3) if given is not None else ():
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = np.tile(at, (5, 1))
            corners[:, a] = [low[a], high[a], high[a], low[a], low[a]]
            corners[:, b] = [low[b], low[b], high[b], high[b], low[b]]
            sides.append(corners)
    if sides:
        rec.log(
            "world/workspace",
            rr.LineStrips3D(sides, colors=[_BOX], radii=rr.Radius.ui_points(0.6)),
            static=True,
        )


def _beads(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Log a bead per pose and load, and a cage around those that the tracker does not see."""
    steps = d.beads
    rec.log(
        "world/target/beads",
        rr.Points3D(
            bead_places(d, steps),
            colors=plan_style.load_colors(d.loads)[d.load[steps]],
            radii=BEAD * d.reach,
        ),
        static=True,
    )
    lost = steps[d.unseen[steps]]
    if len(lost):
        rec.log(
            "world/target/unseen",
            rr.Ellipsoids3D(
                centers=bead_places(d, lost),
                half_sizes=np.full((len(lost), 3), 1.9 * BEAD * d.reach),
                colors=plan_style.sight_colors(d.sight[lost]),
                fill_mode="majorwireframe",
                line_radii=rr.Radius.ui_points(0.5),
            ),
            static=True,
        )


def _tracker(rec: rr.RecordingStream, place: Floats) -> None:
    up = np.array([0.0, 0.0, 1.0])
    rec.log(
        "world/tracker",
        arm_shapes.capsules(
            (place - 1.2 * _HEAD * up)[None],
            (place + 0.2 * _HEAD * up)[None],
            np.array([_HEAD]),
            [_TRACKER],
        ),
        static=True,
    )
    rec.log(
        "world/tracker/name",
        rr.Points3D(
            [place + 2.2 * _HEAD * up],
            labels=["tracker"],
            colors=[style.LABEL],
            radii=[1e-4],
            show_labels=True,
        ),
        static=True,
    )
