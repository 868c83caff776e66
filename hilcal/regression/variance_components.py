"""Variance components by restricted likelihood: of a fit's residual, and of units of a kind.

**Residual.** That of a model with the whitened columns B and the ridge Λ of their priors is

    y ~ N(B θ, Σ),    Σ = 1 + Σ_i s_i K_i,    s_i ≥ 0

with known block-diagonal matrices K_i: what a further source of scatter of unit variance would add
to the whitened noise. The s_i maximise the restricted likelihood, in which the parameters of the
model are integrated out, so that those that were fitted cost degrees of freedom:

    −2 ℓ = log det Σ + log det H + yᵀ P y,
    P = Σ⁻¹ − Σ⁻¹ B H⁻¹ Bᵀ Σ⁻¹,    H = Bᵀ Σ⁻¹ B + Λ

    ∂ℓ/∂s_i = −½ [tr(P K_i) − yᵀ P K_i P y],    AI_ij = ½ yᵀ P K_i P K_j P y

The maximum is found by Newton's method with the average information AI, steps halved until ℓ does
not fall, components at zero held there while their slope is negative. AI⁻¹ is the covariance of
the s_i. Since P enters by its diagonal blocks alone, a step costs two products of B.

**Units.** Campaign c of arm a at time t found the parameters m_c with the information M_c (singular
where nothing was determined). With K parameters in ordinary magnitudes

    θ_c = μ + β t_c + u_a + e_c,    u_a ~ N(0, diag τ²),    e_c ~ N(0, diag ω²),
    m_c | θ_c ~ N(θ_c, M_c⁻¹)

μ and the common drift β are flat; the variances τ² between arms and ω² from campaign to campaign
maximise the restricted likelihood, by EM: with everything else integrated out, τ_k² is the mean of
E[u_ak²], ω_k² that of E[e_ck²]. Elements of u_a that are known to be unlike the others (`apart`)
have no prior, and count in no mean.

Sources: Patterson and Thompson, *Recovery of inter-block information when block sizes are unequal*,
Biometrika 58 (1971) 545-554; Gilmour, Thompson and Cullis, *Average information REML*, Biometrics
51 (1995) 1440-1450; Laird and Ware, *Random-effects models for longitudinal data*, Biometrics 38
(1982) 963-974; Searle, Casella and McCulloch, *Variance Components* (1992), chapters 6 and 8.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

STEPS = 50  # most Newton steps; a choice, fewer than ten are usual
HALVINGS = 12  # most halvings of a step; a choice
CONVERGED = 1e-6
"""Gain of ℓ that ends the iteration: the s_i are then within 0.002 of their σ; a choice."""
EM_STEPS = 400  # most EM steps; a choice: fleets of 30 arms take about 100
EM_CONVERGED = 1e-4
"""Relative change of every variance that ends EM; a choice, far below their sampling error."""
LEAST = 1e-8
"""Least variance, and least information of a parameter of an arm, in ordinary magnitudes squared;
below every measurement: a choice."""
START = (1.0, 0.05)  # variances τ², ω² that EM starts from; a choice
UNDETERMINED = 5.0
"""Standard uncertainty of an arm's parameter, in ordinary magnitudes, from which on nothing is said
of it; a choice."""
FALSE_ALARM = 0.01
"""Probability that anything is named in a fleet where nothing is unlike; a choice."""
FEWEST = 5
"""Arms that are needed to call one unlike the others; a choice: three hardly have a spread."""


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
    covariance: Floats  # (C, C) of the s_i; zero for one that is held at zero
    log_likelihood: float  # gain of ℓ over all s_i = 0


def variance_components(blocks: Sequence[BlockRows], ridge: Floats) -> VarianceComponents:
    """Maximise the restricted likelihood, with Λ (K,), zero for a column without a prior."""
    count = len(blocks[0].components)
    zero = _at(blocks, ridge, np.zeros(count))
    here = _at(blocks, ridge, _start(blocks, zero))
    if here.log_likelihood < zero.log_likelihood:
        here = zero
    for _ in range(STEPS):
        following = _step(blocks, ridge, here)
        gain = following.log_likelihood - here.log_likelihood
        here = following
        if gain < CONVERGED:
            break
    free = here.variance > 0
    covariance = np.zeros((count, count))
    inner = here.information[np.ix_(free, free)]
    covariance[np.ix_(free, free)] = positive_solve(inner, np.eye(len(inner)))
    gained = here.log_likelihood - zero.log_likelihood
    return VarianceComponents(here.variance, covariance, gained)


@dataclass(frozen=True, slots=True, eq=False)
class _RemlPoint:
    """The s_i, ℓ, its slope (C,) and AI (C, C)."""

    variance: Floats
    log_likelihood: float
    slope: Floats
    information: Floats


def _start(blocks: Sequence[BlockRows], zero: _RemlPoint) -> Floats:
    """Each component alone would explain the excess of yᵀPy; all together share it."""
    reach = sum(np.einsum("cgii->c", b.components) for b in blocks)
    size = sum(b.y.size for b in blocks)
    square = sum(float(np.sum(b.y**2)) for b in blocks)
    excess = max(square - size, 0.1 * size)
    return np.asarray(excess / np.maximum(reach, 1e-300) / len(zero.variance))


def _step(blocks: Sequence[BlockRows], ridge: Floats, here: _RemlPoint) -> _RemlPoint:
    """Go up, half as far each time while ℓ falls."""
    free = (here.variance > 0) | (here.slope > 0)
    if not free.any():
        return here
    full = np.zeros_like(here.variance)
    inner = here.information[np.ix_(free, free)]
    full[free] = positive_solve(inner, here.slope[free])
    if float(full @ here.slope) <= 0:
        full = np.where(free, here.slope / np.maximum(np.diag(here.information), 1e-300), 0.0)
    for halving in range(HALVINGS):
        trial = np.maximum(here.variance + 0.5**halving * full, 0.0)
        there = _at(blocks, ridge, trial)
        if there.log_likelihood >= here.log_likelihood:
            return there
    return here


def _at(blocks: Sequence[BlockRows], ridge: Floats, variance: Floats) -> _RemlPoint:
    """Evaluate ℓ, its slope and AI."""
    inverses, log_det = [], 0.0
    h = np.diag(ridge).astype(float)
    for b in blocks:
        sigma = np.eye(b.y.shape[1]) + np.tensordot(variance, b.components, axes=1)
        low = np.linalg.cholesky(sigma)  # at least 1
        log_det += 2 * float(np.log(np.diagonal(low, axis1=1, axis2=2)).sum())
        root = np.linalg.inv(low)
        inverses.append(np.swapaxes(root, 1, 2) @ root)
        white = _flat(root @ b.rows)
        h += white.T @ white
    t = inverse_root(h)
    log_det += _log_det(t)
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
        seen = (w @ t.T).reshape(*b.y.shape, len(t))
        own = inverse - seen @ np.swapaxes(seen, 1, 2)
        trace += np.einsum("gij,cgji->c", own, b.components)
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
    """(G·S, Q) rows of blocks (G, S, Q)."""
    return x.reshape(-1, x.shape[2])


def _log_det(t: Floats) -> float:
    """Return log det H on its range, of T with Tᵀ T = H⁻."""
    triangular = not np.triu(t, 1).any()
    values = np.abs(np.diag(t)) if triangular else np.linalg.svd(t, compute_uv=False)
    return float(-2 * np.log(values[values > 0]).sum())


@dataclass(frozen=True, slots=True, eq=False)
class FleetEstimates:
    """What C campaigns of A arms found of K parameters, in ordinary magnitudes."""

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
    """The fitted model."""

    mu: Floats  # (K,) μ
    slope: Floats  # (K,) β per unit of time; zero where no arm was measured at two times
    covariance: Floats  # (2 K, 2 K) of (μ, β)
    between: Floats  # (K,) τ²
    within: Floats  # (K,) ω²; zero where no arm was measured twice
    arm_mean: Floats  # (A, K) each arm by itself: μ + u_a, without the prior of the others
    arm_variance: Floats  # (A, K) its variance by the fits and ω²
    apart: Bools  # (A, K) elements that are unlike the other arms'

    @property
    def predictive(self) -> Floats:
        """(K, K) covariance of another arm's parameters in its first campaign."""
        k = len(self.mu)
        return np.asarray(self.covariance[:k, :k] + np.diag(self.between + self.within))

    @property
    def between_std_error(self) -> Floats:
        """(K,) standard error of τ, by the expected information of τ² over the arms."""
        weight = 1.0 / (self.between + self.arm_variance) ** 2
        of_square = np.sqrt(
            2.0 / np.maximum(np.sum(np.where(self.apart, 0.0, weight), axis=0), LEAST)
        )
        return np.asarray(of_square / (2 * np.sqrt(np.maximum(self.between, LEAST))))


