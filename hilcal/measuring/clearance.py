"""What must not touch: the arm, its tool, obstacles, hanging loads and cables."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, Load
from hilcal.robot import chain as chains
from hilcal.robot.body import Capsule, flange_capsule
from hilcal.robot.scene import Scene, Segment, on_flange
from hilcal.robot.segments import segment_distance
from hilcal.types import Floats

TOOL_RADIUS = 0.03
"""Radius of the ways from flange to target and load point, m: a plate or a reflector's nest."""
CABLE_RADIUS = 0.01
"""Radius that is kept for a cable, m."""
_NEAR = 0.02  # m, beyond touching
_AT_TARGET, _AT_LOAD = "tool at the target", "tool at the load point"


@dataclass(frozen=True, slots=True, eq=False)
class Clearance:
    """The cell's shapes. Base axes, m; `clearance_of` makes it.

    Attributes:
        cell: the cell.
        config: its obstacles and loads.
        scene: the arm with its tool among the obstacles.
    """

    cell: Cell
    config: CellConfig
    scene: Scene
    _at_hook: dict[float, frozenset[str]] = field(init=False, repr=False)
    """What is as good as touched at the load point, by the radius of what is there, m."""

    def __post_init__(self) -> None:
        """Find what is at the load point, which is the same in every state."""
        radii = {CABLE_RADIUS, *(load.radius_m for load in self.config.loads)}
        found = {radius: self.near(self.cell.load_point, radius) for radius in radii}
        object.__setattr__(self, "_at_hook", found)

    def load(self, name: str) -> Load | None:
        """Return a load by name; None unloaded, and for a name that the cell lacks."""
        return next((load for load in self.config.loads if load.name == name), None)

    def segments(self, q: Floats, load: str) -> tuple[Segment, ...]:
        """Return what hangs or pulls at the load point in N states (N, n)."""
        if self.load(load) is None:
            return ()
        chain = chains.evaluate(self.cell.arm, q)
        return self.segments_at(chain.point(self.cell.load_point), load)

    def segments_at(self, at: Floats, load: str) -> tuple[Segment, ...]:
        """Return what hangs or pulls at the load point where that is (N, 3), base axes, m.

        A weight takes an upright capsule of the length hang_m below the load point (along
        gravity), a pull's cable goes in the pull's direction. What the flange carries, and the
        last body, may touch them where they are so close to the load point that they always do:
        the shape of the hook there is not known.
        """
        known = self.load(load)
        if known is None:
            return ()
        out = []
        gravity, force = self.cell.gravity, np.asarray(known.force_N)
        if known.hanging_m > 0.0 and gravity.any():
            down, long = gravity / np.linalg.norm(gravity), known.hanging_m
            rim = min(known.radius_m, 0.5 * long)
            ends = at + rim * down, at + (long - rim) * down
            near = self._at_hook[known.radius_m]
            out.append(Segment(f"what hangs ({load})", *ends, known.radius_m, near))
        if known.cable_m > 0.0:
            end = at + known.cable_m * force / np.linalg.norm(force)
            near = self._at_hook[CABLE_RADIUS]
            out.append(Segment(f"the cable ({load})", at, end, CABLE_RADIUS, near))
        return tuple(out)

    def near(self, point: Floats, radius: float) -> frozenset[str]:
        """Return what moves with the flange and is as good as touched at a point of it.

        Args:
            point: (3,) flange axes, m.
            radius: of what is there, m.
        """
        arm = self.cell.arm
        at = on_flange(arm, point)
        return frozenset(
            part.name
            for part in self.scene.parts
            if part.body == arm.n
            and segment_distance(at, at, part.start, part.end) < part.radius + radius + _NEAR
        )


def clearance_of(cell: Cell, config: CellConfig) -> Clearance:
    """Return the shapes of a cell."""
    return Clearance(cell, config, Scene(cell.arm, _tool(cell), config.obstacles))


def _tool(cell: Cell) -> tuple[Capsule, ...]:
    """The ways from flange to load point and targets; a rough place counts as well."""
    names = [f" {name}" for name in cell.target_names] or [""]
    places = zip(names, cell.all_targets, strict=True)
    ways = [(_AT_LOAD, cell.load_point), *((_AT_TARGET + x, at[:3, 3]) for x, at in places)]
    flange = np.zeros(3)
    return tuple(
        flange_capsule(cell.arm, name, flange, end, TOOL_RADIUS) for name, end in ways if end.any()
    )
