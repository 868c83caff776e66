"""Whether what a calibration file holds can be a calibration."""

from collections.abc import Mapping, Sequence

import numpy as np

from hilcal.calibration.measured import WORDS, Condition, Measured
from hilcal.calibration.scatter import Scatter
from hilcal.cell import Cell
from hilcal.robot.arm import Arm
from hilcal.types import Floats

LARGEST = 1e9
"""No length, angle, mass, force or parameter is as large, in SI units."""


def check_frames(what: str, frames: Floats) -> None:
    """Refuse (..., 4, 4) matrices that are no rotation and translation."""
    check_numbers(what, frames, (*frames.shape[:-2], 4, 4))
    turn = frames[..., :3, :3]
    orthonormal = np.allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(3), atol=1e-6)
    if not orthonormal or np.any(frames[..., 3, :] != [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{what} is no frame")


def check_numbers(
    what: str, values: Floats | float, shape: Sequence[int] = (), *, least: float = -LARGEST
) -> None:
    """Refuse numbers of another shape, or that nothing in a cell has.

    Raises:
        ValueError: names them.
    """
    array = np.asarray(values, dtype=float)
    if array.shape != tuple(shape):
        raise ValueError(f"{what} has shape {array.shape}; expected {tuple(shape)}")
    if not np.all((array >= least) & (array <= LARGEST)):
        raise ValueError(f"{what} has a number that cannot be")


def check_arm(arm: Arm) -> None:
    """Refuse an arm that cannot be.

    Raises:
        ValueError: says why.
    """
    n = arm.links.shape[0] - 1
    if n < 1:
        raise ValueError("the arm has no joints")
    check_frames("links", arm.links)
    check_numbers("masses", arm.masses, (n,), least=0.0)
    check_numbers("coms", arm.coms, (n, 3))
    check_numbers("payload", arm.payload, least=0.0)
    for name, shape in (("coupling", (n, n)), ("drive", (n, n)), ("mimic", (n, n + 1))):
        values = getattr(arm, name)
        if values is not None:
            check_numbers(name, values, shape)
    if arm.sign is not None and not np.all(np.abs(arm.sign) == np.ones(n)):
        raise ValueError("sign is not ±1 for each joint")
    for limits in (arm.q_min, arm.q_max, arm.torque_max):
        if limits.shape != (n,) or np.any(np.isnan(limits)):
            raise ValueError("limits are not one for each joint")
    if len(arm.joint_names) != n or not all(isinstance(name, str) for name in arm.joint_names):
        raise ValueError("joints are not named each")


def check_cell(cell: Cell) -> None:
    """Refuse a cell that cannot be."""
    for name in ("target", "registration"):
        check_frames(name, getattr(cell, name))
    check_numbers("load_point", cell.load_point, (3,))
    if cell.targets is not None:
        check_frames("targets", cell.targets)
    check_numbers("tool_mass", cell.tool_mass, least=0.0)
    check_numbers("tool_com", cell.tool_com, (3,))
    check_numbers("gravity", cell.gravity, (3,))


def check_spread(scatter: Scatter, measured: Measured, n: int) -> None:
    """Refuse a scatter or ranges that cannot be."""
    check_numbers("joint_std", scatter.joint_std, (n,), least=0.0)
    check_numbers("std_m", scatter.std_m, least=0.0)
    if np.isnan(measured.most_std_m):
        raise ValueError("most_std_m is no number")
    for r in measured.ranges:
        if not isinstance(r.variable, str) or not isinstance(r.unit, str):
            raise ValueError("a range without a name")
        check_numbers(f"range of {r.variable}", np.array([r.low, r.high], dtype=float), (2,))


def check_conditions(conditions: Mapping[str, Condition], n: int) -> None:
    """Refuse conditions that cannot be."""
    for name, c in conditions.items():
        if name not in WORDS:
            raise ValueError(f"{name!r} is no condition")
        check_numbers(name, c.mean, (n,) if name in ("joint_temperature", "approach") else ())
        check_numbers(f"variance by {name}", c.variance_m2, least=0.0)
