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
        bias: (6,) when the world begins, N and N·m.
        drift: (6,) per K.
        noise: (6,) standard deviation of one frame.
        overload: (6,) wrench added by a fault.
        on: how long the sensor has been on when the world begins, s.
        frozen: (6,) what it reads whatever it feels; None is the truth.
    """

    board: Blackboard
    rng: np.random.Generator
    bias: Floats
    drift: Floats
    noise: Floats
    overload: Floats
    on: float
    frozen: Floats | None = None

    @staticmethod
    def draw(
        board: Blackboard, noise: tuple[float, float], rng: np.random.Generator, on: float
    ) -> "Gauge":
        """Return a sensor with a drawn zero; `noise` is of a force (N) and a moment (N·m)."""
        return Gauge(
            board,
            rng,
            BIAS_STD * rng.standard_normal(6),
            DRIFT_STD * rng.standard_normal(6),
            np.repeat(noise, 3),
            np.zeros(6),
            on,
        )

    def temperature(self) -> float:
        """Return the sensor's temperature, °C: it warms up above the air."""
        air = float(self.board.read("truth")["air_temperature"])
        return float((air if air != 0.0 else ROOM) + self._own_heat(self.board.time))

    def read(self, count: int) -> Floats:
        """Return (count, 6) wrenches of the frames that are due now, N and N·m."""
        if self.frozen is not None:
            return np.tile(self.frozen, (count, 1))
        truth = self.board.read("truth")["sensor_wrench"]
        since = self._own_heat(self.board.time) - self._own_heat(0.0)
        mean = truth + self.bias + self.drift * since + self.overload
        return np.asarray(mean + self.noise * self.rng.standard_normal((count, 6)))

    def _own_heat(self, time: float) -> float:
        """Return by how much it is warmer than the air at a world time (s), K."""
        return float(WARM_K * (1.0 - np.exp(-(time + self.on) / WARM_S)))
