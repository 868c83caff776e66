"""Variances by restricted maximum likelihood, predictions, and the evidence for families.

    maximise  ℓ(x) − ½ (x − mean)ᵀ Λ (x − mean),    x = (log s, η), Λ of `mixed.families`

by Newton's method with the average information. Where ℓ falls, the second derivative of the
logarithm adds to the curvature: without it the steps of absent families are several times too long.
A family that becomes small on the way has nearly no slope and would stay small. So, once
Newton's method has converged, the exact likelihood of each family's size, given the others, is
searched, and the iteration continues from the best size. The average information plus Λ
is the inverse covariance Σ of log s and η (Laplace).

The best linear unbiased prediction, with its uncertainty and that of the variances, is

    x* S c ± (x* (Cov + J Σ Jᵀ) x*ᵀ)^½

with Cov the covariance of the coordinates' errors at the estimated variances and J the sensitivity
of the coordinates to log s and η.

The evidence for a family is the restricted likelihood ratio against s_f = 0, given all others at
the standard deviations estimated without it. With Z_fᵀ P Z_f = U diag(μ) Uᵀ and
w_i = (Uᵀ Z_fᵀ P y)_i / √μ_i, which are N(0, 1) for an absent family,

    T = max over λ of  Σ_i [ w_i² λ μ_i / (1 + λ μ_i) − log(1 + λ μ_i) ],    0 ≤ λ = s_f² ≤ most²

λ is limited to plausible sizes: a family far larger than it can be would stand in for a mean that
the zero mean of another prior excludes, as a tracker's scale for gears that all yield in one
direction. The distribution of T under s_f = 0 has a point mass at zero and is simulated from the
μ_i with λ of any size: what a plausible size hardly gains is no evidence, however rare.

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
"""Gain of the log posterior below which the iteration ends; a choice: estimates are then within 1 %
of their standard error."""
MOST_JUMPS = 8  # most restarts of Newton's method from another size of one family; a choice
LEAST_GAIN = 0.01  # least gain of the log posterior for another restart; a choice
SIZES = np.linspace(-7.0, 7.0, 57)
"""Searched values of log s: a factor of 1000 either way in steps of a quarter; a choice."""
DAMPINGS = 12  # most increases of the damping in one step, tenfold each; a choice
DRAWS = 20_000  # simulated ratios: a p-value of 0.001 to 20 %; a choice
GRID = np.linspace(-12.0, 12.0, 97)
"""Tried values of log λ μ_max: steps of 0.25 give T to 0.01; a choice."""
RANK = 1e-9  # share of ‖Z_f‖² below which an eigenvalue is zero: other columns span its direction


@dataclass(frozen=True, eq=False)
class Variances:
    """Standard deviations of all families and of the noise."""

    equations: Equations  # at the estimate
    covariance: Floats  # (F + N, F + N) of log s and η

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
        start: (F + N,) where the iteration starts; else at the priors' means.
        search: whether other sizes of each family are searched. Where a size is far from that at
            which the problem was linearised, linearise anew.

    Raises:
        CannotAnswerError: the likelihood cannot be computed at the start.
    """
    mean, precision = problem.log_std_prior
    try:
        at_start = equations(problem, mean if start is None else start)
    except np.linalg.LinAlgError as error:
        raise CannotAnswerError("the mixed model's equations have no solution") from error
    maximum, best = _newton(at_start)
    for _ in range(MOST_JUMPS if search else 0):
        try:
            trial, value = _newton(equations(problem, _better_size(maximum)))
        except np.linalg.LinAlgError:
            break
        if value < best + LEAST_GAIN:
            break
        maximum, best = trial, value
    return Variances(maximum, np.asarray(np.linalg.inv(maximum.information + precision)))


def log_posterior(e: Equations) -> float:
    """ℓ plus the log prior, without constants."""
    mean, precision = e.problem.log_std_prior
    deviation = e.log_std - mean
    return e.log_likelihood - 0.5 * float(deviation @ precision @ deviation)


