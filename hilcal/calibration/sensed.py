"""The wrench of a load at the load point, as a force sensor reads it.

The sensor stands between flange and tool. With R its axes and p its origin in base axes, r the
load point, and (f, M) what the load adds to its reading, sensor axes:

    force = R f,   moment = R M − (r − p) × R f
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from hilcal.cell import Cell
from hilcal.measuring.tool_load import shift
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class SensorMount:
    """Where the force sensor stands."""

    origin_m: Floats  # (3,) its origin, flange axes, m
    rotvec_rad: Floats  # (3,) its axes in flange axes, a rotation vector, rad

    @classmethod
    def of(cls, cell: Cell) -> Self | None:
        """Return where the sensor of a cell stands; None where it has none."""
        sensor = None if cell.config is None else cell.config.force_sensor
        if sensor is None:
            return None
        return cls(np.array(sensor.origin_m), np.array(sensor.rotvec_rad))

    def load_wrench(self, cell: Cell, q: Floats, reading: Floats) -> Floats:
        """Return force and moment (N, 6) of the load at the load point, base axes, N and N·m.

        As in a campaign, the arm is the nominal one.

        Args:
            q: (N, n) joint values, rad.
            reading: (N, 6) what the load adds to the sensor's reading, sensor axes.
        """
        chain = evaluate(cell.arm, q)
        axes = se3.product(chain.rotation[-1], se3.rotation(self.rotvec_rad))
        turned = [se3.apply(axes, part) for part in (reading[:, :3], reading[:, 3:])]
        lever = chain.point(cell.load_point) - chain.point(self.origin_m)
        return shift(np.concatenate(turned, axis=1), lever)
