"""Several measurements at rest become one reading with the covariance of their mean.

The covariance of the mean is `readings.covariance.covariance_of_mean`. Its factor τ is 1 unless the
scatter cannot be explained by the stated noise (chi² test, p < 0.001): then it is their ratio, so
that an instrument that is far worse than stated is not believed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from hilcal.errors import DeviceError
from hilcal.measuring.devices import TrackerSample
from hilcal.readings.covariance import covariance_of_mean
from hilcal.readings.whitening import inverse_root
from hilcal.robot import se3
from hilcal.types import Bools, Floats

UNEXPLAINED = 1e-3
"""Scatter less probable than this disproves the stated noise; a choice, no study set it."""
GROSS_SIGMA = 6.0
"""A sample so far off (as improbable as so many sigmas of a single number) is left out; a guess."""
MOST_LEFT_OUT = 0.2
"""Share of the samples that may be left out; one always may. A guess."""
_MEAN_STEPS = 10


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """The mean of K samples.

    Attributes:
        value: (m,) position in m and, for m = 6, rotation vector in rad, sensor axes.
        covariance: (m, m) of `value`; rotations as small rotations about the sensor's axes.
        scatter: mean square of the scatter over what is stated; 1 is expected.
        scatter_p: how probable at least as much scatter is under the stated noise.
        left_out: numbers of the samples (from 0) that were gross outliers.
        warnings: what a person should know, one line each.
    """

    value: Floats
    covariance: Floats
    scatter: float
    scatter_p: float
    left_out: tuple[int, ...]
    warnings: tuple[str, ...]


def average(samples: Sequence[TrackerSample], systematic_share: float = 0.0) -> Average:
    """Average K samples of one target at rest; the law is that of the module.

    A gross outlier among them is left out: its squared distance from the median, whitened by
    Σ̄ and relative to what is usual in the window (never less than stated), is less probable
    than `GROSS_SIGMA`.

    Args:
        samples: at least 2, of one target at rest.
        systematic_share: s, 0 to 1.

    Raises:
        DeviceError: more than one in five samples (and more than one) are gross outliers, or
            fewer than 2 remain.
    """
    values = np.array([sample.value for sample in samples])
    stated = np.array([sample.covariance for sample in samples])
    keep = _not_gross(values, stated.mean(axis=0))
    left_out = tuple(int(k) for k in np.flatnonzero(~keep))
    if len(left_out) > max(1.0, MOST_LEFT_OUT * len(samples)) or keep.sum() < 2:
        raise DeviceError(
            f"tracker: its readings scatter: {len(left_out)} of {len(samples)} at one pose are "
            "gross outliers; is the beam disturbed, or does something move?"
        )
    prior = stated[keep].mean(axis=0)
    mean, residuals = deviations(values[keep])
    ratio, p = _trace_test(residuals, prior)
    believed = 1.0 if p >= UNEXPLAINED else ratio
    covariance = covariance_of_mean(prior, residuals, systematic_share, believed)
    warnings = [f"reading {k + 1} of {len(samples)} is a gross outlier, left out" for k in left_out]
    if p < UNEXPLAINED:
        warnings.append(
            f"the repeats scatter {np.sqrt(ratio):.1f} times as much as the instrument's noise "
            f"(p = {p:.1g}); the reading's covariance was enlarged"
        )
    warnings += dict.fromkeys(
        s.warning for s, kept in zip(samples, keep, strict=True) if kept and s.warning
    )
    return Average(mean, covariance, ratio, p, left_out, tuple(warnings))


def deviations(values: Floats) -> tuple[Floats, Floats]:
    """Mean (m,) of values (K, m), and each one's deviation from it (K, m).

    Rotations average in the tangent space: R̄ is where the rotation vectors of R_k R̄ᵀ have
    the mean zero (the Fréchet mean; Barfoot, *State Estimation for Robotics*, section 7.3).
    """
    mean = values.mean(axis=0)
    residuals = values - mean
    if values.shape[1] == 6:
        turns = se3.rotation(values[:, 3:])
        middle = turns[0]
        for _ in range(_MEAN_STEPS):
            residuals[:, 3:] = se3.rotation_vector(turns @ middle.T)
            step = residuals[:, 3:].mean(axis=0)
            if np.linalg.norm(step) < 1e-14:
                break
            middle = se3.rotation(step) @ middle
        mean[3:] = se3.rotation_vector(middle)
    return mean, residuals


def _trace_test(residuals: Floats, prior: Floats) -> tuple[float, float]:
    """T / (m (K - 1)) and P(chi² >= T), with T = Σ_k r_kᵀ Σ̄⁻¹ r_k.

    Under the stated noise T follows chi² with m (K - 1) degrees of freedom.
    """
    count, m = residuals.shape
    white = residuals @ inverse_root(prior).T
    total, dof = float(np.sum(white**2)), m * (count - 1)
    return total / dof, float(stats.chi2.sf(total, dof))


def _not_gross(values: Floats, stated: Floats) -> Bools:
    """Which samples (K,) are no gross outliers."""
    m = values.shape[1]
    white = deviations(values)[1] @ inverse_root(stated).T
    square = np.sum((white - np.median(white, axis=0)) ** 2, axis=1)
    usual = max(1.0, float(np.median(square) / stats.chi2.median(m)))
    return np.asarray(stats.chi2.logsf(square / usual, m) > _LOG_GROSS)


_LOG_GROSS = float(np.log(2) + stats.norm.logsf(GROSS_SIGMA))
