"""Noise or model? What repeated readings say of the stated covariance.

Readings repeated at one pose under one load differ by noise alone (pure error), whatever the
model misses. With r_i the residuals of a group of repeats and r̄ their weighted mean,

    χ²_pure = Σ (r_i − r̄)ᵀ V_i⁻¹ (r_i − r̄),   dof = (repeats − 1) m

and what is left of χ² is lack of fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.data.whitening import inverse_root
from hilcal.identify.fit import Fit, variance_interval
from hilcal.types import Ints

FEWEST = 10
"""Degrees of freedom of pure error below which the program does not judge by it."""


@dataclass(frozen=True, slots=True)
class PureError:
    """What repeats say.

    Attributes:
        factor: variance factor of the repeats, against the stated covariance.
        interval: its 95 % confidence interval.
        dof: its degrees of freedom.
        lack_of_fit_p: p-value of what remains, against pure error.
    """

    factor: float
    interval: tuple[float, float]
    dof: int
    lack_of_fit_p: float


def pure_error(fit: Fit) -> PureError | None:
    """Compare repeats; None where there are too few."""
    w = fit.whitening
    group = _repeats(fit)
    count = np.bincount(group)
    many = count[group] > 1
    dof = int((count[count > 1] - 1).sum()) * w.m
    if dof < FEWEST:
        return None
    factor = inverse_root(w.covariance)
    white = np.einsum("dij,dj->di", factor, fit.raw)
    # Repeats share one covariance to good approximation, so the plain mean is the weighted one.
    mean = np.zeros((len(count), w.m))
    np.add.at(mean, group, white)
    mean /= np.maximum(count, 1)[:, None]
    total = float(np.sum((white - mean[group])[many] ** 2))
    rest_dof = fit.dof - dof
    rest = max(fit.chi2 - total, 0.0)
    p = 1.0
    if rest_dof > 0 and total > 0:
        p = float(f_distribution.sf((rest / rest_dof) / (total / dof), rest_dof, dof))
    return PureError(total / dof, variance_interval(total, dof), dof, p)


def _repeats(fit: Fit) -> Ints:
    """Group of each measurement: same joints, same load, same side of approach."""
    w = fit.whitening
    s = fit.readings[~fit.outlier].states[w.reading]
    parts = [np.round(s.q, 6), np.round(s.wrench, 6)]
    if s.approach is not None:
        parts.append(s.approach)
    keys = np.concatenate(parts, axis=1)
    return np.asarray(np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1))
