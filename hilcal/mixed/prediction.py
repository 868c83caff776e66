"""The best linear unbiased prediction, and its uncertainty with that of the variances.

    x* S c ± (x* (Cov + J Σ Jᵀ) x*ᵀ)^½

Cov the covariance of the coordinates' errors at the estimated variances, Σ that of log s and η, J
the sensitivity of the coordinates to them (Kackar and Harville, *Approximations for standard errors
of estimators of fixed and random effects in mixed linear models*, JASA 79 (1984) 853).
"""

import numpy as np

from hilcal.mixed.equations import Equations
from hilcal.mixed.variances import Variances
from hilcal.types import Floats, Ints


def coordinates_covariance(found: Variances) -> Floats:
    """(K, K) covariance of the errors of the coordinates."""
    j = found.equations.sensitivity
    return np.asarray(found.equations.covariance + j @ found.covariance @ j.T)


def predict(found: Variances, jacobian: Floats) -> tuple[Floats, Floats]:
    """Predict rows that were not measured.

    Args:
        found: the variances.
        jacobian: (N, m, P) derivative of what is predicted by the model's parameters.

    Returns:
        (N, m) predicted change from what the model predicts with all parameters zero, and
        (N, m, m) its covariance.
    """
    x = found.equations.problem.coordinates(jacobian)
    covariance = coordinates_covariance(found)
    return x @ found.equations.coordinates, x @ covariance @ np.swapaxes(x, -1, -2)


def left_out(e: Equations, fold: Ints) -> tuple[Floats, Floats]:
    """Predict rows without their fold F, at given variances.

        y_F − ŷ_F = D (P_FF)⁻¹ P_F t,    covariance D (P_FF)⁻¹ D,    D² = R_FF

    Args:
        e: the equations of all rows.
        fold: (R,) number of each row's fold.

    Returns:
        (R,) measured minus predicted, and (R,) its variance, that of the noise included.
    """
    p = e.projection.project(np.eye(len(fold)))
    off, variance = np.empty(len(fold)), np.empty(len(fold))
    for f in range(int(fold.max()) + 1):
        mine = fold == f
        inverse, std = np.linalg.inv(p[np.ix_(mine, mine)]), e.noise_std[mine]
        off[mine] = std * (inverse @ e.residual[mine])
        variance[mine] = std**2 * np.diagonal(inverse)
    return off, variance
