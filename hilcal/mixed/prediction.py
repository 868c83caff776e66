"""The best linear unbiased prediction, and its uncertainty with that of the variances.

    x* S c ± (x* (Cov + J Σ Jᵀ) x*ᵀ)^½

Cov the covariance of the coordinates' errors at the estimated variances, Σ that of log s and η, J
the sensitivity of the coordinates to them (Kackar and Harville, *Approximations for standard errors
of estimators of fixed and random effects in mixed linear models*, JASA 79 (1984) 853).
"""

import numpy as np

from hilcal.mixed.variances import Variances
from hilcal.types import Floats


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
