"""The ranges of what predictions may extrapolate in: joint angles, loads, temperatures."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.data.readings import States
from hilcal.types import Bools, Floats

MARGIN = 0.02
"""Share of the fitted range by which a reading is beyond it; a choice: of two random halves, few
readings are."""


@dataclass(frozen=True, slots=True)
class Range:
    """Values of one variable in the fitted readings; SI."""

    variable: str
    unit: str
    low: float
    high: float

    def beyond(self, values: Floats) -> Bools:
        """Which values are outside, by more than `MARGIN` of the range."""
        allowed = MARGIN * (self.high - self.low) + 1e-9 * max(abs(self.low), abs(self.high), 1.0)
        return np.asarray(np.maximum(values - self.high, self.low - values) > allowed)


def variables(s: States) -> Iterator[tuple[str, str, Floats]]:
    """Yield name, unit, and the values (N,) of what a prediction may extrapolate in."""
    for j in range(s.q.shape[1]):
        yield f"joint {j + 1} angle", "rad", s.q[:, j]
    for name, unit, part in (("force", "N", slice(0, 3)), ("moment", "N·m", slice(3, 6))):
        yield name, unit, np.linalg.norm(s.wrench[:, part], axis=1)
    if s.air_temperature is not None:
        yield "air temperature", "K", s.air_temperature
    if s.joint_temperature is not None:
        for j in range(s.joint_temperature.shape[1]):
            yield f"joint {j + 1} temperature", "K", s.joint_temperature[:, j]


def ranges_of(s: States) -> tuple[Range, ...]:
    """Return the ranges of `variables`."""
    return tuple(
        Range(name, unit, float(v.min()), float(v.max())) for name, unit, v in variables(s)
    )
