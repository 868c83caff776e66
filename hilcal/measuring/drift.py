"""Drift: returns to the reference pose against the first reading there."""

from dataclasses import dataclass, field

import numpy as np

from hilcal.store.plan import REFERENCE, UNLOADED, Step
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """How far a return lies from the first reading at the reference pose.

    Attributes:
        metres: (3,) difference of the positions, sensor axes, m.
        sigma: its size d in standard deviations, sqrt(dᵀ (C₁ + C)⁻¹ d).
    """

    metres: Floats
    sigma: float

    def words(self, limit: float) -> str:
        """Return for people that it is over a limit, sigma."""
        micrometres = 1e6 * float(np.linalg.norm(self.metres))
        return (
            f"the reference pose has moved by {micrometres:.0f} µm, {self.sigma:.1f} sigma "
            f"(drift_limit_sigma {limit:g}): is the tracker or the target loose, or the arm "
            "still warming up?"
        )


@dataclass(slots=True)
class Drift:
    """Compares the unloaded readings at the reference pose with the first of them."""

    _first: tuple[Floats, Floats] | None = field(default=None)

    def add(self, step: Step, position: Floats, covariance: Floats) -> Shift | None:
        """Add a position; returns its shift where it is a return, else None.

        Args:
            step: which reading.
            position: (3,) sensor axes, m.
            covariance: (3, 3) of instrument and arm, m².
        """
        if step.pose != REFERENCE or step.load != UNLOADED:
            return None
        if self._first is None:
            self._first = position, covariance
            return None
        d = np.asarray(position - self._first[0])
        square = float(d @ np.linalg.solve(covariance + self._first[1], d))
        return Shift(d, float(np.sqrt(max(square, 0.0))))
