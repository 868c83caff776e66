"""The mean of several samples of one target at rest, and its covariance.

The mean has the covariance of `covariance.covariance_of_mean`. Its factor τ is 1 unless the stated
noise cannot explain the scatter (chi² test, p < `UNEXPLAINED`); then τ is the ratio of scatter and
stated noise.

Gross outliers are omitted: samples whose squared distance from the median, whitened by the mean
stated covariance Σ̄ and relative to the median distance of the samples (at least that of the stated
noise), is less probable than `GROSS_SIGMA`.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from hilcal.readings.covariance import covariance_of_mean
from hilcal.readings.whitening import whitening_matrix
from hilcal.robot import se3
from hilcal.types import Bools, Floats

UNEXPLAINED = 1e-3
"""Level of the test of the scatter against the stated noise; a choice, no study set it."""
GROSS_SIGMA = 6.0
"""Distance of a gross outlier, as the equivalent number of sigmas of a scalar; a guess."""
_LOG_GROSS = float(np.log(2) + scipy.special.log_ndtr(-GROSS_SIGMA))
_MEAN_STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """The mean of K samples."""

    value: Floats  # (m,) position in m and, for m = 6, rotation vector in rad, sensor axes
    covariance: Floats  # (m, m) of `value`; rotations as small rotations about the sensor's axes
    scatter: float  # mean square of the scatter over the stated noise; 1 is expected
    scatter_p: float  # p-value of the scatter under the stated noise
    left_out: tuple[int, ...]  # indices of the gross outliers
    warnings: tuple[str, ...] = ()  # for people, one line each

    @property
    def explained(self) -> bool:
        """Whether the stated noise explains the scatter."""
        return self.scatter_p >= UNEXPLAINED


def mean_of_samples(values: Floats, stated: Floats, systematic_share: float = 0.0) -> Average:
    """Average K >= 2 samples (K, m) with stated covariances (K, m, m).

    At least half of them are no outliers: their distances are relative to the median.
    """
    retained = _inliers(values, stated.mean(axis=0))
    prior = stated[retained].mean(axis=0)
    mean, residuals = deviations(values[retained])
    total = float(np.sum((residuals @ whitening_matrix(prior).T) ** 2))  # Σ_k r_kᵀ Σ̄⁻¹ r_k
    dof = residuals.shape[1] * (len(residuals) - 1)
    ratio, p = total / dof, float(scipy.stats.chi2.sf(total, dof))
    factor = 1.0 if p >= UNEXPLAINED else ratio
    covariance = covariance_of_mean(prior, residuals, systematic_share, factor)
    left_out = tuple(int(k) for k in np.flatnonzero(~retained))
    return Average(mean, covariance, ratio, p, left_out)


def deviations(values: Floats) -> tuple[Floats, Floats]:
    """Return the mean (m,) of values (K, m), and the deviations from it (K, m).

    Rotations are averaged in the tangent space: the rotation vectors of R_k R̄ᵀ have the mean zero
    (Fréchet mean; Barfoot, *State Estimation for Robotics*, section 7.3).
    """
    mean = values.mean(axis=0)
    residuals = values - mean
    if values.shape[1] == 6:
        rotations = se3.rotation(values[:, 3:])
        mean_rotation = rotations[0]
        for _ in range(_MEAN_STEPS):
            residuals[:, 3:] = se3.rotation_vector(rotations @ mean_rotation.T)
            step = residuals[:, 3:].mean(axis=0)
            if np.linalg.norm(step) < 1e-14:
                break
            mean_rotation = se3.rotation(step) @ mean_rotation
        mean[3:] = se3.rotation_vector(mean_rotation)
    return mean, residuals


def _inliers(values: Floats, stated: Floats) -> Bools:
    """Return which samples (K,) are no gross outliers."""
    m = values.shape[1]
    white = deviations(values)[1] @ whitening_matrix(stated).T
    square = np.sum((white - np.median(white, axis=0)) ** 2, axis=1)
    usual = max(1.0, float(np.median(square) / scipy.stats.chi2.median(m)))
    return np.asarray(scipy.stats.chi2.logsf(square / usual, m) > _LOG_GROSS)
