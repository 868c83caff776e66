"""Variances by restricted maximum likelihood, what they predict, and the evidence for families.

    maximise  ℓ(x) − ½ (x − mean)ᵀ Λ (x − mean),    x = (log s, η), Λ of `mixed.families`

by Newton's method with the average information, and what logarithms add to the curvature of a
falling likelihood: without that the steps for families that are not there are several times too
long. A family that is small where the iteration passes has hardly a slope, and would stay small
whatever the readings say of it: where Newton's method has converged, the exact likelihood of each
family's size, given the others, is searched, and the iteration goes on from the best one. The
average information and the prior's are the inverse covariance Σ of log s and η (Laplace).

The best linear unbiased prediction, with its uncertainty and that of the variances, is

    x* S c ± (x* (Cov + J Σ Jᵀ) x*ᵀ)^½

Cov the covariance of the coordinates' errors at the estimated variances, J the sensitivity of the
coordinates to log s and η.

The evidence for a family is the restricted likelihood ratio against s_f = 0, given all others. With
their standard deviations as estimated without it, Z_fᵀ P Z_f = U diag(μ) Uᵀ and
w_i = (Uᵀ Z_fᵀ P y)_i / √μ_i, which are N(0, 1) where the family is not there,

    T = max over λ of  Σ_i [ w_i² λ μ_i / (1 + λ μ_i) − log(1 + λ μ_i) ],    0 ≤ λ = s_f² ≤ most²

T's distribution under s_f = 0 has a point mass at zero and is simulated from the μ_i. Sizes beyond
what is plausible are not asked for: a family far larger than it can be would stand in for what the
zero mean of another one leaves, as a tracker's scale for gears that all give in one direction.

Sources: Patterson and Thompson, *Recovery of inter-block information when block sizes are unequal*,
Biometrika 58 (1971) 545; Kackar and Harville, *Approximations for standard errors of estimators of
fixed and random effects in mixed linear models*, JASA 79 (1984) 853; Crainiceanu and Ruppert,
*Likelihood ratio tests in linear mixed models with one variance component*, J. R. Stat. Soc. B 66
(2004) 165.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.mixed.equations import Equations, equations
from hilcal.mixed.problem import MixedProblem
from hilcal.types import Floats

STEPS = 100  # most Newton steps; a choice, 10 to 20 are usual
LARGEST_STEP = 2.0  # of log s or η at a time: a factor of 7; a choice
CONVERGED = 1e-4
"""Gain of the log posterior that ends the iteration; a choice: they are then within 1 % of their
standard error."""
JUMPS = 8  # most times that Newton's method is begun anew at another size of one family; a choice
WORTH = 0.01  # gain of the log posterior for which it is; a choice
SIZES = np.linspace(-7.0, 7.0, 57)
"""log s that are searched: a factor of 1000 either way in steps of a quarter; a choice."""
DAMPINGS = 12  # most increases of the damping in one step, tenfold each; a choice
DRAWS = 20_000  # simulated ratios: a p-value of 0.001 to 20 %; a choice
GRID = np.linspace(-12.0, 12.0, 97)
"""log λ μ_max that are tried: in steps of 0.25 T is exact to 0.01; a choice."""
RANK = 1e-9  # eigenvalues below this share of the largest: of columns that others span


@dataclass(frozen=True, eq=False)
class Variances:
    """Standard deviations of all families and of the noise."""

    equations: Equations  # at the estimate
    covariance: Floats  # (F + N, F + N) of log s and η
    log_posterior: float  # ℓ and the prior's, without constants

    @property
    def log_std(self) -> Floats:
        """(F + N,) estimate of log s and η."""
        return self.equations.log_std

    def std(self, name: str) -> float:
        """Return the standard deviation of a family or of a component of the noise."""
        return float(np.exp(self.log_std[self.equations.problem.names.index(name)]))


def estimate_variances(
    problem: MixedProblem, start: Floats | None = None, *, search: bool = False
) -> Variances:
    """Estimate all variances.

    Args:
        start: (F + N,) where the iteration starts; the priors' means unless given.
        search: whether other sizes of each family are searched. A size far from that at which the
            problem was linearised is only one to linearise at anew.

    Raises:
        CannotAnswerError: the likelihood cannot be computed at the start.
    """
    mean, precision = problem.log_std_prior
    try:
        here = equations(problem, mean if start is None else start)
    except np.linalg.LinAlgError as error:
        raise CannotAnswerError("the mixed model's equations have no solution") from error
    here, best = _newton(here)
    for _ in range(JUMPS if search else 0):
        try:
            there, value = _newton(equations(problem, _other_size(here)))
        except np.linalg.LinAlgError:
            break
        if value < best + WORTH:
            break
        here, best = there, value
    return Variances(here, np.asarray(np.linalg.inv(here.information + precision)), best)


def log_posterior(e: Equations) -> float:
    """ℓ and the prior's, without constants."""
    mean, precision = e.problem.log_std_prior
    off = e.log_std - mean
    return e.log_likelihood - 0.5 * float(off @ precision @ off)