@dataclass(frozen=True, slots=True)
class Unlike:
    """One element that is unlike the others."""

    unit: int  # number of the arm, or of the campaign
    parameter: int  # index
    off: float  # by how much, ordinary magnitudes
    sigma: float  # the same in standard deviations of what the others let expect
    p_value: float  # of that among all that were looked at


def hierarchy(of: FleetEstimates) -> tuple[Hierarchy, tuple[Unlike, ...]]:
    """Fit the model, name what is unlike, and fit again without it."""
    apart = np.zeros((of.arms, of.mean.shape[1]), dtype=bool)
    found = _em(of, apart)
    named = unlike(found.arm_mean, found.arm_variance)
    for one in named:
        apart[one.unit, one.parameter] = True
    return (_em(of, apart) if named else found), named


def unlike(values: Floats, variance: Floats) -> tuple[Unlike, ...]:
    """Name elements of values (U, K), of variance (U, K), that are unlike those of other units.

    Each is compared with the distribution of the others, of which it is no part: mean, and the
    variance beyond that of the values themselves. The worst is taken out first. `FALSE_ALARM`
    holds for all elements together (Bonferroni), by Student's t of the others' number. Values with
    a variance above `UNDETERMINED`² are left out.
    """
    known = variance < UNDETERMINED**2
    tests = max(int(known.sum()), 1)
    named: list[Unlike] = []
    for k in range(values.shape[1]):
        mine = np.flatnonzero(known[:, k])
        while len(mine) >= FEWEST and len(mine) > 0.8 * known[:, k].sum():
            y, s2 = values[mine, k], variance[mine, k]
            away = []
            for i in range(len(mine)):
                tau2, mean, of_mean = _others(np.delete(y, i), np.delete(s2, i))
                away.append((y[i] - mean, np.sqrt(tau2 + s2[i] + of_mean)))
            off, sd = np.array(away).T
            worst = int(np.argmax(np.abs(off / sd)))
            sigma = abs(float(off[worst] / sd[worst]))
            p = min(1.0, 2 * tests * float(student.sf(sigma, len(mine) - 2)))
            if p >= FALSE_ALARM:
                break
            named.append(Unlike(int(mine[worst]), k, float(off[worst]), sigma, p))
            mine = np.delete(mine, worst)
    return tuple(sorted(named, key=lambda one: one.p_value))


