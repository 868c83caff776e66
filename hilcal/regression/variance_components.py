"""Variance components by restricted likelihood: of a fit's residual, and of a fleet of arms.

**Residual.** The residual of a model with the whitened columns B and the ridge Λ of their priors is

    y ~ N(B θ, Σ),    Σ = 1 + Σ_i s_i K_i,    s_i ≥ 0

with known block-diagonal matrices K_i: the whitened covariance of a further source of scatter of
unit variance. The s_i maximise the restricted likelihood, in which the parameters of the model are
integrated out, so that fitted parameters cost degrees of freedom:

    −2 ℓ = log det Σ + log det H + yᵀ P y,
    P = Σ⁻¹ − Σ⁻¹ B H⁻¹ Bᵀ Σ⁻¹,    H = Bᵀ Σ⁻¹ B + Λ

    ∂ℓ/∂s_i = −½ [tr(P K_i) − yᵀ P K_i P y],    AI_ij = ½ yᵀ P K_i P K_j P y

The maximum is found by Newton's method with the average information AI. Steps are halved until ℓ
does not fall; components at zero stay there while their slope is negative. AI⁻¹ is the covariance
of the s_i. Since only the diagonal blocks of P are needed, a step costs two products of B.

**Fleet.** Campaign c of arm a at time t estimated the parameters m_c with the information M_c
(singular where nothing was determined). With K parameters in ordinary magnitudes

    θ_c = μ + β t_c + u_a + e_c,    u_a ~ N(0, diag τ²),    e_c ~ N(0, diag ω²),
    m_c | θ_c ~ N(θ_c, M_c⁻¹)

μ and the common drift β are flat. The variances τ² between arms and ω² from campaign to campaign
maximise the restricted likelihood, by EM: with everything else integrated out, τ_k² is the mean of
E[u_ak²], and ω_k² the mean of E[e_ck²]. Elements of u_a that differ from those of the other arms
(`outlier`) have no prior and are excluded from the means.

Sources: Patterson and Thompson, *Recovery of inter-block information when block sizes are unequal*,
Biometrika 58 (1971) 545-554; Gilmour, Thompson and Cullis, *Average information REML*, Biometrics
51 (1995) 1440-1450; Laird and Ware, *Random-effects models for longitudinal data*, Biometrics 38
(1982) 963-974; Searle, Casella and McCulloch, *Variance Components* (1992), chapters 6 and 8.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
STEPS = 50  # most Newton steps; fewer than ten are usual
HALVINGS = 12  # most halvings of a step
CONVERGED = 1e-6  # gain of ℓ below which the iteration ends: the s_i are then within 0.002 σ
EM_STEPS = 400  # most EM steps; fleets of 30 arms take about 100
EM_CONVERGED = 1e-4  # relative change of all variances that ends EM, far below sampling errors
LEAST = 1e-8  # least variance, and least information on a parameter of an arm, in ordinary
# magnitudes; far below what measurements determine
FARTHEST = 10.0  # how far an arm's parameters may be off, in ordinary magnitudes; a choice
START = (1.0, 0.05)  # variances τ², ω² at the start of EM
UNDETERMINED = 5.0  # standard uncertainty, ordinary magnitudes, from which nothing is tested
TAIL = 0.025  # probability on either side of an interval of 95 %
FALSE_ALARM = 0.01  # probability that an element is named in a fleet without outliers
FEWEST = 5  # least number of arms for the test for outliers: three hardly have a spread
# Spreads τ between units, in ordinary magnitudes, and the means and widths of the prior of log τ
LOG_SPREADS = np.linspace(np.log(1e-3), np.log(300.0), 73)
SPREAD_MEANS = np.linspace(np.log(3e-3), np.log(3.0), 12)
SPREAD_WIDTHS = np.geomspace(0.4, 2.5, 8)


@dataclass(frozen=True, slots=True, eq=False)
class BlockRows:
    """Whitened rows in blocks of one size, G blocks of S rows."""

    y: Floats  # (G, S) residual
    rows: Floats  # (G, S, K) columns B of the model
    components: Floats  # (C, G, S, S) blocks of the K_i


@dataclass(frozen=True, slots=True, eq=False)
class VarianceComponents:
    """Result of the maximisation."""

    variance: Floats  # (C,) s_i
    covariance: Floats  # (C, C) of the s_i; zero for components held at zero
    log_likelihood: float  # gain of ℓ over all s_i = 0


def variance_components(blocks: Sequence[BlockRows], ridge: Floats) -> VarianceComponents:
    """Maximise the restricted likelihood, with Λ (K,), zero for a column without a prior."""
    count = len(blocks[0].components)
    zero = _evaluated(blocks, ridge, np.zeros(count))
    point = _evaluated(blocks, ridge, _start(blocks, count))
    if point.log_likelihood < zero.log_likelihood:
        point = zero
    for _ in range(STEPS):
        following = _step(blocks, ridge, point)
        gain = following.log_likelihood - point.log_likelihood
        point = following
        if gain < CONVERGED:
            break
    free = point.variance > 0
    covariance = np.zeros((count, count))
    inner = point.information[np.ix_(free, free)]
    covariance[np.ix_(free, free)] = positive_solve(inner, np.eye(len(inner)))
    return VarianceComponents(
        point.variance, covariance, point.log_likelihood - zero.log_likelihood
    )


@dataclass(frozen=True, slots=True, eq=False)
class _RemlPoint:
    """The s_i, ℓ, its slope (C,) and AI (C, C)."""

    variance: Floats
    log_likelihood: float
    slope: Floats
    information: Floats


def _start(blocks: Sequence[BlockRows], count: int) -> Floats:
    """Starting variances: the `count` components explain equal parts of the excess of yᵀy."""
    reach = sum(np.einsum("cgii->c", b.components) for b in blocks)
    size = sum(b.y.size for b in blocks)
    square = sum(float(np.sum(b.y**2)) for b in blocks)
    excess = max(square - size, 0.1 * size)
    return np.asarray(excess / np.maximum(reach, 1e-300) / count)


def _step(blocks: Sequence[BlockRows], ridge: Floats, point: _RemlPoint) -> _RemlPoint:
    """Take a Newton step, halved until ℓ does not fall."""
    free = (point.variance > 0) | (point.slope > 0)
    if not free.any():
        return point
    full = np.zeros_like(point.variance)
    inner = point.information[np.ix_(free, free)]
    full[free] = positive_solve(inner, point.slope[free])
    if float(full @ point.slope) <= 0:
        full = np.where(free, point.slope / np.maximum(np.diag(point.information), 1e-300), 0.0)
    for halving in range(HALVINGS):
        variance = np.maximum(point.variance + 0.5**halving * full, 0.0)
        trial = _evaluated(blocks, ridge, variance)
        if trial.log_likelihood >= point.log_likelihood:
            return trial
    return point


def _evaluated(blocks: Sequence[BlockRows], ridge: Floats, variance: Floats) -> _RemlPoint:
    inverses, log_det = [], 0.0
    h = np.diag(ridge).astype(float)
    for b in blocks:
        sigma = np.eye(b.y.shape[1]) + np.tensordot(variance, b.components, axes=1)
        low = np.linalg.cholesky(sigma)  # Σ ≥ 1
        log_det += 2 * float(np.log(np.diagonal(low, axis1=1, axis2=2)).sum())
        root = np.linalg.inv(low)
        inverses.append(np.swapaxes(root, 1, 2) @ root)
        white = _flat(root @ b.rows)
        h += white.T @ white
    t = inverse_root(h)
    triangular = not np.triu(t, 1).any()  # log det H on its range, from TᵀT = H⁻
    values = np.abs(np.diag(t)) if triangular else np.linalg.svd(t, compute_uv=False)
    log_det -= 2 * float(np.log(values[values > 0]).sum())
    weighted = [_flat(inverse @ b.rows) for inverse, b in zip(inverses, blocks, strict=True)]

    def project(x: list[Floats]) -> list[Floats]:
        """P x of columns (G, S, Q)."""
        cross = sum(w.T @ _flat(part) for w, part in zip(weighted, x, strict=True))
        step = t.T @ (t @ cross)
        parts = zip(inverses, weighted, x, strict=True)
        return [inverse @ part - (w @ step).reshape(part.shape) for inverse, w, part in parts]

    py = [part[:, :, 0] for part in project([b.y[:, :, None] for b in blocks])]
    square = sum(float(np.sum(b.y * p)) for b, p in zip(blocks, py, strict=True))
    trace = np.zeros(len(variance))
    moved = []
    for b, inverse, w, p in zip(blocks, inverses, weighted, py, strict=True):
        root = (w @ t.T).reshape(*b.y.shape, len(t))
        diagonal_block = inverse - root @ np.swapaxes(root, 1, 2)
        trace += np.einsum("gij,cgji->c", diagonal_block, b.components)
        moved.append(np.einsum("cgij,gj->gic", b.components, p))
    turned = project(moved)
    pairs = list(zip(moved, py, strict=True))
    quadratic = sum(np.einsum("gic,gi->c", u, p) for u, p in pairs)
    information = sum(np.einsum("gic,gid->cd", u, v) for u, v in zip(moved, turned, strict=True))
    return _RemlPoint(
        variance,
        -0.5 * (log_det + square),
        np.asarray(-0.5 * (trace - quadratic)),
        np.asarray(0.25 * (information + np.transpose(information))),
    )


def _flat(x: Floats) -> Floats:
    return x.reshape(-1, x.shape[2])


@dataclass(frozen=True, slots=True, eq=False)
class FleetEstimates:
    """Estimates of K parameters by C campaigns of A arms, in ordinary magnitudes."""

    mean: Floats  # (C, K)
    information: Floats  # (C, K, K)
    arm: Ints  # (C,) number of the arm
    time: Floats  # (C,) time since the arm's first campaign

    @property
    def arms(self) -> int:
        """Number of arms A."""
        return int(self.arm.max()) + 1

    @property
    def repeated(self) -> bool:
        """Whether any arm was measured more than once."""
        return len(self.arm) > self.arms


@dataclass(frozen=True, slots=True, eq=False)
class Hierarchy:
    """The fitted model of a fleet."""

    mu: Floats  # (K,) μ
    slope: Floats  # (K,) β per unit of time; zero where no arm was measured at two times
    covariance: Floats  # (2 K, 2 K) of (μ, β)
    between: Floats  # (K,) τ²
    within: Floats  # (K,) ω²; zero where no arm was measured twice
    arm_mean: Floats  # (A, K) μ + u_a of each arm alone, with the prior of `FARTHEST`
    arm_variance: Floats  # (A, K) its variance by the fits and ω²
    outlier: Bools  # (A, K) elements that differ from those of the other arms

    @property
    def predictive(self) -> Floats:
        """(K, K) covariance of a further arm's parameters in its first campaign.

        A spread of few arms is uncertain: with A arms that determine a parameter, its prediction is
        Student's with A − 1 degrees of freedom, and the normal one has its 95 % interval.
        """
        k = len(self.mu)
        arms = np.sum((self.arm_variance < UNDETERMINED**2) & ~self.outlier, axis=0)
        wider = scipy.stats.t.isf(TAIL, np.maximum(arms - 1, 1)) / scipy.stats.norm.isf(TAIL)
        covariance = self.covariance[:k, :k] + np.diag(self.between + self.within)
        return np.asarray(covariance * np.outer(wider, wider))

    @property
    def between_std_error(self) -> Floats:
        """(K,) standard error of τ, by the expected information of τ² over the arms."""
        weight = 1.0 / (self.between + self.arm_variance) ** 2
        variance_error = np.sqrt(
            2.0 / np.maximum(np.sum(np.where(self.outlier, 0.0, weight), axis=0), LEAST)
        )
        return np.asarray(variance_error / (2 * np.sqrt(np.maximum(self.between, LEAST))))


@dataclass(frozen=True, slots=True)
class Outlier:
    """An element that differs from those of the other units."""

    unit: int  # number of the arm, or of the campaign
    parameter: int  # index
    deviation: float  # deviation from the mean of the others, ordinary magnitudes
    sigma: float  # its size in standard deviations predicted from the others
    p_value: float  # corrected for the number of tested elements


def hierarchy(estimates: FleetEstimates) -> tuple[Hierarchy, tuple[Outlier, ...]]:
    """Fit the model, name the elements that differ, and fit again without a prior for these."""
    outlier = np.zeros((estimates.arms, estimates.mean.shape[1]), dtype=bool)
    fitted = _em(estimates, outlier)
    named = find_outliers(fitted.arm_mean, fitted.arm_variance)
    for element in named:
        outlier[element.unit, element.parameter] = True
    return (_em(estimates, outlier) if named else fitted), named


def find_outliers(values: Floats, variance: Floats) -> tuple[Outlier, ...]:
    """Name elements of values (U, K), of variance (U, K), that differ from those of other units.

    Element i of a parameter is compared with its distribution predicted from the other units,

        p_i = ∫ 2 Φ(−|y_i − m(τ)| / √(τ² + s_i² + v(τ))) p(τ | others) dτ

    with their mean m, its variance v, and the restricted likelihood of their spread τ under a prior
    log τ ~ N(a, b²). The spreads of the other parameters determine a and b, which have uniform
    priors on a grid: where the parameters' spreads are alike, few units suffice. `FALSE_ALARM`
    holds for all elements together (Bonferroni). Values with a variance above `UNDETERMINED`² are
    ignored.
    """
    determined = variance < UNDETERMINED**2
    tests = max(int(determined.sum()), 1)
    kernels = _log_kernels()  # (H, T)
    of_all = np.zeros((values.shape[1], len(LOG_SPREADS)))
    for k, known in enumerate(determined.T):
        if known.sum() > 1:
            of_all[k] = _given_spread(values[known, k], variance[known, k])[2]
    evidence = scipy.special.logsumexp(of_all[:, None] + kernels, axis=2)  # (K, H)
    others = evidence.sum(axis=0) - evidence
    named: list[Outlier] = []
    for k in range(values.shape[1]):
        units = np.flatnonzero(determined[:, k])
        if len(units) < FEWEST:
            continue
        weight = scipy.special.log_softmax(others[k])
        prior = scipy.special.logsumexp(weight[:, None] + kernels, axis=0)
        for unit in units.tolist():
            rest = units[units != unit]
            mean, mean_variance, likelihood = _given_spread(values[rest, k], variance[rest, k])
            share = scipy.special.softmax(likelihood + prior)
            off = values[unit, k] - mean
            square = np.exp(2 * LOG_SPREADS) + variance[unit, k] + mean_variance
            p = tests * float(share @ (2 * scipy.stats.norm.sf(np.abs(off) / np.sqrt(square))))
            if p < FALSE_ALARM:
                expected = float(share @ off)
                sd = np.sqrt(share @ (square + (off - expected) ** 2))
                named.append(Outlier(unit, k, expected, float(abs(expected) / sd), p))
    return tuple(sorted(named, key=lambda element: element.p_value))


def _log_kernels() -> Floats:
    """Log priors (H, T) of log τ on its grid, of each mean a and each width b."""
    a, b = np.meshgrid(SPREAD_MEANS, SPREAD_WIDTHS)
    standard = (LOG_SPREADS - a.reshape(-1, 1)) / b.reshape(-1, 1)
    return np.asarray(scipy.special.log_softmax(-0.5 * standard**2, axis=1))


def _given_spread(y: Floats, variance: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean of units, its variance, and the restricted log likelihood, (T,) for each spread τ."""
    total = np.exp(2 * LOG_SPREADS)[:, None] + np.maximum(variance, LEAST)
    precision = np.sum(1.0 / total, axis=1)
    mean = np.sum(y / total, axis=1) / precision
    square = np.sum((y - mean[:, None]) ** 2 / total, axis=1)
    likelihood = -0.5 * (np.log(total).sum(axis=1) + np.log(precision) + square)
    return mean, 1.0 / precision, likelihood


