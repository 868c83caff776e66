"""Points of the arm and its tool that have to stay within the workspace."""

from collections.abc import Iterator

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.robot.chain import Chain
from hilcal.types import Floats

AXES = "xyz"
TOOL_POINTS = ("flange", "target", "load point")


def points(cell: Cell, chain: Chain) -> tuple[tuple[str, ...], Floats]:
    """Return the names of K points and where they are, (N, K, 3), base axes, m.

    Flange, target and load point first, then the origins of the joints from the third on
    (the first two hardly move, and stand where the arm is mounted).
    """
    joints = range(2, cell.arm.n)
    tool = [chain.position[-1], chain.point(cell.target[:3, 3]), chain.point(cell.load_point)]
    names = (*TOOL_POINTS, *(cell.arm.joint_names[k] for k in joints))
    return names, np.stack([*tool, *(chain.position[k] for k in joints)], axis=1)


def outside(
    cell: Cell, config: CellConfig, chain: Chain
) -> Iterator[tuple[str, str, Floats, float]]:
    """Yield (point, axis, how far it is outside (N,), limit) of every side of the box, m.

    Flange, target and load point stay within the box, the joints within its height. How far
    is negative inside; nothing is yielded where the box has no such side.
    """
    low, high = config.limits.workspace_min_m, config.limits.workspace_max_m
    if low is None and high is None:
        return
    names, place = points(cell, chain)
    for k, name in enumerate(names):
        for axis in range(3) if name in TOOL_POINTS else (2,):
            at = place[:, k, axis]
            if low is not None:
                yield name, AXES[axis], low[axis] - at, low[axis]
            if high is not None:
                yield name, AXES[axis], at - high[axis], high[axis]
