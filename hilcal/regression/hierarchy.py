"""What units of a kind have in common, in what they differ, and how they change: empirical Bayes.

Campaign c of arm a at time t found the parameters m_c with the information M_c (singular where
nothing was determined). With K parameters in ordinary magnitudes

    θ_c = μ + β t_c + u_a + e_c,    u_a ~ N(0, diag τ²),    e_c ~ N(0, diag ω²),
    m_c | θ_c ~ N(θ_c, M_c⁻¹)

μ and the common drift β are flat; the variances τ² between arms and ω² from campaign to campaign
maximise the restricted likelihood, by EM: with everything else integrated out, τ_k² is the mean of
E[u_ak²], ω_k² that of E[e_ck²]. Elements of u_a that are known to be unlike the others (`apart`)
have no prior, and count in no mean.

Sources: Laird and Ware, *Random-effects models for longitudinal data*, Biometrics 38 (1982)
963-974; Searle, Casella and McCulloch, *Variance Components* (1992), chapter 8.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import t as student

from hilcal.types import Bools, Floats, Ints

STEPS = 400
"""Most EM steps; a choice: fleets of 30 arms take about 100."""
CONVERGED = 1e-4
"""Relative change of every variance that ends EM; a choice, far below their sampling error."""
LEAST = 1e-8
"""Least variance, and least information of a parameter of an arm, in ordinary magnitudes squared;
below every measurement: a choice."""
START = (1.0, 0.05)
"""Variances τ², ω² that EM starts from; a choice."""
UNDETERMINED = 5.0
"""Standard uncertainty of an arm's parameter, in ordinary magnitudes, from which on nothing is said
of it; a choice."""
FALSE_ALARM = 0.01
"""Probability that anything is named in a fleet where nothing is unlike; a choice."""
FEWEST = 5
"""Arms that are needed to call one unlike the others; a choice: three hardly have a spread."""


@dataclass(frozen=True, slots=True, eq=False)
class FleetEstimates:
    """What C campaigns of A arms found of K parameters, in ordinary magnitudes.

    Attributes:
        mean: (C, K).
        information: (C, K, K).
        arm: (C,) number of the arm.
        time: (C,) time since the arm's first campaign.
    """

    mean: Floats
    information: Floats
    arm: Ints
    time: Floats

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
    """The fitted model.

    Attributes:
        mu: (K,) μ.
        slope: (K,) β per unit of time; zero where no arm was measured at two times.
        covariance: (2 K, 2 K) of (μ, β).
        between: (K,) τ².
        within: (K,) ω²; zero where no arm was measured twice.
        arm_mean: (A, K) each arm by itself: μ + u_a, without the prior of the others.
        arm_variance: (A, K) its variance by the fits and ω².
        apart: (A, K) elements that are unlike the other arms'.
    """

    mu: Floats
    slope: Floats
    covariance: Floats
    between: Floats
    within: Floats
    arm_mean: Floats
    arm_variance: Floats
    apart: Bools

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
    """One element that is unlike the others.

    Attributes:
        unit: number of the arm, or of the campaign.
        parameter: index.
        off: by how much, ordinary magnitudes.
        sigma: the same in standard deviations of what the others let expect.
        p_value: of that among all that were looked at.
    """

    unit: int
    parameter: int
    off: float
    sigma: float
    p_value: float


def hierarchy(of: FleetEstimates) -> tuple[Hierarchy, tuple[Unlike, ...]]:
    """Fit the model, name what is unlike, and fit again without it."""
    apart = np.zeros((of.arms, of.mean.shape[1]), dtype=bool)
    found = _em(of, apart)
    named = unlike(found.arm_mean, found.arm_variance)
    for one in named:
        apart[one.unit, one.parameter] = True
    return (_em(of, apart) if named else found), named


def unlike(values: Floats, variance: Floats) -> tuple[Unlike, ...]:
    """Name elements of (U, K) values that are unlike those of the other units.

    Each is compared with the distribution of the others, of which it is no part: mean, and the
    variance beyond that of the values themselves. The worst is taken out first. `FALSE_ALARM`
    holds for all elements together (Bonferroni), by Student's t of the others' number.

    Args:
        values: (U, K).
        variance: (U, K) of their errors; those above `UNDETERMINED`² are left out.
    """
    known = variance < UNDETERMINED**2
    tests = max(int(known.sum()), 1)
    named: list[Unlike] = []
    for k in range(values.shape[1]):
        mine = np.flatnonzero(known[:, k])
        while len(mine) >= FEWEST and len(mine) > 0.8 * known[:, k].sum():
            y, s2 = values[mine, k], variance[mine, k]
            off, sd = np.array(
                [_against(np.delete(y, i), np.delete(s2, i), y[i], s2[i]) for i in range(len(mine))]
            ).T
            worst = int(np.argmax(np.abs(off / sd)))
            sigma = abs(float(off[worst] / sd[worst]))
            p = min(1.0, 2 * tests * float(student.sf(sigma, len(mine) - 2)))
            if p >= FALSE_ALARM:
                break
            named.append(Unlike(int(mine[worst]), k, float(off[worst]), sigma, p))
            mine = np.delete(mine, worst)
    return tuple(sorted(named, key=lambda one: one.p_value))


def _against(y: Floats, s2: Floats, value: float, variance: float) -> tuple[float, float]:
    """Distance of a value from the mean of others, and its standard deviation."""
    tau2 = _spread(y, s2)
    w = 1.0 / (tau2 + s2)
    mean = float(w @ y / w.sum())
    return value - mean, float(np.sqrt(tau2 + variance + 1.0 / w.sum()))


def _spread(y: Floats, s2: Floats) -> float:
    """Variance of units beyond that of their errors, by REML's fixed point."""
    s2 = np.maximum(s2, LEAST)
    tau2 = max(float(np.var(y, ddof=1) - s2.mean()), 0.0)
    for _ in range(50):
        w = 1.0 / (tau2 + s2)
        mean = float(w @ y / w.sum())
        change = float(w**2 @ ((y - mean) ** 2 - s2) / (w**2).sum() + 1.0 / w.sum())
        tau2, before = max(change, 0.0), tau2
        if abs(tau2 - before) <= CONVERGED * max(tau2, LEAST):
            break
    return tau2