def _em(fleet: FleetEstimates, outlier: Bools) -> Hierarchy:
    k, repeated = fleet.mean.shape[1], fleet.repeated
    timed = repeated and bool(np.ptp(fleet.time) > 0)
    tau2 = np.full(k, START[0])
    omega2 = np.full(k, START[1] if repeated else 0.0)
    normal = np.maximum((~outlier).sum(axis=0), 1)
    in_repeated = np.bincount(fleet.arm, minlength=fleet.arms)[fleet.arm] > 1
    for _ in range(EM_STEPS):
        _, _, u2, e2, _, _ = _expectation(fleet, tau2, omega2, outlier, timed)
        previous = np.concatenate([tau2, omega2])
        tau2 = np.maximum(np.where(outlier, 0.0, u2).sum(axis=0) / normal, LEAST)
        if repeated:
            omega2 = np.maximum(e2[in_repeated].mean(axis=0), LEAST)
        change = np.concatenate([tau2, omega2]) - previous
        if np.abs(change / np.maximum(previous, LEAST)).max() < EM_CONVERGED:
            break
    b, b_cov, _, _, mean, variance = _expectation(fleet, tau2, omega2, outlier, timed)
    covariance = np.zeros((2 * k, 2 * k))
    covariance[: len(b), : len(b)] = b_cov
    slope = b[k:] if timed else np.zeros(k)
    return Hierarchy(b[:k], slope, covariance, tau2, omega2, mean, variance, outlier.copy())