def _newton(e: Equations) -> tuple[Equations, float]:
    """Return the equations at the nearest maximum of the log posterior, and its value."""
    mean, precision = e.problem.log_std_prior
    best, damping = log_posterior(e), 0.0
    for _ in range(STEPS):
        slope = e.slope - precision @ (e.log_std - mean)
        # d²ℓ/dx² = 2 dℓ/dx + 4 λ² d²ℓ/dλ², λ = exp 2x: the average information is the second term.
        bend = np.maximum(-2.0 * e.slope, 0.0)
        curvature = e.information + precision + np.diag(bend)
        gain = 0.0
        for _ in range(DAMPINGS):
            damped = curvature + damping * np.diag(np.diagonal(curvature))
            step = np.linalg.solve(damped, slope)
            step *= min(1.0, LARGEST_STEP / float(np.abs(step).max(initial=1e-12)))
            try:
                trial = equations(e.problem, e.log_std + step)
                gain = log_posterior(trial) - best
            except np.linalg.LinAlgError:
                gain = -np.inf
            if gain >= 0.0:
                break
            damping = max(10.0 * damping, 1e-2)
        if gain < 0.0:
            break
        e, best, damping = trial, best + gain, 0.1 * damping if damping > 1e-3 else 0.0
        if gain < CONVERGED:
            break
    return e, best


def _better_size(e: Equations) -> Floats:
    """Log s and η (F + N,) with one log s changed to the plausible value that gains most.

    At the estimated errors of an arm its columns hardly differ from those of the frames in
    directions in which the nominal arm's do not at all. They follow the residual, and any misfit
    that is left, as of an unknown effect, seems to be explained by an enormous size along them.
    """
    mean, precision = e.problem.log_std_prior
    pull = precision @ (e.log_std - mean)
    out, most = e.log_std, 0.0
    for f, family in enumerate(e.problem.families.random):
        if family.known:
            continue
        step = SIZES - e.log_std[f]
        gain = e.profile(f, SIZES) - step * pull[f] - 0.5 * precision[f, f] * step**2
        k = int(np.argmax(np.where(np.exp(SIZES) <= family.largest, gain, -np.inf)))
        if gain[k] > most:
            out, most = e.log_std.copy(), float(gain[k])
            out[f] = SIZES[k]
    return out


def coordinates_covariance(variances: Variances) -> Floats:
    """(K, K) covariance of the errors of the coordinates."""
    j = variances.equations.sensitivity
    return np.asarray(variances.equations.covariance + j @ variances.covariance @ j.T)


@dataclass(frozen=True, slots=True)
class FamilyEvidence:
    """Evidence for a family or an effect."""

    ratio: float  # T, twice the gain of the restricted log likelihood
    p_value: float  # probability of a ratio as large without the family; 1 for rank 0
    rank: int  # number of its directions that the other columns do not span


def evidence(
    problem: MixedProblem,
    families: int | Sequence[int],
    rng: np.random.Generator,  # for the simulated ratios
    start: Floats | None = None,  # (F + N,) log s and η of all families; else priors' means
    largest: float = np.inf,  # largest plausible s, in ordinary magnitudes
) -> FamilyEvidence:
    """Return the evidence for a family, or for several families of one effect.

    Several families share one multiple of their ordinary standard deviations, the priors' means.
    """
    numbers = [families] if isinstance(families, int) else list(families)
    ordinary = np.exp([f.prior.mean for f in problem.families.random])
    tested = np.isin(problem.family, numbers)
    columns = problem.x[:, problem.flat :][:, tested] * ordinary[problem.family[tested]]
    null = estimate_variances(
        problem.without(numbers), None if start is None else np.delete(start, numbers)
    )
    inner, score = null.equations.score(columns)
    mu, u = np.linalg.eigh((inner + inner.T) / 2)
    visible = mu > RANK * max(float(np.sum(columns**2)), 1e-300)
    if not visible.any():
        return FamilyEvidence(0.0, 1.0, 0)
    mu = mu[visible]
    w2 = (u[:, visible].T @ score) ** 2 / mu
    bound = (largest / ordinary[numbers].max()) ** 2
    ratio = float(_ratios(mu, w2[None], bound)[0])
    drawn = _ratios(mu, rng.standard_normal((DRAWS, len(mu))) ** 2, np.inf)
    p = (1 + int(np.count_nonzero(drawn >= ratio))) / (1 + DRAWS) if ratio > 0 else 1.0
    return FamilyEvidence(ratio, float(p), len(mu))


def _ratios(mu: Floats, w2: Floats, bound: float) -> Floats:
    """Return T (D,) of squared w (D, r) with eigenvalues μ (r,), for λ up to `bound`."""
    lm = np.minimum(np.exp(GRID), bound * mu.max())[:, None] * (mu / mu.max())
    shrink, cost = lm / (1 + lm), np.log1p(lm).sum(axis=1)
    return np.asarray(np.maximum((w2 @ shrink.T - cost).max(axis=1), 0.0))
