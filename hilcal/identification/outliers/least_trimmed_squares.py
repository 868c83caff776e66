"""The linear model of single readings, and least trimmed squares on it.

    r_k = W_k o_g + B_k δ + ε_k,    ε_k ~ N(0, I),    δ ~ N(−p/d, 1/d)

r_k (m,) whitened residual of reading k at a linearisation, W_k V_k W_kᵀ = I with its covariance
V_k, B_k (m, K) whitened columns, d precisions, zero without a prior. Readings of one group, those
of deflections from the same unloaded readings, have an offset o_g in common, without a prior:
eliminated, it leaves the least squares of their deflections. Absolute readings have none.

Least trimmed squares (Rousseeuw and Van Driessen, Data Mining and Knowledge Discovery 12 (2006)
29-45) finds the readings that agree best on one model:

    minimise Σ_{k ≤ h} d²_(k)(δ)

d²_(k) ascending squared distances of the readings from the linear model with δ, h a little more
than half of them, so that nearly half may be wrong, by any amount. A fit to the h readings that are
nearest to a model has a lower sum (concentration); it starts from many random subsets that just
determine the model, and the lowest sum is used. The bulk of the distances gives the limit of a
gross error (`rejection_limit`).
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Protocol, Self, TypeVar

import numpy as np
import scipy

from hilcal.identification.gauss_newton import shortened
from hilcal.readings.whitening import whitening_matrix
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
MOST_WRONG = 0.45
"""Share of the readings that may be wrong: half of few agree on some model by chance."""
MISS_PROBABILITY, MOST_SUBSETS = 1e-3, 300
"""Probability that every subset has a wrong reading; most subsets."""
SUBSET_READINGS, BEST_SUBSETS, MOST_FINAL_STEPS = 300, 20, 20
"""Readings that subsets are drawn from (source); best subsets continued; most steps of each."""
HALVINGS = 6  # most halvings of a step
MOST_LINEARISATIONS = 6  # gross errors may have led the first one far off
FALSE_ALARMS = 1e-3  # expected good readings set aside per campaign under the right model
MISFIT_FACTOR = 6.25  # of the limit with a misfit, 2.5 in distance: its tails are heavier
MISFIT_SCALES = (1.25, 1.5)
"""Scales of the bulk between which `MISFIT_FACTOR` is reached: noise alone, and a sure misfit."""
SINGULAR_RIDGE = 1e-9  # as a share of a column's square: few readings determine few columns
READINGS_AT_ONCE = 4096  # readings whose covariance is formed at a time
LARGEST_CHI2 = 100.0  # χ² beyond which its probability is not evaluated
LEAST_INFORMATION_SHARE = 1e-6  # share of a reading's information that must remain for a test


@dataclass(frozen=True, eq=False)
class ReadingModel:
    """The linear model of N readings of m elements."""

    residual: Floats  # (N, m) r
    columns: Floats  # (N, m, K) B
    precision: Floats  # (K,) d
    pull: Floats  # (K,) p, slope of the prior at the linearisation
    root: Floats  # (N, m, m) W
    members: Ints = field(default_factory=lambda: np.zeros((0, 0), dtype=np.int64))
    """(G, S) rows of the readings of each group, unloaded ones first, −1 beyond the last."""

    def __len__(self) -> int:
        return len(self.residual)

    @property
    def m(self) -> int:
        """Elements per reading."""
        return int(self.residual.shape[1])

    @cached_property
    def fewest_readings(self) -> int:
        """Number of readings whose elements are as many as the coordinates without a prior."""
        elements = max(int(np.median(self.elements_read)), 1)
        return -(-int(np.count_nonzero(self.precision == 0)) // elements)

    @cached_property
    def elements_read(self) -> Ints:
        """(N,) elements of each reading that were read."""
        return np.asarray(np.count_nonzero(np.any(self.root != 0, axis=2), axis=1))

    @cached_property
    def group(self) -> Ints:
        """(N,) the group of each reading, −1 without one."""
        out = np.full(len(self), -1)
        g, s = np.nonzero(self.members >= 0)
        out[self.members[g, s]] = g
        return out

    @cached_property
    def tested(self) -> Bools:
        """(N,) readings that the model is fitted to: of deflections, those with a group."""
        return np.asarray((self.group >= 0) | (len(self.members) == 0))

    def __getitem__(self, rows: Ints) -> "ReadingModel":
        """Return the model of some readings, whole groups."""
        place = np.full(len(self) + 1, -1)
        place[rows] = np.arange(len(rows))
        members = place[self.members]
        members = members[(members >= 0).any(axis=1)]
        r, columns, root = self.residual[rows], self.columns[rows], self.root[rows]
        return ReadingModel(r, columns, self.precision, self.pull, root, members)

    def with_columns(self, columns: Floats) -> "ReadingModel":
        """Return the model with more whitened columns (N, m, P), of unit prior about zero."""
        ones = np.ones(columns.shape[2])
        wide = np.concatenate([self.columns, columns], axis=2)
        precision, pull = np.append(self.precision, ones), np.append(self.pull, 0.0 * ones)
        return ReadingModel(self.residual, wide, precision, pull, self.root, self.members)

    def fitted(self, used: Bools) -> Floats:
        """Return δ (K,) from some readings (N,)."""
        h, rhs, _, _ = self._equations(used)
        return np.asarray(np.linalg.solve(h, rhs))

    def residuals(self, used: Bools) -> Floats:
        """(N, m) whitened residual of all readings from the fit to the used ones (N,)."""
        h, rhs, r, b = self._equations(used)
        return np.asarray(r - b @ np.linalg.solve(h, rhs))

    def distances(self, used: Bools) -> Floats:
        """(N,) squared distance t² of each reading from the fit to the used ones without it.

        With r_k the residual, H_k = W_k C_o W_kᵀ + B_k C_δ B_kᵀ from the covariance of offset and
        coordinates, t² = r_kᵀ (I − H_k)⁻ r_k of a used reading (Baarda's test of a shift of it),
        and r_kᵀ (I + H_k)⁻ r_k of another one; χ²_m of a good reading, whatever its leverage.
        """
        h, rhs, r, b = self._equations(used)
        covariance = np.linalg.inv(h)
        r = r - b @ (covariance @ rhs)
        spread = np.empty((len(b), self.m, self.m))
        for k in range(0, len(b), READINGS_AT_ONCE):
            subset = b[k : k + READINGS_AT_ONCE]
            spread[k : k + READINGS_AT_ONCE] = (subset @ covariance) @ subset.swapaxes(1, 2)
        if len(self.members):
            grouped = self.group >= 0
            root, offset = self.root[grouped], self._offset_covariance(used)[self.group[grouped]]
            spread[grouped] += root @ offset @ root.swapaxes(1, 2)
        a = np.eye(self.m) + np.where(used, -1.0, 1.0)[:, None, None] * spread
        values, vectors = np.linalg.eigh(a)
        c = np.einsum("nij,ni->nj", vectors, r)
        regular = values > LEAST_INFORMATION_SHARE
        t2 = np.sum(np.where(regular, c**2 / np.where(regular, values, 1.0), 0.0), axis=1)
        return self._comparable(np.asarray(t2))

    def distances_from(self, delta: Floats) -> tuple[Floats, Bools]:
        """Squared distances (N,) from the model with δ (K,), and which readings are centres (N,).

        Readings of a group are compared with one of them, its centre: that with the least
        Σ log(1 + d²), which is near most others wherever the rest are.
        """
        r = self.residual - self.columns @ delta
        d2, centre = np.asarray(np.sum(r**2, axis=1)), np.zeros(len(self), dtype=np.bool_)
        if len(self.members):
            back, root = self._differences
            x = (back @ r[:, :, None])[:, :, 0][self.members]
            off = root @ (x[:, :, None] - x[:, None, :])[..., None]
            square, present = np.sum(off[..., 0] ** 2, axis=3), self.members >= 0
            total = np.log1p(np.where(present[:, None, :], square, 0.0)).sum(axis=2)
            best = np.argmin(np.where(present, total, np.inf), axis=1)
            index = np.arange(len(best))
            g, s = np.nonzero(present)
            d2[self.members[g, s]] = square[index, best][g, s]
            centre[self.members[index, best]] = True
        return self._comparable(d2), centre

    def with_lone_centres(self, used: Bools, centre: Bools) -> Bools:
        """Return the used readings (N,), and the centre of each group that has none."""
        if not len(self.members):
            return used
        has_used = np.append(np.any(used[self.members] & (self.members >= 0), axis=1), True)
        return np.asarray(used | (centre & ~has_used[self.group]))

    def _comparable(self, t2: Floats) -> Floats:
        """(N,) squared distances t², converted to those of readings of m elements.

        For a reading of fewer elements, such as a distance, χ² of the same probability; what
        exceeds `LARGEST_CHI2`, where that is rounding, is added.
        """
        partly_read = (self.elements_read > 0) & (self.elements_read < self.m)
        if not partly_read.any():
            return t2
        near, out = np.minimum(t2[partly_read], LARGEST_CHI2), t2.copy()
        out[partly_read] = (
            scipy.stats.chi2.isf(scipy.stats.chi2.sf(near, self.elements_read[partly_read]), self.m)
            + t2[partly_read]
            - near
        )
        return out

    def _equations(self, used: Bools) -> tuple[Floats, Floats, Floats, Floats]:
        """H (K, K) and right-hand side of H δ; r and B, from the offsets of the used readings."""
        r, b = self.residual, self.columns
        if len(self.members):
            grouped = self.group >= 0
            sums = self._summed(self._parts * used[:, None, None])
            offset = self._offset_covariance(used) @ sums
            both = self._both.copy()
            both[grouped] -= self.root[grouped] @ offset[self.group[grouped]]
            r, b = both[:, :, -1], both[:, :, :-1]
        subset = b if used.all() else b[used]
        rows = subset.reshape(self.m * len(subset), b.shape[2])
        h = rows.T @ rows
        h[np.diag_indices_from(h)] += self.precision + self._guard
        return h, rows.T @ r[used].reshape(-1) - self.pull, r, b

    @cached_property
    def _both(self) -> Floats:
        """(N, m, K + 1) columns and residual."""
        return np.asarray(np.concatenate([self.columns, self.residual[:, :, None]], axis=2))

    @cached_property
    def _guard(self) -> Floats:
        """(K,) ridge against singular equations."""
        squares = np.einsum("nik,nik->k", self.columns, self.columns)
        return np.asarray(SINGULAR_RIDGE * squares + 1e-300)

    def _offset_covariance(self, used: Bools) -> Floats:
        """(G, m, m) covariance of the offset of each group; zero without a used reading."""
        sums = self._summed(self._information * used[:, None, None])
        return np.asarray(np.linalg.pinv(sums, hermitian=True), dtype=float)

    @cached_property
    def _information(self) -> Floats:
        """(N, m, m) Wᵀ W."""
        return np.asarray(self.root.swapaxes(1, 2) @ self.root)

    @cached_property
    def _parts(self) -> Floats:
        """(N, m, K + 1) Wᵀ times columns and residual."""
        return np.asarray(self.root.swapaxes(1, 2) @ self._both)

    def _summed(self, x: Floats) -> Floats:
        """(G, ...) sums of x (N, ...) over the readings of each group."""
        beyond = np.concatenate([x, np.zeros_like(x[:1])])
        return np.asarray(beyond[self.members].sum(axis=1))

    @cached_property
    def _differences(self) -> tuple[Floats, Floats]:
        """(N, m, m) W⁻, and (G, S, S, m, m) roots of the precision of differences in a group."""
        back = np.asarray(np.linalg.pinv(self.root), dtype=float)
        v = (back @ back.swapaxes(1, 2))[self.members]
        return back, whitening_matrix(v[:, :, None] + v[:, None, :])


class Linearised(Protocol):
    """A model of readings at some parameters."""

    @property
    def linear(self) -> ReadingModel:
        """The linear model of the readings there."""

    def moved(self, delta: Floats) -> Self:
        """Return the model after a step δ (K,)."""


L = TypeVar("L", bound=Linearised)


def robust_start(model: L, rng: np.random.Generator) -> tuple[L, Bools]:
    """Return the linearisation that most readings agree on, and which readings do (N,)."""
    used, delta = _trimmed(model.linear, rng)
    for _ in range(MOST_LINEARISATIONS):
        model = shortened(model.moved, delta, HALVINGS) or model
        _, chosen, delta = _concentrated(model.linear, used)
        if np.array_equal(chosen, used):
            break
        used = chosen
    return model, used


def bulk_scale(distance2: Floats, m: int) -> float:
    """Scale of most squared distances: their median over that of χ²_m."""
    return float(np.median(distance2) / scipy.stats.chi2.median(m))


def rejection_limit(m: int, count: int, scale: float = 1.0) -> float:
    """Squared distance from which on one of `count` measurements is a gross error.

    The χ²_m quantile that a good reading exceeds in one of a thousand campaigns, times the scale of
    the bulk where that is wider than the stated noise.
    """
    far = float(scipy.stats.chi2.isf(FALSE_ALARMS / count, m)) * max(1.0, scale)
    chance, sure = MISFIT_SCALES
    return far * float(MISFIT_FACTOR ** np.clip((scale - chance) / (sure - chance), 0.0, 1.0))


def trimmed_variance(model: ReadingModel, d2: Floats, centre: Bools) -> float:
    """Variance of good readings by the median of the h least squared distances (N,)."""
    candidates = np.sort(d2[model.tested & ~centre])
    half = (_trusted(model, len(candidates)) + 1) // 2
    return float(candidates[half - 1] / scipy.stats.chi2.ppf(half / (len(candidates) + 1), model.m))


def nearest(model: ReadingModel, d2: Floats, centre: Bools) -> tuple[Bools, float]:
    """(N,) the h readings of least squared distance (N,), and centres; and the sum of these."""
    candidates = np.flatnonzero(model.tested & ~centre)
    h = _trusted(model, len(candidates))
    chosen = candidates[np.argpartition(d2[candidates], h - 1)[:h]] if h else candidates
    used = centre.copy()
    used[chosen] = True
    return used, float(d2[chosen].sum())


def _trusted(model: ReadingModel, n: int) -> int:
    """Return h, how many of n readings that are no centres."""
    wrong = int(MOST_WRONG * np.count_nonzero(model.tested))
    return min(max(n - wrong, -(-n // 3), model.fewest_readings + 2), n)


def _trimmed(model: ReadingModel, rng: np.random.Generator) -> tuple[Bools, Floats]:
    """Least trimmed squares: the readings (N,), and δ (K,) from them."""
    rows = _subset_rows(model, rng)
    part = model[rows] if len(rows) < len(model) else model
    size = (part.fewest_readings + 1) * (2 if len(part.members) else 1)
    starts = np.log(MISS_PROBABILITY) / np.log1p(-((1.0 - MOST_WRONG) ** size))
    count = int(min(np.ceil(starts), MOST_SUBSETS))
    tried = [nearest(part, *part.distances_from(_from_subset(part, rng))) for _ in range(count)]
    tried.sort(key=lambda t: t[1])
    best = [_concentrated(part, used) for used, _ in tried[:BEST_SUBSETS]]
    _, used, delta = min(best, key=lambda t: t[0])
    if part is not model:
        _, used, delta = _concentrated(model, nearest(model, *model.distances_from(delta))[0])
    return used, delta


def _concentrated(model: ReadingModel, used: Bools) -> tuple[float, Bools, Floats]:
    """Sum, readings (N,), and δ (K,) that led to them."""
    total = np.inf
    for _ in range(MOST_FINAL_STEPS):
        delta = model.fitted(used)
        used, lowest = nearest(model, *model.distances_from(delta))
        if lowest >= total * (1 - 1e-9):
            break
        total = lowest
    return lowest, used, delta


def _subset_rows(model: ReadingModel, rng: np.random.Generator) -> Ints:
    """Rows of at most about `SUBSET_READINGS` readings, whole groups."""
    if not len(model.members):
        return np.sort(rng.permutation(len(model))[:SUBSET_READINGS])
    count = max(SUBSET_READINGS // model.members.shape[1], model.fewest_readings + 2)
    rows = model.members[rng.permutation(len(model.members))[:count]]
    return np.sort(rows[rows >= 0])


def _from_subset(model: ReadingModel, rng: np.random.Generator) -> Floats:
    """δ (K,) from random readings that just determine it and one more; of groups two of each."""
    count = model.fewest_readings + 1
    if not len(model.members):
        rows = rng.permutation(len(model))[:count]
    else:
        groups = model.members[rng.permutation(len(model.members))[:count]]
        rows = np.concatenate([rng.permutation(g[g >= 0])[:2] for g in groups])
    few = model[rows]
    return few.fitted(np.ones(len(few), dtype=np.bool_))