def _others(y: Floats, variance: Floats) -> tuple[float, float, float]:
    """Variance of units beyond that of their errors, by REML's fixed point; mean, its variance."""
    s2 = np.maximum(variance, LEAST)
    tau2 = max(float(np.var(y, ddof=1) - s2.mean()), 0.0)
    for _ in range(50):
        w = 1.0 / (tau2 + s2)
        mean = float(w @ y / w.sum())
        change = float(w**2 @ ((y - mean) ** 2 - s2) / (w**2).sum() + 1.0 / w.sum())
        tau2, before = max(change, 0.0), tau2
        if abs(tau2 - before) <= EM_CONVERGED * max(tau2, LEAST):
            break
    w = 1.0 / (tau2 + variance)
    return tau2, float(w @ y / w.sum()), 1.0 / float(w.sum())


def _em(of: FleetEstimates, apart: Bools) -> Hierarchy:
    k, repeated = of.mean.shape[1], of.repeated
    timed = repeated and bool(np.ptp(of.time) > 0)
    tau2 = np.full(k, START[0])
    omega2 = np.full(k, START[1] if repeated else 0.0)
    normal = np.maximum((~apart).sum(axis=0), 1)
    many = np.bincount(of.arm, minlength=of.arms)[of.arm] > 1
    for _ in range(EM_STEPS):
        e = _expectation(of, tau2, omega2, apart, timed)
        before = np.concatenate([tau2, omega2])
        tau2 = np.maximum(np.where(apart, 0.0, e.u2).sum(axis=0) / normal, LEAST)
        if repeated:
            omega2 = np.maximum(e.e2[many].mean(axis=0), LEAST)
        now = np.concatenate([tau2, omega2])
        if np.abs((now - before) / np.maximum(before, LEAST)).max() < EM_CONVERGED:
            break
    e = _expectation(of, tau2, omega2, apart, timed)
    whole = np.zeros((2 * k, 2 * k))
    size = len(e.b)
    whole[:size, :size] = e.covariance
    slope = e.b[k:] if timed else np.zeros(k)
    return Hierarchy(e.b[:k], slope, whole, tau2, omega2, e.arm_mean, e.arm_variance, apart.copy())


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    b: Floats
    covariance: Floats
    u2: Floats
    e2: Floats
    arm_mean: Floats
    arm_variance: Floats


