"""How long the rest of a campaign takes, from how long it took so far."""

import numpy as np

from hilcal.measuring.clock import Clock

LOADING_S = 60.0
"""How long a person is taken to need for a change of the load until one was seen, s."""


class Eta:
    """Measures readings with the motions to them, and changes of the load, in cell seconds."""

    def __init__(self, clock: Clock) -> None:
        """Start now."""
        self._clock = clock
        self._mark = clock.now()
        self._moving = 0.0
        self._readings: list[float] = []
        self._changes: list[float] = []

    def arrived(self) -> None:
        """A motion to where the load is changed is over; it counts for the next reading."""
        self._moving += self._lap()

    def changed(self) -> None:
        """A change of the load is over."""
        self._changes.append(self._lap())

    def read(self) -> None:
        """A reading is stored."""
        self._readings.append(self._moving + self._lap())
        self._moving = 0.0

    def left(self, readings: int, changes: int) -> float:
        """Return how long so many readings and changes take at this pace, cell seconds."""
        each = float(np.mean(self._readings)) if self._readings else 0.0
        change = float(np.mean(self._changes)) if self._changes else LOADING_S
        return readings * each + changes * change

    def _lap(self) -> float:
        before, self._mark = self._mark, self._clock.now()
        return self._mark - before