def _newton(here: Equations) -> tuple[Equations, float]:
    """Return the equations at the nearest maximum, and the log posterior there."""
    mean, precision = here.problem.log_std_prior
    best, damping = log_posterior(here), 0.0
    for _ in range(STEPS):
        slope = here.slope - precision @ (here.log_std - mean)
        # d²ℓ/dx² = 2 dℓ/dx + 4 λ² d²ℓ/dλ², λ = exp 2x: the average information is the second term.
        bend = np.maximum(-2.0 * here.slope, 0.0)
        curvature = here.information + precision + np.diag(bend)
        gain = 0.0
        for _ in range(DAMPINGS):
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            step = np.linalg.solve(damped, slope)
            step *= min(1.0, LARGEST_STEP / float(np.abs(step).max(initial=1e-12)))
            try:
                there = equations(here.problem, here.log_std + step)
                gain = log_posterior(there) - best
            except np.linalg.LinAlgError:
                gain = -np.inf
            if gain >= 0.0:
                break
            damping = max(10.0 * damping, 1e-2)
        if gain < 0.0:
            break
        here, best, damping = there, best + gain, 0.1 * damping if damping > 1e-3 else 0.0
        if gain < CONVERGED:
            break
    return here, best


def _other_size(e: Equations) -> Floats:
    """Log s and η (F + N,) with one of them at the size that gains most, given the others."""
    mean, precision = e.problem.log_std_prior
    off = precision @ (e.log_std - mean)
    out, most = e.log_std, 0.0
    for f, family in enumerate(e.problem.families.random):
        if family.known:
            continue
        step = SIZES - e.log_std[f]
        gain = e.profile(f, SIZES) - step * off[f] - 0.5 * precision[f, f] * step**2
        k = int(np.argmax(gain))
        if gain[k] > most:
            out, most = e.log_std.copy(), float(gain[k])
            out[f] = SIZES[k]
    return out


def coordinates_covariance(found: Variances) -> Floats:
    """(K, K) covariance of the errors of the coordinates."""
    j = found.equations.sensitivity
    return np.asarray(found.equations.covariance + j @ found.covariance @ j.T)


def predict(found: Variances, jacobian: Floats) -> tuple[Floats, Floats]:
    """Predict rows that were not measured.

    Args:
        jacobian: (N, m, P) derivative of what is predicted by the model's parameters.

    Returns:
        (N, m) predicted change from what the model predicts with all parameters zero, and
        (N, m, m) its covariance.
    """
    x = found.equations.problem.coordinates(jacobian)
    covariance = coordinates_covariance(found)
    return x @ found.equations.coordinates, x @ covariance @ np.swapaxes(x, -1, -2)


@dataclass(frozen=True, slots=True)
class FamilyEvidence:
    """Evidence for one family, or one effect."""

    ratio: float  # T, twice the gain of the restricted log likelihood
    p_value: float  # share of ratios as large where the family is not there; 1 for rank 0
    rank: int  # number of its directions that the others do not span


def evidence(
    problem: MixedProblem,
    families: int | Sequence[int],
    rng: np.random.Generator,  # draws the ratios
    start: Floats | None = None,  # (F + N,) log s and η of the whole problem; else priors' means
    most: float = np.inf,  # largest plausible s, in ordinary magnitudes
) -> FamilyEvidence:
    """Return the evidence for a family, or for several of one effect.

    Several are tested by one multiple of their ordinary standard deviations, the priors' means.
    """
    numbers = [families] if isinstance(families, int) else list(families)
    ordinary = np.exp([f.prior.mean for f in problem.families.random])
    mine = np.isin(problem.family, numbers)
    own = problem.x[:, problem.flat :][:, mine] * ordinary[problem.family[mine]]
    begun = None if start is None else np.delete(start, numbers)
    others = estimate_variances(problem.without(numbers), begun)
    inner, score = others.equations.score(own)
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
