"""What must not touch: the arm, its tool, obstacles, hanging loads and cables."""

from dataclasses import dataclass

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig, Load
from hilcal.data.plan import UNLOADED
from hilcal.robot import chain as chains
from hilcal.robot.body import Capsule, flange_capsule
from hilcal.robot.scene import Scene, Segment
from hilcal.robot.segments import segment_distance
from hilcal.types import Bools, Floats

TOOL_RADIUS = 0.03
"""Radius of the ways from flange to target and load point, m: a plate or a reflector's nest."""
CABLE_RADIUS = 0.01
"""Radius that is kept for a cable, m."""
MARGIN = 0.005
"""Distance below which a plan is refused, m; a planner keeps more."""
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

    def load(self, name: str) -> Load | None:
        """Return a load by name; None unloaded, and for a name that the cell lacks."""
        return next((load for load in self.config.loads if load.name == name), None)

    def segments(self, q: Floats, load: str) -> tuple[Segment, ...]:
        """Return what hangs or pulls at the load point in N states (N, n).

        A weight takes an upright capsule of the length hang_m below the load point (along
        gravity), a pull's cable goes in the pull's direction. What the flange carries, and the
        last body, may touch them where they are so close to the load point that they always do:
        the shape of the hook there is not known.
        """
        known = self.load(load)
        if known is None:
            return ()
        at = chains.evaluate(self.cell.arm, q).point(self.cell.load_point)
        out = []
        gravity, force = self.cell.gravity, np.asarray(known.force_N)
        if known.hanging_m > 0.0 and gravity.any():
            down, long = gravity / np.linalg.norm(gravity), known.hanging_m
            rim = min(known.radius_m, 0.5 * long)
            ends = at + rim * down, at + (long - rim) * down
            near = self.near(self.cell.load_point, known.radius_m)
            out.append(Segment(f"what hangs ({load})", *ends, known.radius_m, near))
        if known.cable_m > 0.0:
            end = at + known.cable_m * force / np.linalg.norm(force)
            near = self.near(self.cell.load_point, CABLE_RADIUS)
            out.append(Segment(f"the cable ({load})", at, end, CABLE_RADIUS, near))
        return tuple(out)

    def near(self, point: Floats, radius: float) -> frozenset[str]:
        """Return what moves with the flange and is as good as touched at a point of it.

        Args:
            point: (3,) flange axes, m.
            radius: of what is there, m.
        """
        arm = self.cell.arm
        flange = arm.links[arm.n]
        at = flange[:3, :3] @ point + flange[:3, 3]
        return frozenset(
            part.name
            for part in self.scene.parts
            if part.body == arm.n
            and segment_distance(at, at, part.start, part.end) < part.radius + radius + _NEAR
        )

    def load_touching(self, q: Floats, load: str, margin: float) -> Bools:
        """Return (N,) where what hangs or pulls is closer to arm or obstacles than `margin`."""
        out = np.zeros(len(q), dtype=np.bool_)
        for segment in self.segments(q, load):
            out |= self.scene.touching(q, segment, margin)
        return out

    def problems(
        self, q: Floats, load: str, where: str, *, itself: bool = True
    ) -> dict[tuple[str, ...], str]:
        """Return what collides at N points (N, n), one line for each pair, by kind and place.

        Args:
            q: joint angles, rad.
            load: name of the load that hangs.
            where: the place in words.
            itself: whether the arm is checked against itself; not where its shape is a guess.
        """
        out: dict[tuple[str, ...], str] = {}
        hung = self.segments(q, load)
        named = self.scene.pairs(q, MARGIN, hung, itself=itself)
        for a, b in named:
            out[f"collision {a} {b}", where] = f"{where}: {a} and {b} collide"
        low = self.config.limits.workspace_min_m
        if low is not None and load != UNLOADED:
            deep = low[2] - float(_height(hung, len(q)).min(initial=np.inf))
            if deep > 0.0:
                out[f"low {load}", where] = (
                    f"{where}: what hangs or pulls ({load}) reaches {deep:.3g} m below the "
                    f"workspace (it begins at z = {low[2]:g} m); see hang_m and cable_m of "
                    "[[loads]]"
                )
        return out


def _height(segments: tuple[Segment, ...], count: int) -> Floats:
    """(N,) how high the lowest point of segments is, m; inf where there are none."""
    low = np.full(count, np.inf)
    for x in segments:
        low = np.minimum(low, np.minimum(x.start[:, 2], x.end[:, 2]) - x.radius)
    return low


def clearance_of(cell: Cell, config: CellConfig, floor: float | None = None) -> Clearance:
    """Return the shapes of a cell.

    Args:
        cell: the cell.
        config: its obstacles and loads.
        floor: height that forearm, tool and loads stay above, base axes, m; None for none.
    """
    return Clearance(cell, config, Scene(cell.arm, _tool(cell), config.obstacles, floor))


def _tool(cell: Cell) -> tuple[Capsule, ...]:
    """The ways from flange to targets and load point; nothing of a target of unknown place."""
    ways = [(_AT_LOAD, cell.load_point)]
    names = [f" {name}" for name in cell.target_names] or [""]
    for name, pose, known in zip(names, cell.all_targets, cell.known_targets, strict=True):
        if known:
            ways.append((_AT_TARGET + name, pose[:3, 3]))
    flange = np.zeros(3)
    return tuple(
        flange_capsule(cell.arm, name, flange, end, TOOL_RADIUS) for name, end in ways if end.any()
    )
