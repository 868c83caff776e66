"""Pure error: the scatter of repeated readings, against the stated covariance.

Readings repeated at one pose under one load differ by noise alone (pure error), whatever the
model misses. With y the contrasts of their residuals (see `repeats`), whitened by the joint
covariance of all readings that they share,

    χ²_pure = ‖y‖²,   dof = dim y,   factor = χ²_pure / dof

and the rest of χ² is lack of fit.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.diagnosis.noise_where import NoiseWhere, noise_where
from hilcal.diagnosis.repeats import contrasts
from hilcal.identification.fit import Fit
from hilcal.identification.residual import variance_interval

FEWEST = 10
"""Degrees of freedom of pure error below which it is not used; a guess."""


@dataclass(frozen=True, slots=True)
class PureError:
    """The scatter of repeats.

    Attributes:
        factor: variance factor of the repeats, against the stated covariance.
        interval: its 95 % confidence interval.
        dof: its degrees of freedom.
        lack_of_fit_p: p-value of what remains, against pure error.
        where: in which direction, joint or load the stated covariance is wrong, where it is
            not everywhere the same.
    """

    factor: float
    interval: tuple[float, float]
    dof: int
    lack_of_fit_p: float
    where: NoiseWhere | None = None


def pure_error(fit: Fit) -> PureError | None:
    """Compare repeats; None where there are too few."""
    c = contrasts(fit)
    if c is None or c.dof < FEWEST:
        return None
    total = float(c.y @ c.y) / c.bias
    white = c.whitening.whiten(fit.raw)
    rest = max(float(np.sum(white**2)) / c.bias - total, 0.0)
    rest_dof = fit.dof - c.dof
    p = 1.0
    if rest_dof > 0 and total > 0:
        p = float(f_distribution.sf((rest / rest_dof) / (total / c.dof), rest_dof, c.dof))
    interval = variance_interval(total, c.dof)
    return PureError(total / c.dof, interval, c.dof, p, noise_where(fit, c))
