"""Empirical Bayes: prior variances of groups of parameters that maximise the evidence.

Parameters of one group share a prior N(0, σ_g²). The σ_g maximise the marginal likelihood
(evidence) of the linear problem, by MacKay's fixed point for the linear-Gaussian model:

    γ_g = Σ_{p in g} (1 − Σ_pp/σ_g²),   σ_g² ← Σ θ_p²/γ_g,   β ← ‖r − A θ‖²/(R − Σ γ)

with Σ the posterior covariance and β the noise variance factor, at least 1: no noise is smaller
than stated. A group is dropped where it shrinks to nothing, or where its evidence is largest at
σ_g = 0: where Σ q_p²/s_p over the group is less than its size (q, s: quality and sparsity of a
column).

Strengths that maximise the evidence of all rows also fit the noise of each fold. With 150 poses and
360 parameters the error on poses left out was thereby predicted 1.1 to 1.4 times too small. So a
fold is predicted by strengths that maximise the evidence of all other rows; the strengths of all
rows are where the iteration starts. A dropped group enters again where the other rows support it:
where Σ q²/s over the group exceeds its size. Its moments give its variance,

    q = dᵀ M y,   s = β dᵀ M d,   σ² = Σ (q² − s) / Σ (s/β)²

with d the columns of the group and M the projection off the other columns.

Sources: MacKay, *Bayesian interpolation*, Neural Computation 4 (1992) 415-447; Tipping and
Faul, *Fast marginal likelihood maximisation for sparse Bayesian models*, AISTATS 2003.
"""

from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
import scipy.linalg as sl
from scipy.special import exp1
from scipy.stats import chi2

from hilcal.regression.schur import eliminate, inverse_root
from hilcal.types import Floats, Ints

ITERATIONS = 25
"""Most fixed-point iterations; a choice: strengths are needed to `TOLERANCE` only."""
NEGLIGIBLE = 1e-3  # share of the noise per parameter below which a group is dropped; a guess
TOLERANCE = 0.2
"""Change of the logarithm of a variance at which it counts as converged: 10 % of σ; a choice."""
PATIENCE = 3  # iterations before groups are judged by quality and sparsity; a choice


@dataclass(frozen=True, slots=True, eq=False)
class EmpiricalPrior:
    """Result of the evidence maximisation."""

    std: Floats  # (P,) prior standard deviations, zero where a group was dropped
    beta: float  # noise variance factor
    effective: float  # effective number of parameters in the shrunk families


def maximise_evidence(
    gram: Floats,  # (F + P, F + P) gram of [flat columns, family columns], family columns unscaled
    rhs: Floats,  # (F + P,) right-hand side
    target_norm2: float,  # ‖target‖²
    rows: int,  # number of whitened rows R that carry information
    flat: int,  # number F of flat columns, which come first
    groups: Ints,  # (P,) group of each family column
    start: Floats,  # (P,) starting standard deviations
    beta: float = 1.0,  # starting noise variance factor
) -> EmpiricalPrior:
    """Maximise the evidence over the group variances."""
    g, b, yy = gram, rhs, target_norm2
    if flat:
        g, b, yy = eliminate(gram, rhs, target_norm2, slice(0, flat))
        g, b = g[flat:, flat:], b[flat:]
    count = int(groups.max()) + 1 if len(groups) else 0
    members = np.maximum(np.bincount(groups, minlength=count), 1)
    variance = np.bincount(groups, weights=start**2, minlength=count) / members
    reach = np.bincount(groups, weights=np.diag(g), minlength=count)
    active = (variance > 0) & (reach > 0)
    effective = 0.0
    keep = np.flatnonzero(active[groups])
    g, b = g[np.ix_(keep, keep)], b[keep]
    for iteration in range(ITERATIONS):
        if not len(keep):
            effective = 0.0
            beta = max(1.0, yy / max(rows - flat, 1))
            break
        group = groups[keep]
        std = np.sqrt(variance[group])
        inverse = _inverse_root(g, std, beta)
        posterior = np.einsum("ij,ij->j", inverse, inverse)
        z = inverse.T @ (inverse @ (std * b / beta))
        gamma = np.bincount(group, weights=1 - posterior, minlength=count)
        theta = std * z
        norm2 = np.bincount(group, weights=theta**2, minlength=count)
        effective = float(gamma.sum())
        rss = yy - 2 * float(theta @ b) + float(theta @ (g @ theta))
        beta = max(1.0, rss / max(rows - flat - effective, 1.0))
        updated = np.where(active, norm2 / np.maximum(gamma, 1e-12), 0.0)
        # Dropped where the shrunk group moves the data by far less than the noise, ...
        dropped = active & (updated * reach < NEGLIGIBLE * beta * members)
        if iteration >= PATIENCE:
            # ... or where the evidence is largest at zero variance.
            apart = np.maximum(1 / posterior - 1, 1e-12)
            quality = np.bincount(group, weights=(z / posterior) ** 2 / apart, minlength=count)
            dropped |= active & (quality < members)
        change = np.abs(np.log(np.maximum(updated, 1e-300) / np.maximum(variance, 1e-300)))
        weighty = active & ~dropped & (gamma > 0.05 * members)
        variance, active = updated, active & ~dropped
        retained = active[group]
        if not retained.all():
            keep, g, b = keep[retained], g[np.ix_(retained, retained)], b[retained]
        if not weighty.any() or change[weighty].max() < TOLERANCE:
            break
    std_all = np.sqrt(np.where(active, variance, 0.0))[groups]
    return EmpiricalPrior(std_all, float(beta), effective)


