"""Test, power and evidence of a family of columns that a fitted model lacks, without a refit.

With r the whitened residual of the model, M the projection off its columns (`schur`) and
X (R, P) the family's columns in ordinary magnitudes, everything follows from

    S = Xᵀ M X,    g = Xᵀ r,    ‖r‖²

The family is judged as a whole:

- p-value: F-test of all P columns; for a family that is large against the degrees of freedom,
  the variance-component test gᵀ g / ‖r‖² (Rao score of a common variance), whose null
  distribution is a ratio of quadratic forms. Both are exact for normal errors, also when the
  stated noise is wrong by a common factor.
- power: parameters β add the non-centrality λ = βᵀ S β to the reduction of the sum of squares. The
  F-test with k directions and ν − k degrees of freedom then follows the noncentral F distribution;
  where the noise is known (ν infinite) the test is the χ² test.
- evidence: with the conjugate prior β | σ² ~ N(0, σ² t² 1), p(σ²) ∝ 1/σ² and ν degrees of freedom
  of r, the logarithm of the marginal-likelihood ratio of the model with the family to that
  without it is

      −½ log det(1 + t² S) − ½ ν log(‖r‖²_t / ‖r‖²),    ‖r‖²_t = ‖r‖² − gᵀ (S + t⁻²)⁻¹ g

  and β | r is Student's with ν degrees of freedom, mean (S + t⁻²)⁻¹ g and scale matrix
  (‖r‖²_t / ν) (S + t⁻²)⁻¹. This is exact for a model without priors; for one with priors, ‖r‖²
  stands for rᵀ M⁻¹ r, which is larger by the penalty. t maximises the evidence.

If σ² = 1 were assumed, a misfit of variance factor φ would overstate the evidence of each direction
by about φ.

Sources: O'Hagan and Forster, *Bayesian Inference* (2004), chapter 11; Goeman, van de Geer and van
Houwelingen, *Testing against a high dimensional alternative*, J. R. Stat. Soc. B 68 (2006) 477-493;
Kuonen, *Saddlepoint approximations for distributions of quadratic forms in normal variables*,
Biometrika 86 (1999) 929-935; Lugannani and Rice, Adv. Appl. Prob. 12 (1980).
"""

from dataclasses import dataclass, field

import numpy as np
import scipy
from scipy.special import log_ndtr

from hilcal.types import Bools, Floats, Ints

