"""What moves in the 3-D view of a plan: the arm with its load and the beam at every step."""

import numpy as np
import rerun as rr

from hilcal.present.plan import load_name
from hilcal.present.viewer import arm_shapes, plan_cell, plan_style, style
from hilcal.present.viewer.digest import quaternions_of
from hilcal.present.viewer.plan_digest import SEEN, PlanDigest
from hilcal.types import Floats

_FORCE_LENGTH = 0.35  # the strongest pull is drawn this long, m
_LABEL_ABOVE = 0.24  # m
_DIM = 0.42  # of a colour: lines have no transparency
_PARTS = ("capsules", "arrow")


def step_scene(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Send what changes with every step, as columns on `step`."""
    time = [rr.TimeColumn("step", sequence=d.numbers)]
    for i in range(1, d.bodies.shape[1] - 1):
        rec.send_columns(
            f"world/arm/body{i}",
            indexes=time,
            columns=rr.Transform3D.columns(
                translation=d.bodies[:, i, :3, 3],
                quaternion=quaternions_of(d.bodies[:, i, :3, :3]),
            ),
        )
    colors = plan_style.load_colors(d.loads)[d.load]
    rec.send_columns(
        "world/target/now",
        indexes=time,
        columns=rr.Points3D.columns(
            positions=d.target, colors=colors, radii=np.full(len(d), 1.7 * plan_cell.BEAD * d.reach)
        ),
    )
    _label(rec, d, time)
    if d.tracker is not None:
        _beam(rec, d, time, d.tracker)
    _loads(rec, d)
    _ways(rec, d, time)


def framed(d: PlanDigest) -> tuple[Floats, float]:
    """Middle of what should be in the picture and its half size, m; a far tracker counts less."""
    reach = d.reach
    points = [np.zeros((1, 3)), d.target]
    if d.tracker is not None:
        far = float(np.linalg.norm(d.tracker))
        points.append((d.tracker * min(1.0, 1.6 * reach / max(far, 1e-9)))[None])
    lo, hi = np.vstack(points).min(0), np.vstack(points).max(0)
    return (lo + hi) / 2, max(float(np.linalg.norm(hi - lo)) / 2, 0.35 * reach)


def pull_arrow(d: PlanDigest, name: str) -> Floats | None:
    """(3,) the arrow of a load's pull as drawn, m; None where it has none."""
    forces = {x.name: np.array(x.force_N) for x in d.config.loads}
    most = max((float(np.linalg.norm(f)) for f in forces.values()), default=0.0)
    force = forces.get(name)
    if force is None or not force.any():
        return None
    return np.asarray(_FORCE_LENGTH * force / most)


def _beam(rec: rr.RecordingStream, d: PlanDigest, time: list[rr.TimeColumn], place: Floats) -> None:
    strips = np.stack([np.broadcast_to(place, d.target.shape), d.target], 1)
    colors = plan_style.sight_colors(d.sight)
    rec.send_columns(
        "world/beam",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=strips, colors=colors, radii=np.full(len(d), 0.004 * d.reach)
        ),
    )


def _label(rec: rr.RecordingStream, d: PlanDigest, time: list[rr.TimeColumn]) -> None:
    above = d.target + np.array([0.0, 0.0, _LABEL_ABOVE])
    above[:, 2] += d.rank.max(initial=0) * plan_cell.BEAD_GAP * d.reach
    words = [
        style.safe(f"{k}: {s.pose}, {load_name(s.load)}{_sight_words(d, k - 1)}")
        for k, s in enumerate(d.plan.steps, start=1)
    ]
    rec.send_columns(
        "world/label",
        indexes=time,
        columns=rr.Points3D.columns(
            positions=above + np.array([0.0, 0.0, 0.25 * _LABEL_ABOVE]),
            labels=words,
            colors=np.tile(np.array(style.LABEL, dtype=np.uint8), (len(d), 1)),
            radii=np.full(len(d), 1e-4),
            show_labels=[True] * len(d),
        ),
    )
    rec.send_columns(
        "world/label/leader",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=np.stack([d.target, above], 1),
            colors=plan_style.sight_colors(d.sight),
            radii=np.full(len(d), 0.0012 * d.reach),
        ),
    )


def _sight_words(d: PlanDigest, step: int) -> str:
    sight = int(d.sight[step])
    return f": {plan_style.SIGHT_WORDS[sight]}" if d.unseen[step] or sight == SEEN else ""


def _loads(rec: rr.RecordingStream, d: PlanDigest) -> None:
    """Log what hangs or pulls, at the steps where there is some; cleared where there is none."""
    colors = plan_style.load_colors(d.loads)
    for k, name in enumerate(d.loads):
        steps = np.flatnonzero(d.load == k)
        hung = d.shapes.segments(d.plan.q[d.pose[steps]], name)
        arrow = pull_arrow(d, name)
        for i, step in enumerate(steps.tolist()):
            rec.set_time("step", sequence=step + 1)
            if hung:
                start = np.array([x.start[i] for x in hung])
                end = np.array([x.end[i] for x in hung])
                radius = np.array([x.radius for x in hung])
                rec.log(
                    f"world/load/{_PARTS[0]}", arm_shapes.capsules(start, end, radius, [colors[k]])
                )
            if arrow is not None:
                rec.log(
                    f"world/load/{_PARTS[1]}",
                    rr.Arrows3D(
                        origins=[d.hook[step]],
                        vectors=[arrow],
                        colors=[colors[k]],
                        radii=[0.006 * d.reach],
                    ),
                )
            for part, there in zip(_PARTS, (bool(hung), arrow is not None), strict=True):
                if not there:
                    rec.log(f"world/load/{part}", rr.Clear(recursive=False))
    rec.reset_time()


def _ways(rec: rr.RecordingStream, d: PlanDigest, time: list[rr.TimeColumn]) -> None:
    """Log the target's whole way under the load of the step, and bright the last motion."""
    colors = plan_style.load_colors(d.loads)
    rec.send_columns(
        "world/way/last",
        indexes=time,
        columns=rr.LineStrips3D.columns(
            strips=list(d.ways),
            colors=colors[d.load],
            radii=np.full(len(d), 0.0022 * d.reach),
        ),
    )
    for start, end in d.stints:
        rec.set_time("step", sequence=start + 1)
        rec.log(
            "world/way/whole",
            rr.LineStrips3D(
                [np.vstack(d.ways[start:end])],
                colors=[(_DIM * colors[d.load[start]]).astype(np.uint8)],
                radii=rr.Radius.ui_points(0.6),
            ),
        )
    rec.reset_time()
