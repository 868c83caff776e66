"""Evidence for families: the restricted likelihood ratio against s_f = 0, given all others.

With the others' standard deviations as estimated without it, Z_fᵀ P Z_f = U diag(μ) Uᵀ and
w_i = (Uᵀ Z_fᵀ P y)_i / √μ_i, which are N(0, 1) where the family is not there,

    T = max over λ of  Σ_i [ w_i² λ μ_i / (1 + λ μ_i) − log(1 + λ μ_i) ],    0 ≤ λ = s_f² ≤ most²

T's distribution under s_f = 0 has a point mass at zero and is simulated from the μ_i. Sizes beyond
what is plausible are not asked for: a family far larger than it can be would stand in for what the
zero mean of another one leaves, as a tracker's scale for gears that all give in one direction.
Source: Crainiceanu and Ruppert, *Likelihood ratio tests in linear mixed models with one variance
component*, J. R. Stat. Soc. B 66 (2004) 165.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.mixed.problem import MixedProblem
from hilcal.mixed.variances import estimate_variances
from hilcal.types import Floats

DRAWS = 20_000
"""Simulated ratios: a p-value of 0.001 to 20 %; a choice."""
GRID = np.linspace(-12.0, 12.0, 97)
"""log λ μ_max that are tried: in steps of 0.25 T is exact to 0.01; a choice."""
RANK = 1e-9
"""Eigenvalues below this share of the largest are those of columns that others span."""


@dataclass(frozen=True, slots=True)
class FamilyEvidence:
    """Evidence for one family, or one effect.

    Attributes:
        ratio: T, twice the gain of the restricted log likelihood.
        p_value: share of ratios at least as large where the family is not there; 1 for rank 0.
        rank: number of its directions that the others do not span.
    """

    ratio: float
    p_value: float
    rank: int


def evidence(
    problem: MixedProblem,
    families: int | Sequence[int],
    rng: np.random.Generator,
    start: Floats | None = None,
    most: float = np.inf,
) -> FamilyEvidence:
    """Return the evidence for a family, or for several of one effect.

    Several are tested by one multiple of their ordinary standard deviations, the priors' means.

    Args:
        rng: draws the ratios.
        start: (F + N,) log s and η of the whole problem; without it the priors' means.
        most: largest plausible s, in ordinary magnitudes.
    """
    numbers = [families] if isinstance(families, int) else list(families)
    without = problem.without(numbers)
    ordinary = np.exp([f.prior.mean for f in problem.families.random])
    mine = np.isin(problem.family, numbers)
    own = problem.x[:, problem.flat :][:, mine] * ordinary[problem.family[mine]]
    begun = None if start is None else np.delete(start, numbers)
    inner, score = estimate_variances(without, begun).equations.score(own)
    mu, u = np.linalg.eigh((inner + inner.T) / 2)
    seen = mu > RANK * max(float(np.sum(own**2)), 1e-300)
    if not seen.any():
        return FamilyEvidence(0.0, 1.0, 0)
    mu = mu[seen]
    w2 = (u[:, seen].T @ score) ** 2 / mu
    bound = (most / ordinary[numbers].max()) ** 2
    ratio = float(_ratios(mu, w2[None], bound)[0])
    drawn = _ratios(mu, rng.standard_normal((DRAWS, len(mu))) ** 2, bound)
    p = (1 + int(np.count_nonzero(drawn >= ratio))) / (1 + DRAWS) if ratio > 0 else 1.0
    return FamilyEvidence(ratio, float(p), len(mu))


def _ratios(mu: Floats, w2: Floats, bound: float) -> Floats:
    """(D,) T of squared w (D, r) with eigenvalues (r,), λ at most a bound."""
    lm = np.minimum(np.exp(GRID), bound * mu.max())[:, None] * (mu / mu.max())
    shrink, cost = lm / (1 + lm), np.log1p(lm).sum(axis=1)
    return np.asarray(np.maximum((w2 @ shrink.T - cost).max(axis=1), 0.0))