VISIBLE = 1e-4  # eigenvalues of S below this are not tested: an ordinary magnitude along such a
# direction moves all data together by less than 0.01 σ; a guess
ROUNDING_SHARE = 1e-10  # eigenvalues of S below this share of the largest are rounding
NEAR_MEAN = 2e-3  # standard deviations about the mean in which Lugannani's formula loses digits
LARGE_FAMILY = 0.1  # share of the degrees of freedom from which a family is large; a guess
ROUNDING = 1e-12
STRENGTHS = np.logspace(-3, 3, 61)  # tried τ, in ordinary magnitudes; t² = τ² ν / ‖r‖²


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Eigenvalues and eigenvectors of S = U Λ Uᵀ (P, P)."""

    values: Floats  # (P,) ascending
    testable: Bools  # (P,) which of them are visible
    vectors: Floats  # (P, P) U, eigenvectors in columns

    @property
    def rank(self) -> int:
        """Number of visible directions."""
        return int(np.count_nonzero(self.testable))


def visible(values: Floats) -> Bools:
    """Return which eigenvalues (..., P) of S are large enough for a test of their directions."""
    largest = values.max(axis=-1, keepdims=True, initial=0.0)
    return np.asarray(values > np.maximum(VISIBLE, ROUNDING_SHARE * largest))


def spectrum(s: Floats) -> Spectrum:
    """Return the spectrum of S (P, P).

    Raises:
        LinAlgError: the eigenvalues do not converge, for example as S is not finite.
    """
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    return Spectrum(values, visible(values), vectors)


@dataclass(frozen=True, slots=True, eq=False)
class FamilyScore:
    """Test and evidence of a family."""

    p_value: float  # of the joint test
    log_evidence: float  # gain in log evidence by adding the family
    strength: float  # τ of the largest evidence
    ridge: float  # t⁻² at it, the parameters' prior precision; infinite where nothing is visible
    rank: int  # number of visible directions of the family
    effective: float  # effective number of parameters at that strength
    gain: float  # reduction of ‖r‖² at that strength
    delta_bic: float  # change of the Bayesian information criterion; negative favours the family
    step: Floats  # (P,) posterior mean of the parameters, in ordinary magnitudes
    spectrum: Spectrum | None  # of S; None where no direction is visible
    noise: float  # ‖r‖²_t / ν
    bounded: bool = False  # whether a strength above the largest plausible one has more evidence
    by_strength: Floats = field(default_factory=lambda: np.zeros(0))  # (T,) log evidence at each τ

    @property
    def marginal(self) -> float:
        """Log of the evidence averaged over strengths with a log-uniform prior.

        Without an effect exp(marginal) is 1 on average. The evidence at the best strength is
        larger, and grows with the number of families tried.
        """
        t = self.by_strength
        return float(np.logaddexp.reduce(t) - np.log(len(t))) if len(t) else 0.0

    @property
    def root(self) -> Floats:
        """(P, P) root of the posterior scale matrix; (0, 0) where no direction is visible."""
        s = self.spectrum
        if s is None:
            return np.zeros((0, 0))
        return s.vectors * np.sqrt(self.noise / (np.where(s.testable, s.values, 0.0) + self.ridge))


NO_EVIDENCE = FamilyScore(1.0, 0.0, 0.0, np.inf, 0, 0.0, 0.0, 0.0, np.zeros(0), None, 0.0)


def log_evidence(
    lam: Floats,  # (..., P) eigenvalues of S
    explained: Floats,  # (..., P) reduction of ‖r‖² by each eigenvector without a prior
    rss: float | Floats,  # (...) ‖r‖²
    dof: float,  # ν
    strengths: Floats = STRENGTHS,  # (T,) τ
) -> tuple[Floats, Floats]:
    """Return the log evidence (T, ...) of families at each strength τ, and ‖r‖²_t / ‖r‖²."""
    grown = 1.0 + np.multiply.outer(strengths**2, lam * np.expand_dims(dof / np.asarray(rss), -1))
    remaining = rss - explained.sum(axis=-1) + (explained / grown).sum(axis=-1)
    remaining = np.maximum(remaining / rss, ROUNDING)
    return -0.5 * np.log(grown).sum(axis=-1) - 0.5 * dof * np.log(remaining), remaining


@dataclass(frozen=True, slots=True, eq=False)
class FamilyTests:
    """Test and evidence of one family for each of K residuals."""

    p_value: Floats  # (K,) of the joint test
    by_strength: Floats  # (T, K) log evidence at each τ of a plausible size
    best: Ints  # (K,) index of the strength with the largest evidence
    bounded: Bools  # (K,) whether a strength above the largest plausible one has more evidence
    ridge: Floats  # (K,) t⁻² at the best strength

    @property
    def log_evidence(self) -> Floats:
        """(K,) gain in log evidence by adding the family."""
        return np.asarray(self.by_strength.max(axis=0))


def family_tests(
    eigen: Spectrum,  # of S, with a visible direction
    g: Floats,  # (P, K)
    rss: Floats,  # (K,) ‖r‖², above 0
    dof: float,
    spent: float = 0.0,
    largest: float = np.inf,
) -> FamilyTests:
    """Test a family for each of K residuals; arguments as of `score_family`."""
    testable, rank, free = eigen.testable, eigen.rank, dof - spent
    lam, c = eigen.values[testable], (eigen.vectors.T @ g)[testable].T
    explained = c**2 / lam
    if rank <= LARGE_FAMILY * free:
        gain = np.minimum(explained.sum(axis=1), (1 - ROUNDING) * rss)
        variance = np.maximum((rss - gain) / (free - rank), 1e-300)
        p_value = scipy.stats.f.sf(gain / rank / variance, rank, free - rank)
    else:
        ratio = np.sum(c**2, axis=1) / rss
        p_value = np.array([ratio_tail(lam, free, x) for x in ratio.tolist()])
    evidence, remaining = log_evidence(lam, explained, rss, dof)
    unbounded = np.argmax(evidence, axis=0)
    if np.isfinite(largest):
        # τ = t σ with σ² = ‖r‖²/ν, which contains what the family explains: use ‖r‖²_t instead.
        plausible = STRENGTHS[:, None] * np.sqrt(remaining) <= largest
        evidence = np.where(plausible, evidence, -np.inf)
        evidence[0] = np.maximum(evidence[0], -1e300)
    best = np.argmax(evidence, axis=0)
    ridge = rss / (dof * STRENGTHS[best] ** 2)
    return FamilyTests(np.asarray(p_value), evidence, best, best != unbounded, ridge)


def score_family(
    s: Floats | Spectrum,  # (P, P) S, or its spectrum
    g: Floats,  # (P,)
    rss: float,  # ‖r‖²
    dof: float,  # degrees of freedom ν of r
    spent: float = 0.0,
    largest: float = np.inf,
) -> FamilyScore:
    """Score a family.

    Args:
        spent: effective number of parameters of the model's families with a prior that `dof` does
            not count. They lower the degrees of freedom of the test; the evidence of their addition
            already contains their determinant.
        largest: largest plausible standard deviation of the parameters, for the evidence only.
    """
    eigen = s if isinstance(s, Spectrum) else spectrum(s)
    testable, rank = eigen.testable, eigen.rank
    if rank == 0 or rss <= 0 or dof - spent <= 1:
        return NO_EVIDENCE
    tests = family_tests(eigen, g[:, None], np.array([rss]), dof, spent, largest)
    evidence = tests.by_strength[:, 0]
    lam, c = eigen.values[testable], (eigen.vectors.T @ g)[testable]
    explained, small = c**2 / lam, rank <= LARGE_FAMILY * (dof - spent)
    best = int(tests.best[0])
    ridge = float(tests.ridge[0])
    shrunk = lam / (lam + ridge)
    effective, gain = float(shrunk.sum()), float(shrunk @ explained)
    full, count = (float(explained.sum()), rank) if small else (gain, effective)
    step = np.zeros(len(testable))
    step[testable] = shrunk * c / lam
    return FamilyScore(
        p_value=float(tests.p_value[0]),
        log_evidence=float(evidence[best]),
        strength=float(STRENGTHS[best]),
        ridge=ridge,
        rank=rank,
        effective=effective,
        gain=gain,
        delta_bic=dof * float(np.log(max(1 - full / rss, 1e-300))) + count * float(np.log(dof)),
        step=eigen.vectors @ step,
        spectrum=eigen,
        noise=max(rss - gain, ROUNDING * rss) / dof,
        bounded=bool(tests.bounded[0]),
        by_strength=evidence,
    )


def ratio_tail(eigenvalues: Floats, dimension: float, c: float) -> float:
    """Probability that a ratio of quadratic forms zᵀ L z / zᵀ z of z ~ N(0, I_R) exceeds c.

    This is P(Σ (λ_i − c) χ²_1 > 0), by the saddlepoint approximation of Lugannani and Rice; λ (K,)
    are the non-zero eigenvalues of L, R ≥ K is the `dimension`.
    """
    top = float(eigenvalues.max(initial=0.0))
    if c <= 0 or top <= 0:
        return 1.0
    if c >= top:
        return 0.0
    d = np.append(eigenvalues - c, -c)
    weight = np.append(np.ones(len(eigenvalues)), max(dimension - len(eigenvalues), 0.0))
    d, weight = d[weight > 0], weight[weight > 0]
    if d.min() >= 0:
        return 1.0
    scale = np.abs(d).max()
    d = d / scale

    from scipy.optimize import brentq  # slow to import

    def slope(t: float) -> float:
        return float(np.sum(weight * d / (1 - 2 * t * d)))

    # The cumulant generating function is finite for 1/(2 d_min) < t < 1/(2 d_max).
    low, high = 0.5 / d.min(), 0.5 / d.max()
    inside = 1 - 1e-9
    t = float(brentq(slope, low * inside, high * inside, xtol=1e-14, maxiter=500))
    cumulant = -0.5 * float(np.sum(weight * np.log1p(-2 * t * d)))
    curvature = 2 * float(np.sum(weight * (d / (1 - 2 * t * d)) ** 2))
    w = np.sign(t) * np.sqrt(max(-2 * cumulant, 0.0))
    v = t * np.sqrt(curvature)
    if abs(w) < NEAR_MEAN:
        # The formula is 0/0 at the mean: interpolate linearly across it.
        total = float(weight.sum())
        mean = float(eigenvalues.sum()) / total
        spread = np.sqrt(2 * float(np.sum(weight * (scale * d + c - mean) ** 2))) / total
        low, high = mean - 3 * NEAR_MEAN * spread, mean + 3 * NEAR_MEAN * spread
        p_low, p_high = (ratio_tail(eigenvalues, dimension, end) for end in (low, high))
        return float(p_low + (p_high - p_low) * (c - low) / (high - low))
    if w > 8:
        # Deep tail, in logarithms: sf(w) + φ(w) (1/v − 1/w)
        return float(np.exp(log_ndtr(-(w + np.log(v / w) / w))))
    return float(np.clip(scipy.stats.norm.sf(w + np.log(v / w) / w), 0.0, 1.0))


def family_power(s: Floats, beta: Floats, level: float, dof: float = np.inf) -> float:
    """Return the power of the test at `level` against the parameters β (P,) of a family with S.

    `dof` is that of the residual without the family, infinite for known noise. Where no direction
    of the family is visible, the power is the level.
    """
    eigen = spectrum(s)
    if eigen.rank == 0 or dof - eigen.rank < 1:
        return level
    noncentrality = float((eigen.values * (eigen.vectors.T @ beta) ** 2)[eigen.testable].sum())
    return power_of_test(noncentrality, eigen.rank, dof - eigen.rank, level)


def power_of_test(noncentrality: float, rank: int, dof: float, level: float) -> float:
    """Return the power of the F-test with `rank` and `dof` degrees of freedom."""
    if noncentrality <= 0.0:
        return level
    if np.isinf(dof):
        return float(scipy.stats.ncx2.sf(scipy.stats.chi2.isf(level, rank), rank, noncentrality))
    return float(scipy.stats.ncf.sf(scipy.stats.f.isf(level, rank, dof), rank, dof, noncentrality))


def noncentrality_of_power(rank: int, dof: float, level: float, power: float) -> float:
    """Return the non-centrality at which the F-test at `level` has the given power."""
    from scipy.optimize import brentq  # slow to import

    high = 10.0 * (rank + 1.0) + 4.0 * rank * float(scipy.stats.f.isf(level, rank, dof))

    def excess(value: float) -> float:
        return power_of_test(value, rank, dof, level) - power

    while excess(high) < 0.0:
        high *= 2.0
    return float(brentq(excess, 0.0, high, xtol=1e-6 * high))
