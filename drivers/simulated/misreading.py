"""How a force sensor misreads what acts: its offset, its gains, and the turn of its axes."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.rigid import turned
from drivers.simulated.truth import Truth
from hilcal.errors import InputError
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Misreading:
    """acting = G (said - b), both at the load point and in the axes of the body that carries it.

    The sensor reads b + diag(1 + g) exp([delta])ᵀ acting, so G = exp([delta]) diag(1 / (1 + g)),
    the same rotation for force and moment.

    Attributes:
        gain: (6, 6) G.
        bias: (6,) b, N and N·m.
    """

    gain: Floats
    bias: Floats

    @classmethod
    def of(cls, truth: Truth) -> "Misreading | None":
        """Return that of a truth, flange axes; None where the sensor is perfect.

        Raises:
            InputError: a gain of nothing or less.
        """
        parts = (truth.wrench_bias, truth.wrench_gain, truth.sensor_misalignment)
        if not any(np.any(part) for part in parts):
            return None
        if np.any(truth.wrench_gain <= -1.0):
            raise InputError(
                f"wrench_gain {truth.wrench_gain.tolist()}: a channel would read nothing, or "
                "backwards; valid: errors over -1"
            )
        turn = turned(truth.sensor_misalignment[None])[0]
        return cls(_both(turn) / (1.0 + truth.wrench_gain), truth.wrench_bias)

    def in_axes(self, axes: Floats) -> "Misreading":
        """Return the same in other axes; `axes` (3, 3) maps present components into them."""
        turn = _both(axes)
        return Misreading(turn @ self.gain @ turn.T, turn @ self.bias)

    def acting(self, said: Floats) -> Floats:
        """Return the (N, 6) wrenches that act where the sensor reads `said`, N and N·m."""
        return np.asarray((said - self.bias) @ self.gain.T)


def _both(turn: Floats) -> Floats:
    """Return the (6, 6) rotation of force and moment."""
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = turn
    return out
