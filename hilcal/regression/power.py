"""Power of the test of a family beside a fitted model.

Parameters β of a family whose information beside the model is S (see `projection`, `schur`) add
the non-centrality λ = βᵀ S β to the reduction of the sum of squares. The F-test with k directions
of the family and ν − k degrees of freedom then follows the noncentral F distribution; where the
noise is known (ν infinite) the test is the χ² test.
"""

import numpy as np
from scipy.stats import chi2, ncf, ncx2
from scipy.stats import f as f_distribution

from hilcal.regression.spectrum import visible
from hilcal.types import Floats


def family_power(s: Floats, beta: Floats, level: float, dof: float = np.inf) -> float:
    """Return the probability that the test at `level` finds a family with the parameters β.

    Args:
        s: (P, P) S.
        beta: (P,) β.
        level: of the test; returned where no direction of the family is visible.
        dof: degrees of freedom of the residual without the family; infinite for known noise.
    """
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    seen = visible(values)
    rank = int(seen.sum())
    if rank == 0 or dof - rank < 1:
        return level
    noncentrality = float(values[seen] @ (vectors[:, seen].T @ beta) ** 2)
    return power_of_test(noncentrality, rank, dof - rank, level)


def power_of_test(noncentrality: float, rank: int, rest: float, level: float) -> float:
    """Return the power of the F-test with `rank` and `rest` degrees of freedom."""
    if noncentrality <= 0.0:
        return level
    if np.isinf(rest):
        return float(ncx2.sf(chi2.isf(level, rank), rank, noncentrality))
    return float(ncf.sf(f_distribution.isf(level, rank, rest), rank, rest, noncentrality))


def noncentrality_of_power(rank: int, rest: float, level: float, power: float) -> float:
    """Return the non-centrality at which the F-test at `level` has the given power."""
    from scipy.optimize import brentq  # slow to import

    high = 10.0 * (rank + 1.0) + 4.0 * rank * float(f_distribution.isf(level, rank, rest))

    def lacks(value: float) -> float:
        return power_of_test(value, rank, rest, level) - power

    while lacks(high) < 0.0:
        high *= 2.0
    return float(brentq(lacks, 0.0, high, xtol=1e-6 * high))