def _expectation(
    fleet: FleetEstimates, tau2: Floats, omega2: Floats, outlier: Bools, timed: bool
) -> tuple[Floats, ...]:
    """E-step: b = (μ, β) and its covariance; E[u²], E[e²]; means of arms alone, and variances."""
    k, m, eye = fleet.mean.shape[1], fleet.information, np.eye(fleet.mean.shape[1])
    # e_c integrated out: N = (M⁻¹ + Ω)⁻¹ = (1 + M Ω)⁻¹ M
    n = np.linalg.solve(eye + m * omega2, m)
    n = (n + np.swapaxes(n, 1, 2)) / 2
    design = np.tile(eye, (len(m), 1, 1))
    if timed:
        design = np.concatenate([design, fleet.time[:, None, None] * eye], axis=2)
    nx, ny = n @ design, np.einsum("cij,cj->ci", n, fleet.mean)

    def of_arms(x: Floats) -> Floats:
        out = np.zeros((fleet.arms, *x.shape[1:]))
        np.add.at(out, fleet.arm, x)
        return out

    sum_n, sum_nx, sum_ny = of_arms(n), of_arms(nx), of_arms(ny)
    precision = np.where(outlier, LEAST, 1.0 / np.maximum(tau2, LEAST))
    u_cov = np.linalg.inv(sum_n + precision[:, :, None] * eye)
    h = np.einsum("cki,ckj->ij", design, nx) - np.einsum("aki,akl,alj->ij", sum_nx, u_cov, sum_nx)
    g = np.einsum("cki,ck->i", design, ny) - np.einsum("aki,akl,al->i", sum_nx, u_cov, sum_ny)
    b_cov = np.linalg.inv((h + h.T) / 2 + LEAST * np.eye(len(h)))
    b = b_cov @ g
    # u_a = C_a (Σ N m − Σ N X b)
    by_b = u_cov @ sum_nx
    u = np.einsum("akl,al->ak", u_cov, sum_ny) - by_b @ b
    u_full = u_cov + by_b @ b_cov @ np.swapaxes(by_b, 1, 2)
    u2 = u**2 + np.diagonal(u_full, axis1=1, axis2=2)
    # e_c = Ω N (m − X b − u_a)
    left = fleet.mean - np.einsum("cij,j->ci", design, b) - u[fleet.arm]
    gain = omega2[:, None] * n
    e = np.einsum("cij,cj->ci", gain, left)
    toward = design - by_b[fleet.arm]
    left_cov = u_cov[fleet.arm] + toward @ b_cov @ np.swapaxes(toward, 1, 2)
    spread = np.diag(omega2) - gain * omega2 + gain @ left_cov @ np.swapaxes(gain, 1, 2)
    e2 = e**2 + np.diagonal(spread, axis1=1, axis2=2)
    alone = np.linalg.inv(sum_n + eye / FARTHEST**2)
    drift = fleet.time[:, None] * b[k:] if timed else np.zeros_like(fleet.mean)
    without_drift = of_arms(np.einsum("cij,cj->ci", n, fleet.mean - drift))
    arm_mean = np.einsum("akl,al->ak", alone, without_drift)
    return b, b_cov, u2, e2, arm_mean, np.diagonal(alone, axis1=1, axis2=2).copy()
