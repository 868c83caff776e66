"""The arm's scatter from one arrival to the next, as a covariance of the tool's position."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.data.readings import Readings
from hilcal.robot.chain import Chain, drive_jacobian
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Scatter:
    """Standard deviations of one arrival.

    Attributes:
        joint_std: (n,) of the drives, rad.
        std_m: of the position along each axis beside that, m.
        known: whether it was stated or estimated; zeros mean nothing otherwise.
    """

    joint_std: Floats
    std_m: float
    known: bool

    def covariance(self, cell: Cell, chain: Chain, position: Floats) -> Floats:
        """(N, 3, 3) covariance of points (N, 3) that the flange carries, base axes, m²."""
        j = drive_jacobian(cell.arm, chain, position)[:, :3] * self.joint_std
        return j @ np.swapaxes(j, 1, 2) + self.std_m**2 * np.eye(3)

    def to_json(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        return {"joint_std": self.joint_std.tolist(), "std_m": self.std_m, "known": self.known}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Scatter":
        """Return what `to_json` wrote."""
        joint_std = np.array(content["joint_std"], dtype=float)
        return cls(joint_std, float(content["std_m"]), bool(content["known"]))


def scatter_of(readings: Readings, cell: Cell) -> Scatter:
    """Return the scatter as it was estimated from readings, or as the cell states it."""
    n, found = cell.arm.n, readings.arm_scatter
    if found is None:
        config = cell.config
        stated = np.zeros(n) if config is None else config.repeatability.per_joint(n)
        return Scatter(stated, 0.0, bool(stated.any()))
    if found.kind == "isotropic":
        return Scatter(np.zeros(n), found.std[0], known=True)
    return Scatter(np.broadcast_to(np.array(found.std), (n,)).copy(), 0.0, known=True)
