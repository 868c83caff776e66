"""How much wider predictions are since the variances of a background are estimated themselves.

At given variances rows that are predicted without their fold are off by e with the variance v (see
`mixed.prediction.left_out`). With x = (log s, η) drawn from its posterior, by weights from the
normal approximation at its maximum x̂, the mean square is E[Σ v] + E|e − E e|². The factor is its
ratio to Σ v at x̂. Source: Kackar and Harville, *Approximations for standard errors of estimators of
fixed and random effects in mixed linear models*, JASA 79 (1984) 853.
"""

import numpy as np

from hilcal.mixed.equations import equations
from hilcal.mixed.prediction import left_out
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.types import Ints

MOST_ROWS = 600
"""Elements of readings beyond which the variances are taken for known: of 200 poses of a real UR10
the factor is 1.00 to 1.06, and a draw costs the cube of the rows. A choice."""
DRAWS = 30
"""Of the posterior; a choice: of 20 poses of a real UR10 the factor is 1.19 to 1.43 by the seed."""
HEAVIEST = 2.0
"""log of the largest weight of a draw over the median: the normal approximation is not exact in its
tails. A choice."""
SEED = 0
"""Of the draws, so that equal fits give equal factors."""


def variance_spread(found: Variances, fold: Ints) -> float:
    """Return the factor, at least 1, of the variance of predictions.

    Args:
        found: the variances, at the fit.
        fold: (R,) fold of each row.
    """
    if len(fold) > MOST_ROWS:
        return 1.0
    _, at = left_out(found.equations, fold)
    rng, root = np.random.default_rng(SEED), np.linalg.cholesky(found.covariance)
    variance, off, weight = [], [], []
    for _ in range(DRAWS):
        z = rng.standard_normal(len(root))
        try:
            e = equations(found.equations.problem, found.log_std + root @ z)
            residual, one = left_out(e, fold)
        except np.linalg.LinAlgError:
            continue
        variance.append(float(one.sum()))
        off.append(residual)
        weight.append(log_posterior(e) + 0.5 * float(z @ z))
    if not weight:
        return 1.0
    share = np.exp(np.minimum(np.array(weight) - np.median(weight), HEAVIEST))
    share /= share.sum()
    away = np.array(off) - share @ np.array(off)
    mean = share @ (np.array(variance) + np.sum(away**2, axis=1))
    return max(1.0, float(mean / at.sum()))