def _expectation(
    of: FleetEstimates, tau2: Floats, omega2: Floats, apart: Bools, timed: bool
) -> _Expected:
    """E-step: the joint normal distribution of b = (μ, β), u and e, given the variances."""
    k, m, eye = of.mean.shape[1], of.information, np.eye(of.mean.shape[1])
    # e_c integrated out: N = (M⁻¹ + Ω)⁻¹ = (1 + M Ω)⁻¹ M
    n = np.linalg.solve(eye + m * omega2, m)
    n = (n + np.swapaxes(n, 1, 2)) / 2
    design = np.tile(eye, (len(m), 1, 1))
    if timed:
        design = np.concatenate([design, of.time[:, None, None] * eye], axis=2)
    nx, ny = n @ design, np.einsum("cij,cj->ci", n, of.mean)

    def of_arms(x: Floats) -> Floats:
        """Sums (A, ...) over the campaigns of each arm."""
        out = np.zeros((of.arms, *x.shape[1:]))
        np.add.at(out, of.arm, x)
        return out

    sum_n, sum_nx, sum_ny = of_arms(n), of_arms(nx), of_arms(ny)
    precision = np.where(apart, LEAST, 1.0 / np.maximum(tau2, LEAST))
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
    left = of.mean - np.einsum("cij,j->ci", design, b) - u[of.arm]
    gain = omega2[:, None] * n
    e = np.einsum("cij,cj->ci", gain, left)
    toward = design - by_b[of.arm]
    rest = u_cov[of.arm] + toward @ b_cov @ np.swapaxes(toward, 1, 2)
    spread = np.diag(omega2) - gain * omega2 + gain @ rest @ np.swapaxes(gain, 1, 2)
    e2 = e**2 + np.diagonal(spread, axis1=1, axis2=2)
    alone = np.linalg.inv(sum_n + LEAST * eye)
    drifted = of.time[:, None] * b[k:] if timed else np.zeros_like(of.mean)
    own = of_arms(np.einsum("cij,cj->ci", n, of.mean - drifted))
    arm_mean = np.einsum("akl,al->ak", alone, own)
    return _Expected(b, b_cov, u2, e2, arm_mean, np.diagonal(alone, axis1=1, axis2=2).copy())