def spent_by_groups(share: Floats, size: Ints) -> Floats:
    """Degrees of freedom (G,) that retained groups use.

    γ = Σ (1 − Σ_pp/σ²) counts the parameters at fixed strengths. But the same data select a group
    and set its strength. With x = |z|² of k orthonormal parameters z, a group is retained where
    x > k and shrunk by t = 1 − k/x, which lowers the sum of squares by x − k²/x. For noise alone x
    is χ² distributed, so that a retained group uses

        k + c_k (1 − t),    c_k = E[x − k²/x − k; x > k] / E[k/x; x > k]

    degrees of freedom: k where it is far above the noise, and right on average for groups of noise
    (a dropped group uses none).

    Args:
        share: t, the share γ/k of each group that the data determine.
    """
    k = np.asarray(size, dtype=float)
    retained, mean = chi2.sf(k, k), k * chi2.sf(k, k + 2.0)
    inverse = np.array([_mean_inverse(float(v)) for v in k.reshape(-1)]).reshape(k.shape)
    excess = (mean - k**2 * inverse - k * retained) / (k * inverse)
    return np.asarray(size + excess * (1.0 - np.clip(share, 0.0, 1.0)))


@cache
def _mean_inverse(k: float) -> float:
    """E[1/x; x > k] of χ²_k; for k = 1, 2, where χ²_{k−2} does not exist, by parts."""
    if k > 2:
        return float(chi2.sf(k, k - 2.0)) / (k - 2.0)
    if k == 2:
        return float(exp1(1.0)) / 2.0
    density = float(np.exp(-0.5) / np.sqrt(2.0 * np.pi))
    return 2.0 * density - float(chi2.sf(1.0, 1.0))


def _inverse_root(g: Floats, std: Floats, beta: float) -> Floats:
    """Return T (K, K) with Tᵀ T = (1 + H)⁻¹, H = S G S/β of a positive semidefinite G.

    Where Cholesky's factorisation fails, as 1 is below the rounding of H, by eigenvalues.
    """
    h = g * (std / beta) * std[:, None]
    low, failed = sl.lapack.dpotrf((h + np.eye(len(h))).T, lower=1, clean=1, overwrite_a=1)
    if not failed:
        return np.asarray(sl.lapack.dtrtri(low, lower=1, overwrite_c=1)[0])
    values, vectors = np.linalg.eigh(h)
    return np.asarray((vectors / np.sqrt(1.0 + np.maximum(values, 0.0))).T)


@dataclass(frozen=True, slots=True, eq=False)
class FamilyProblem:
    """The linear problem y = A u: unshrunk columns, then columns in groups that share a prior."""

    rows: Floats  # (R, F + P) A
    target: Floats  # (R,) y
    ridge: Floats  # (F, F) prior precision of the unshrunk columns, times β
    pull: Floats  # (F,) right-hand side that this prior adds
    groups: Ints  # (P,) group of each shrunk column
    std: Floats  # (P,) strengths by all rows, zero for dropped groups
    beta: float  # noise variance factor by all rows


def solutions(p: FamilyProblem, fold: Ints) -> Floats:
    """Return u without each fold (folds, F + P); `fold` (R,) numbers the folds of rows from 0."""
    flat, count_of = len(p.pull), np.bincount(fold)
    fold_rows = [p.rows[fold == f] for f in range(len(count_of))]
    grams = [a.T @ a for a in fold_rows]
    sides = [a.T @ p.target[fold == f] for f, a in enumerate(fold_rows)]
    gram, rhs = np.sum(grams, axis=0), np.sum(sides, axis=0)
    gram[:flat, :flat] += p.ridge
    rhs[:flat] += p.pull
    square = np.bincount(fold, weights=p.target**2)

    def without(f: int) -> Floats:
        others = _OtherRows(gram, grams[f], rhs - sides[f], flat, float(square.sum() - square[f]))
        count = len(fold) - int(count_of[f]) - flat
        first = others.maximised(p.std, p.groups, p.beta, count)
        start = others.with_dropped(p.groups, first.std, first.beta)
        last = others.maximised(start, p.groups, first.beta, count)
        return others.solution(last.std, last.beta)

    return np.array([without(f) for f in range(len(grams))])


