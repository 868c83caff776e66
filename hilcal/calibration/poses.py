"""What a calibration says of N points: where the tool is, and how well that is known."""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hilcal.calibration.measured import Outside
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.types import Floats

BAND = 0.95
"""Share of points whose error lies within the stated band."""


@dataclass(frozen=True, slots=True, eq=False)
class ToolPoses:
    """Where the tool is at N points, base axes.

    Attributes:
        position: (N, 3) m.
        rotation: (N, 3, 3).
        nominal_position: (N, 3) where it is asked to be: where the nominal arm has it, of a fit to
            deflections where the unloaded arm has it.
        nominal_rotation: (N, 3, 3).
        covariance: (N, 3, 3) of the true position about `position`, m²; None where it was not
            asked for.
        outside: what the points leave of that which was measured.
    """

    position: Floats
    rotation: Floats
    nominal_position: Floats
    nominal_rotation: Floats
    covariance: Floats | None
    outside: tuple[Outside, ...]

    @property
    def error_m(self) -> Floats:
        """(N,) distance of the tool from where it is asked to be, m."""
        return np.asarray(np.linalg.norm(self.position - self.nominal_position, axis=1))

    @property
    def error_rad(self) -> Floats:
        """(N,) angle between the two, rad."""
        turn = se3.product(self.rotation, np.swapaxes(self.nominal_rotation, 1, 2))
        return np.asarray(np.linalg.norm(se3.rotation_vector(turn), axis=1))

    @property
    def std_m(self) -> Floats:
        """(N,) standard deviation of the position, over three dimensions, m.

        Raises:
            InputError: it was left out.
        """
        return np.asarray(np.sqrt(np.trace(self._known(), axis1=1, axis2=2)))

    @property
    def band_m(self) -> Floats:
        """(N,) distance from `position` that `BAND` of the points stay within, m.

        Of a normal error with covariance Σ, |e|² ≈ g χ²_ν with the same mean and variance:
        g = tr Σ²/tr Σ, ν = (tr Σ)²/tr Σ² (Satterthwaite, Biometrics Bulletin 2 (1946) 110-114).

        Raises:
            InputError: the uncertainty was left out.
        """
        return band(self._known())

    def _known(self) -> Floats:
        if self.covariance is None:
            raise InputError("the uncertainty was left out; ask for it with std=True")
        return self.covariance


def band(covariance: Floats) -> Floats:
    """(N,) radius that `BAND` of normal vectors with covariance (N, 3, 3) stay within.

    By the χ² with the same mean and variance (Satterthwaite); 0 where the covariance is.
    """
    size = np.trace(covariance, axis1=1, axis2=2)
    shape = covariance / np.where(size > 0, size, 1.0)[:, None, None]
    second = np.einsum("nij,nji->n", shape, shape)
    second = np.where(size > 0, second, 1.0)
    return np.asarray(np.sqrt(size * second * chi2.ppf(BAND, 1.0 / second)))
