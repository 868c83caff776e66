"""What a force sensor between flange and tool feels."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.rigid import turned
from drivers.simulated.world import World
from hilcal.config import CellConfig
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class SensorMount:
    """Where the force sensor sits: everything beyond it weighs on it.

    Attributes:
        origin: (3,) of the sensor, flange axes, m.
        axes: (3, 3) the sensor's axes in flange axes: maps sensor into flange components.
    """

    origin: Floats
    axes: Floats

    @classmethod
    def of(cls, config: CellConfig) -> "SensorMount":
        """Return the mount of a configuration; at the flange where it has no sensor."""
        sensor = config.force_sensor
        if sensor is None:
            return cls(np.zeros(3), np.eye(3))
        rotation = turned(np.array([sensor.rotvec_rad]))[0]
        return cls(np.array(sensor.origin_m), rotation)

    def feels(self, world: World, turn: Floats, wrench: Floats) -> Floats:
        """Return the (6,) wrench of tool and load on the sensor, its axes, N and N·m.

        f = Rᵀ (m g + f_load),  tau = Rᵀ ((c - o) × m g + (p - o) × f_load + tau_load)

        Args:
            world: tool, load point (as it truly is) and gravity.
            turn: (3, 3) true orientation of the flange, base axes.
            wrench: (6,) of the load at its point, base axes, N and N·m.
        """
        cell = world.cell
        weight = cell.tool_mass * cell.gravity
        point = cell.load_point + world.physics.load_point
        force = weight + wrench[:3]
        moment = (
            np.cross(turn @ (cell.tool_com - self.origin), weight)
            + np.cross(turn @ (point - self.origin), wrench[:3])
            + wrench[3:]
        )
        back = (turn @ self.axes).T
        return np.concatenate([back @ force, back @ moment])
