"""Shapes that must not touch or hide the target: arm, tool, obstacles, hanging loads, cables."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.cell import Cell, tracker_place
from hilcal.config import CellLoad, Obstacle
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.robot.scene import Capsule, Scene, Segment, flange_capsule, on_flange
from hilcal.types import Bools, Floats

TOOL_RADIUS = 0.03
"""Radius of the capsules from flange to target and load point, m: a plate or a reflector's nest."""
CABLE_RADIUS = 0.01  # of a cable, m
_NEAR = 0.02  # gap that counts as touching, m
_AT_TARGET, _AT_LOAD = "tool at the target", "tool at the load point"
_TINY = 1e-18  # m², below which a segment is a point


class Clearance:
    """The cell's shapes, base axes, m."""

    def __init__(self, cell: Cell) -> None:
        """Build the shapes once."""
        config = cell.configured()
        self.cell, self.config = cell, config
        self.scene = Scene(cell.arm, _tool(cell), config.obstacles)
        # names of the shapes that touch the load point, by the radius of the load or cable, m
        radii = {CABLE_RADIUS, *(load.radius_m for load in config.loads)}
        self._at_hook = {radius: self.shapes_touching(cell.load_point, radius) for radius in radii}

    @cached_property
    def sight(self) -> "LineOfSight | None":
        """The tracker's view; None where its place is unknown."""
        place = tracker_place(self.cell)
        return None if place is None else LineOfSight(self, place)

    def load(self, name: str) -> CellLoad | None:
        """Return a load by name; None for "none" and unknown names."""
        return next((load for load in self.config.loads if load.name == name), None)

    def segments(self, q: Floats, load: str) -> tuple[Segment, ...]:
        """Return hanging load and cable in N states (N, n)."""
        if self.load(load) is None:
            return ()
        chain = chains.evaluate(self.cell.arm, q)
        return self.segments_at(chain.point(self.cell.load_point), load)

    def segments_at(self, points: Floats, load: str) -> tuple[Segment, ...]:
        """Return hanging load and cable at N load points (N, 3), base axes, m.

        A weight is an upright capsule below the load point (along gravity); the cable of a pull has
        the pull's direction. Shapes that are always close to the load point may touch them, as the
        shape of the hook is unknown.
        """
        hung = self.load(load)
        if hung is None:
            return ()
        out = []
        gravity, force = self.cell.gravity, np.asarray(hung.force_N)
        if hung.hanging_m > 0.0 and gravity.any():
            down, length = gravity / np.linalg.norm(gravity), hung.hanging_m
            rim = min(hung.radius_m, 0.5 * length)
            ends = points + rim * down, points + (length - rim) * down
            near = self._at_hook[hung.radius_m]
            out.append(Segment(f"what hangs ({load})", *ends, hung.radius_m, near))
        if hung.cable_m > 0.0:
            end = points + hung.cable_m * force / np.linalg.norm(force)
            near = self._at_hook[CABLE_RADIUS]
            out.append(Segment(f"the cable ({load})", points, end, CABLE_RADIUS, near))
        return tuple(out)

    def shapes_touching(self, point: Floats, radius: float) -> frozenset[str]:
        """Return names of the shapes on the flange that touch a point (3,), flange axes, m."""
        arm = self.cell.arm
        centre = on_flange(arm, point)
        return frozenset(
            part.name
            for part in self.scene.parts
            if part.body == arm.n
            and segment_distance(centre, centre, part.start, part.end)
            < part.radius + radius + _NEAR
        )


def _tool(cell: Cell) -> tuple[Capsule, ...]:
    """Return capsules from the flange to load point and targets, rough positions included."""
    names = [f" {name}" for name in cell.target_names] or [""]
    places = zip(names, cell.all_targets, strict=True)
    ends = [(_AT_LOAD, cell.load_point), *((_AT_TARGET + x, at[:3, 3]) for x, at in places)]
    flange = np.zeros(3)
    return tuple(
        flange_capsule(cell.arm, name, flange, end, TOOL_RADIUS) for name, end in ends if end.any()
    )


