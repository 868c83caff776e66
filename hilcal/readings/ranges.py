"""The ranges of what predictions may extrapolate in: joint angles, loads, temperatures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.readings.readings import States
from hilcal.types import Bools, Floats

MARGIN = 0.02  # share of the fitted range by which a reading is beyond it; a choice
FULL_TURN = 2.0 * np.pi


@dataclass(frozen=True, slots=True)
class Range:
    """Values of one variable in the fitted readings; SI."""

    variable: str
    unit: str
    low: float
    high: float

    def over(self, values: Floats, *, turning: bool = False) -> Floats:
        """Return by how much values (N,) are outside; zero or less inside."""
        if not turning:
            return np.asarray(np.maximum(values - self.high, self.low - values))
        above = np.mod(values - self.low, FULL_TURN)
        return np.asarray(np.minimum(above - (self.high - self.low), FULL_TURN - above))

    def beyond(self, values: Floats, *, turning: bool = False) -> Bools:
        """Which values are outside, by more than `MARGIN` of the range; arguments as of `over`."""
        allowed = MARGIN * (self.high - self.low) + 1e-9 * max(abs(self.low), abs(self.high), 1.0)
        return np.asarray(self.over(values, turning=turning) > allowed)


def angle_name(joint: int) -> str:
    """Return the variable of a joint's angle; joints count from 0."""
    return f"joint {joint + 1} angle"


def travel_name(joint: int) -> str:
    """Return the variable of the travel of a joint that slides; joints count from 0."""
    return f"joint {joint + 1} travel"


def turning_variables(turns: Bools) -> frozenset[str]:
    """Return the variables that mean the same whole turns on, of joints (n,) that do."""
    return frozenset(angle_name(j) for j in np.flatnonzero(turns).tolist())


def variables(s: States, units: Sequence[str]) -> Iterator[tuple[str, str, Floats]]:
    """Yield name, unit, and the values (N,) of what a prediction may extrapolate in."""
    for j, unit in enumerate(units):
        yield (travel_name if unit == "m" else angle_name)(j), unit, s.q[:, j]
    for name, unit, part in (("force", "N", slice(0, 3)), ("moment", "N·m", slice(3, 6))):
        yield name, unit, np.linalg.norm(s.wrench[:, part], axis=1)
    if s.air_temperature is not None:
        yield "air temperature", "K", s.air_temperature
    if s.joint_temperature is not None:
        for j in range(s.joint_temperature.shape[1]):
            yield f"joint {j + 1} temperature", "K", s.joint_temperature[:, j]


def ranges_of(s: States, units: Sequence[str]) -> tuple[Range, ...]:
    """Return the ranges of `variables`."""
    return tuple(
        Range(name, unit, float(v.min()), float(v.max())) for name, unit, v in variables(s, units)
    )