@dataclass(frozen=True, eq=False)
class _OtherRows:
    """The problem of all rows outside of a fold; only the needed part of its products is formed."""

    gram_all: Floats  # (F + P, F + P) AᵀA of all rows
    gram_fold: Floats  # the same of the fold
    rhs: Floats  # (F + P,) Aᵀy of the other rows
    flat: int  # number F of unshrunk columns
    square: float  # ‖y‖² of the other rows

    @cached_property
    def _cross(self) -> Floats:
        """C (F, P + 1): eliminating unshrunk columns subtracts CᵀC from the rest of [AᵀA, Aᵀy]."""
        flat = self.flat
        rows = self.gram_all[:flat] - self.gram_fold[:flat]
        right = np.column_stack([rows[:, flat:], self.rhs[:flat]])
        return np.asarray(inverse_root(rows[:, :flat]) @ right)

    @cached_property
    def _slope(self) -> Floats:
        """(P,) Aᵀy of the shrunk columns after elimination of the unshrunk ones."""
        return np.asarray(self.rhs[self.flat :] - self._cross[:, :-1].T @ self._cross[:, -1])

    def gram(self, rows: Ints, columns: Ints) -> Floats:
        """AᵀA between shrunk columns after elimination of the unshrunk ones."""
        part = np.ix_(self.flat + rows, self.flat + columns)
        explained = self._cross[:, rows].T @ self._cross[:, columns]
        return np.asarray(self.gram_all[part] - self.gram_fold[part] - explained)

    def maximised(self, std: Floats, groups: Ints, beta: float, count: int) -> EmpiricalPrior:
        """Maximise the evidence over the strengths that are not zero."""
        live, out = np.flatnonzero(std), np.zeros(len(groups))
        square = self.square - float(self._cross[:, -1] @ self._cross[:, -1])
        gram, slope = self.gram(live, live), self._slope[live]
        prior = maximise_evidence(gram, slope, square, count, 0, groups[live], std[live], beta)
        out[live] = prior.std
        return replace(prior, std=out)

    def with_dropped(self, groups: Ints, std: Floats, beta: float) -> Floats:
        """Return strengths (P,), with those of dropped groups that the rows support."""
        out, live = np.flatnonzero(std == 0), np.flatnonzero(std > 0)
        if not len(out):
            return std
        h = self.gram(live, live) + np.diag(beta / std[live] ** 2)
        x = np.column_stack([self.gram(live, out), self._slope[live]])
        x = sl.solve_triangular(sl.cholesky(h, lower=True), x, lower=True)
        k = self.flat + out
        size = self.gram_all[k, k] - self.gram_fold[k, k] - np.sum(self._cross[:, out] ** 2, axis=0)
        free = np.maximum(size - np.sum(x[:, :-1] ** 2, axis=0), 1e-300)
        slope = self._slope[out] - x[:, :-1].T @ x[:, -1]
        group, count = groups[out], int(groups.max()) + 1
        members = np.bincount(group, minlength=count)
        quality = np.bincount(group, weights=slope**2 / (beta * free), minlength=count)
        excess = np.bincount(group, weights=slope**2 - beta * free, minlength=count)
        spread = np.bincount(group, weights=free**2, minlength=count)
        enters = (quality > members) & (excess > 0)
        variance = np.where(enters, excess / np.maximum(spread, 1e-300), 0.0)
        start = std.copy()
        start[out] = np.sqrt(variance[group])
        return start

    def solution(self, std: Floats, beta: float) -> Floats:
        """Return u (F + P) for strengths (P,)."""
        retained = std > 0
        live = np.concatenate([np.arange(self.flat), self.flat + np.flatnonzero(retained)])
        part = np.ix_(live, live)
        ridge = np.concatenate([np.zeros(self.flat), beta / std[retained] ** 2])
        h = self.gram_all[part] - self.gram_fold[part] + np.diag(ridge)
        u = np.zeros(len(self.rhs))
        u[live] = sl.cho_solve(sl.cho_factor(h), self.rhs[live])
        return u