TRACKER_UNKNOWN = (
    "the tracker's place is not known: whether it sees the target is not checked; give [sight] "
    "tracker_m"
)
_BEAM_END = 1.5  # distance from the end of the beam to the target, over the radii of tool and beam


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSight:
    """The tracker's view of the target."""

    clearance: Clearance  # the cell's shapes
    tracker: Floats  # (3,) place of the tracker, base axes, m

    def unobstructed(self, q: Floats, load: str) -> Bools:
        """Return (N,) whether all shapes keep [sight] clearance_m from every beam.

        A beam ends shortly before its target. Ignored are parts of the tool next to the target,
        whose shape is unknown, and obstacles that the tracker stands in or on.
        """
        count = len(self.clearance.cell.all_targets)
        return np.asarray(np.all([self.target_visible(q, load, k) for k in range(count)], axis=0))

    def target_visible(self, q: Floats, load: str, target: int) -> Bools:
        """Return (N,) whether the beam to one target is free."""
        beam = self.beam(q, target)
        out = ~self.clearance.scene.segment_pairs.touching(q, 0.0, beam)
        for hung in self.clearance.segments(q, load):
            gap = segment_distance(beam.start, beam.end, hung.start, hung.end)
            out &= gap > beam.radius + hung.radius
        return np.asarray(out)

    def incidence(self, q: Floats) -> Floats | None:
        """Return the largest angles (N,) of beam and reflector normal, rad; None without one."""
        normal = self.clearance.config.sight.target_normal
        if normal is None:
            return None
        chain = chains.evaluate(self.clearance.cell.arm, q)
        normals = se3.apply(chain.rotation[-1], np.array(normal) / np.linalg.norm(normal))
        out = []
        for target in self.clearance.cell.all_targets:
            way = self.tracker - chain.point(target[:3, 3])
            along = np.sum(normals * way, axis=1)
            out.append(np.arctan2(np.linalg.norm(se3.cross(normals, way), axis=1), along))
        return np.asarray(np.max(out, axis=0))

    def problems(self, q: Floats, load: str, where: str) -> list[str]:
        """Return why the tracker does not see the target in one state (1, n)."""
        out = []
        most = self.clearance.config.sight.incidence_max_rad
        angle = self.incidence(q)
        if angle is not None and float(angle.max()) > most:
            out.append(
                f"{where}: the beam meets the reflector at {float(angle.max()):.3g} rad; [sight] "
                f"incidence_max_rad is {most:g}"
            )
        hidden, targets = self.hidden_targets(q, load), self.clearance.cell.all_targets
        if len(hidden) == len(targets):  # some hidden targets only cost readings
            hits = self.clearance.scene.segment_pairs.close_pairs(q, 0.0, self.beam(q))
            names = tuple(dict.fromkeys(name for name, _ in hits))
            names += tuple(x.name for x in self.clearance.segments(q, load) if not names)
            noun = "target" if len(hidden) == 1 else "targets"
            out.append(f"{where}: {' and '.join(names)} between tracker and {noun}")
        return out

    def hidden_targets(self, q: Floats, load: str) -> tuple[int, ...]:
        """Return the indices of the targets that are hidden in one state (1, n)."""
        count = len(self.clearance.cell.all_targets)
        return tuple(k for k in range(count) if not self.target_visible(q, load, k).all())

    def beam(self, q: Floats, number: int = 0) -> Segment:
        """Return the beam to a target in N states (N, n)."""
        config, cell = self.clearance.config, self.clearance.cell
        radius, offset = config.sight.clearance_m, cell.all_targets[number, :3, 3]
        target = chains.evaluate(cell.arm, q).point(offset)
        way = target - self.tracker
        length = np.linalg.norm(way, axis=1, keepdims=True)
        gap = np.minimum(_BEAM_END * (TOOL_RADIUS + radius), 0.5 * length)
        end = target - gap * way / np.where(length > 0.0, length, 1.0)
        start = np.broadcast_to(self.tracker, end.shape)
        stands = [x.name for x in config.obstacles if contains(x, self.tracker, radius)]
        near = self.clearance.shapes_touching(offset, radius)
        return Segment("beam", start, end, max(radius, 1e-4), near.union(stands))


def contains(obstacle: Obstacle, points: Floats, margin: float = 0.0) -> Bools:
    """Return which points (..., 3) are inside of an obstacle enlarged by `margin`, m."""
    if obstacle.center_m is not None and obstacle.size_m is not None:
        off = np.abs(points - np.array(obstacle.center_m)) - 0.5 * np.array(obstacle.size_m)
        return np.asarray(np.all(off <= margin, axis=-1))
    if obstacle.bottom_m is None or obstacle.radius_m is None or obstacle.height_m is None:
        return np.zeros(points.shape[:-1], dtype=np.bool_)
    off = points - np.array(obstacle.bottom_m)
    upright = (off[..., 2] >= -margin) & (off[..., 2] <= obstacle.height_m + margin)
    return np.asarray(upright & (np.hypot(off[..., 0], off[..., 1]) <= obstacle.radius_m + margin))


def segment_distance(a: Floats, b: Floats, c: Floats, d: Floats) -> Floats:
    """Return (N,) least distances of the segments ab and cd, points (N, 3) or (3,), m.

    Ericson 2005, Real-Time Collision Detection, section 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv = _dot(u, u), _dot(v, v), _dot(u, v)
    ur, vr = _dot(u, r), _dot(v, r)
    det = uu * vv - uv * uv
    crossed = det > 1e-12 * uu * vv  # not parallel
    s = np.clip(np.where(crossed, (uv * vr - ur * vv) / np.where(crossed, det, 1.0), 0.0), 0.0, 1.0)
    t = np.clip((uv * s + vr) / np.where(vv > _TINY, vv, 1.0), 0.0, 1.0)
    s = np.clip((uv * t - ur) / np.where(uu > _TINY, uu, 1.0), 0.0, 1.0)
    gap = r + s[..., None] * u - t[..., None] * v
    return np.asarray(np.linalg.norm(gap, axis=-1))


def _dot(a: Floats, b: Floats) -> Floats:
    return np.asarray(np.sum(a * b, axis=-1))
