"""Whether the tracker sees the target: beam and incidence."""

from dataclasses import dataclass

import numpy as np

from hilcal.cell import tracker_place
from hilcal.config import Obstacle
from hilcal.measuring.clearance import TOOL_RADIUS, Clearance
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.robot.scene import Segment
from hilcal.robot.segments import segment_distance
from hilcal.types import Bools, Floats

UNKNOWN = (
    "the tracker's place is not known: whether it sees the target is not checked; give [sight] "
    "tracker_m"
)
_SHY = 1.5  # the beam ends so many radii of tool and beam before the target


@dataclass(frozen=True, slots=True, eq=False)
class LineOfSight:
    """The tracker's view of the target.

    Attributes:
        clearance: the cell's shapes.
        tracker: (3,) where the tracker stands, base axes, m.
    """

    clearance: Clearance
    tracker: Floats

    def free(self, q: Floats, load: str) -> Bools:
        """Return (N,) in which states nothing is closer to a beam than [sight] clearance_m.

        There is a beam to each target; all of them have to be free. A beam ends shortly before
        its target. Not in its way are the way from the flange to the target and what else of the
        tool is next to it, whose shape is not known, and obstacles that the tracker stands in or
        on.
        """
        targets = range(len(self.clearance.cell.all_targets))
        return np.asarray(np.all([self.sees(q, load, k) for k in targets], axis=0))

    def sees(self, q: Floats, load: str, target: int) -> Bools:
        """Return (N,) in which states the beam to one target is free."""
        beam = self.beam(q, target)
        out = ~self.clearance.scene.free.touching(q, 0.0, beam)
        for other in self.clearance.segments(q, load):
            gap = segment_distance(beam.start, beam.end, other.start, other.end)
            out &= gap > beam.radius + other.radius
        return np.asarray(out)

    def incidence(self, q: Floats) -> Floats | None:
        """Return (N,) angles between the reflectors' normal and the beam, the largest, rad.

        None where [sight] target_normal is not given.
        """
        normal = self.clearance.config.sight.target_normal
        if normal is None:
            return None
        chain = chains.evaluate(self.clearance.cell.arm, q)
        looks = se3.apply(chain.rotation[-1], np.array(normal) / np.linalg.norm(normal))
        out = []
        for target in self.clearance.cell.all_targets:
            way = self.tracker - chain.point(target[:3, 3])
            along = np.sum(looks * way, axis=1)
            out.append(np.arctan2(np.linalg.norm(se3.cross(looks, way), axis=1), along))
        return np.asarray(np.max(out, axis=0))

    def problems(self, q: Floats, load: str, where: str) -> list[str]:
        """Return why the tracker would not see the target in one state (1, n)."""
        out = []
        most = self.clearance.config.sight.incidence_max_rad
        angle = self.incidence(q)
        if angle is not None and float(angle.max()) > most:
            out.append(
                f"{where}: the beam meets the reflector at {float(angle.max()):.3g} rad; [sight] "
                f"incidence_max_rad is {most:g}"
            )
        hidden = self.hidden(q, load)
        if len(hidden) == len(self.clearance.cell.all_targets):  # a hidden one is a reading less
            found = self.clearance.scene.free.named(q, 0.0, self.beam(q))
            names = tuple(dict.fromkeys(name for name, _ in found))
            names += tuple(x.name for x in self.clearance.segments(q, load) if not names)
            what = "target" if len(hidden) == 1 else "targets"
            out.append(f"{where}: {' and '.join(names)} between tracker and {what}")
        return out

    def hidden(self, q: Floats, load: str) -> tuple[int, ...]:
        """Return the numbers of the targets that the tracker does not see in one state (1, n)."""
        targets = range(len(self.clearance.cell.all_targets))
        return tuple(k for k in targets if not self.sees(q, load, k).all())

    def beam(self, q: Floats, number: int = 0) -> Segment:
        """Return the beam to a target in N states (N, n)."""
        config, cell = self.clearance.config, self.clearance.cell
        radius = config.sight.clearance_m
        offset = cell.all_targets[number, :3, 3]
        target = chains.evaluate(cell.arm, q).point(offset)
        way = target - self.tracker
        length = np.linalg.norm(way, axis=1, keepdims=True)
        gap = np.minimum(_SHY * (TOOL_RADIUS + radius), 0.5 * length)
        end = target - gap * way / np.where(length > 0.0, length, 1.0)
        start = np.broadcast_to(self.tracker, end.shape)
        stands = [x.name for x in config.obstacles if _holds(x, self.tracker, radius)]
        near = self.clearance.near(offset, radius)
        return Segment("beam", start, end, max(radius, 1e-4), near.union(stands))


def sight_of(clearance: Clearance) -> LineOfSight | None:
    """Return the tracker's view; None where its place is not known."""
    place = tracker_place(clearance.cell, clearance.config)
    return None if place is None else LineOfSight(clearance, place)


def _holds(thing: Obstacle, point: Floats, margin: float) -> bool:
    """Whether a point is in an obstacle, or closer to it than `margin` along each axis."""
    if thing.center_m is not None and thing.size_m is not None:
        off = np.abs(point - np.array(thing.center_m)) - 0.5 * np.array(thing.size_m)
        return bool(np.all(off <= margin))
    if thing.bottom_m is None or thing.radius_m is None or thing.height_m is None:
        return False
    off = point - np.array(thing.bottom_m)
    upright = -margin <= off[2] <= thing.height_m + margin
    return bool(upright and np.hypot(off[0], off[1]) <= thing.radius_m + margin)
