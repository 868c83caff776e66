"""`sensor_misalignment`: the force sensor is mounted turned."""

import numpy as np

from hilcal.effects.force_sensor import ForceSensorEffect
from hilcal.effects.protocol import Parameter
from hilcal.robot import se3
from hilcal.types import Floats


class SensorMisalignment(ForceSensorEffect):
    """The sensor stands turned by δ: acting = R exp([δ]×) Rᵀ w, force and moment, exactly [rad]."""

    name = "sensor_misalignment"
    summary = "acting = R exp(δ) Rᵀ wrench: the force sensor's axes are turned by δ"
    plausible = 20.0  # 0.2 rad: bolted on by eye. A choice.

    parameters = tuple(
        Parameter(f"r{a}", "rad", 1e-2, f"turn of the sensor about its {a}") for a in "xyz"
    )

    def error(self, theta: Floats, recorded: Floats) -> Floats:
        """Return w − exp([δ]×) w."""
        turn = se3.rotation(theta)
        parts = [recorded[:, :3], recorded[:, 3:]]
        return np.concatenate([v - v @ turn.T for v in parts], axis=1)

    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Return exp([δ]×) [w]× J_r(δ), the derivative of −exp([δ]×) w."""
        twist = np.concatenate([np.zeros(3), theta])
        turn, j = se3.rotation(theta), se3.right_jacobian_blocks(twist)[0]
        parts = [turn @ se3.skew(v) @ j for v in (recorded[:, :3], recorded[:, 3:])]
        return np.swapaxes(np.concatenate(parts, axis=1), 1, 2)
