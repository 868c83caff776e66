"""What a strain-gauge sensor makes of the true wrench: bias, drift with temperature, noise."""

from dataclasses import dataclass

import numpy as np

from drivers.simulated.blackboard import Blackboard
from hilcal.types import Floats

BIAS_STD = np.repeat((4.0, 0.2), 3)
"""The zero of a sensor as delivered and bolted on, N and N·m."""
DRIFT_STD = np.repeat((0.05, 0.002), 3)
"""Drift of the zero with the sensor's temperature, N/K and N·m/K."""
WARM_K, WARM_S = 7.0, 600.0
"""Own heat above the air and how fast it comes (world time)."""
ROOM = 22.0
"""Air temperature where the world does not tell, °C."""


@dataclass(slots=True, eq=False)
class Gauge:
    """The sensor's measuring bridge.

        wrench = true + bias + drift (T - T_start) + overload + noise

    Attributes:
        board: the one physical world.
        rng: generator of the noise.
        bias: (6,) at the temperature of switching on, N and N·m.
        drift: (6,) per K.
        noise: (6,) standard deviation of one frame.
        overload: (6,) wrench added by a fault.
    """

    board: Blackboard
    rng: np.random.Generator
    bias: Floats
    drift: Floats
    noise: Floats
    overload: Floats

    @staticmethod
    def draw(board: Blackboard, noise: tuple[float, float], rng: np.random.Generator) -> "Gauge":
        """Return a sensor with a drawn zero; `noise` is of a force (N) and a moment (N·m)."""
        return Gauge(
            board,
            rng,
            BIAS_STD * rng.standard_normal(6),
            DRIFT_STD * rng.standard_normal(6),
            np.repeat(noise, 3),
            np.zeros(6),
        )

    def temperature(self) -> float:
        """Return the sensor's temperature, °C: it warms up above the air."""
        air = float(self.board.read("truth")["air_temperature"])
        warm = WARM_K * (1.0 - np.exp(-self.board.time / WARM_S))
        return float((air if air != 0.0 else ROOM) + warm)

    def read(self, count: int) -> Floats:
        """Return (count, 6) wrenches of the frames that are due now, N and N·m."""
        truth = self.board.read("truth")["sensor_wrench"]
        warm = WARM_K * (1.0 - np.exp(-self.board.time / WARM_S))
        mean = truth + self.bias + self.drift * warm + self.overload
        return np.asarray(mean + self.noise * self.rng.standard_normal((count, 6)))