def _em(of: FleetEstimates, apart: Bools) -> Hierarchy:
    k, arms = of.mean.shape[1], of.arms
    repeated = of.repeated
    timed = repeated and bool(np.ptp(of.time) > 0)
    tau2 = np.full(k, START[0])
    omega2 = np.full(k, START[1] if repeated else 0.0)
    normal = ~apart
    many = np.bincount(of.arm, minlength=arms)[of.arm] > 1
    for _ in range(STEPS):
        e = _expectation(of, tau2, omega2, apart, timed)
        new_tau2 = np.maximum(
            np.where(normal, e.u2, 0.0).sum(axis=0) / np.maximum(normal.sum(axis=0), 1), LEAST
        )
        new_omega2 = np.maximum(e.e2[many].mean(axis=0), LEAST) if repeated else omega2
        change = max(
            float(np.abs(new_tau2 / np.maximum(tau2, LEAST) - 1).max()),
            float(np.abs(new_omega2 / np.maximum(omega2, LEAST) - 1).max()) if repeated else 0.0,
        )
        tau2, omega2 = new_tau2, new_omega2
        if change < CONVERGED:
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
    k, arms = of.mean.shape[1], of.arms
    eye = np.eye(k)
    m = of.information
    # e_c integrated out: N = (M⁻¹ + Ω)⁻¹ = (1 + M Ω)⁻¹ M
    n = np.linalg.solve(eye + m * omega2, m)
    n = (n + np.swapaxes(n, 1, 2)) / 2
    design = np.zeros((len(m), k, 2 * k if timed else k))
    design[:, :, :k] = eye
    if timed:
        design[:, :, k:] = of.time[:, None, None] * eye
    nx, ny = n @ design, np.einsum("cij,cj->ci", n, of.mean)
    size = design.shape[2]
    sum_n = np.zeros((arms, k, k))
    sum_nx = np.zeros((arms, k, size))
    sum_ny = np.zeros((arms, k))
    np.add.at(sum_n, of.arm, n)
    np.add.at(sum_nx, of.arm, nx)
    np.add.at(sum_ny, of.arm, ny)
    precision = np.where(apart, LEAST, 1.0 / np.maximum(tau2, LEAST))
    u_cov = np.linalg.inv(sum_n + precision[:, :, None] * eye)
    h = np.einsum("cki,ckj->ij", design, nx) - np.einsum("aki,akl,alj->ij", sum_nx, u_cov, sum_nx)
    g = np.einsum("cki,ck->i", design, ny) - np.einsum("aki,akl,al->i", sum_nx, u_cov, sum_ny)
    b_cov = np.linalg.inv((h + h.T) / 2 + LEAST * np.eye(size))
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
    drifted = np.zeros_like(of.mean) if not timed else of.time[:, None] * b[k:]
    own = np.zeros((arms, k))
    np.add.at(own, of.arm, np.einsum("cij,cj->ci", n, of.mean - drifted))
    arm_mean = np.einsum("akl,al->ak", alone, own)
    return _Expected(b, b_cov, u2, e2, arm_mean, np.diagonal(alone, axis1=1, axis2=2).copy())
