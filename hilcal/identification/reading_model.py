"""The linear model of single readings, from which any of them can be left out.

    r_k = W_k o_g + B_k δ + ε_k,    ε_k ~ N(0, I),    δ ~ N(−p/d, 1/d)

r_k (m,) whitened residual of reading k at a linearisation, W_k V_k W_kᵀ = I with its covariance
V_k, B_k (m, K) whitened columns, d precisions, zero without a prior. Readings of one group, those
of deflections from the same unloaded readings, have an offset o_g in common, without a prior:
eliminated, it leaves the least squares of their deflections. Absolute readings have none.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.stats import chi2

from hilcal.readings.whitening import inverse_root
from hilcal.types import Bools, Floats, Ints

SINGULAR = 1e-9
"""Ridge, as a share of a column's square in all readings: few readings determine few columns, and
some columns none; a choice between rounding and what readings tell."""
AT_A_TIME = 4096
"""Readings whose covariance is formed at a time."""
FAR = 100.0
"""χ² from which on its probability is not looked at; a choice."""
LEVERAGE = 1e-6
"""Share of a reading's information that the others must leave for a test; a choice."""


@dataclass(frozen=True, eq=False)
class ReadingModel:
    """The linear model of N readings.

    Attributes:
        residual: (N, m) r.
        columns: (N, m, K) B.
        precision: (K,) d.
        pull: (K,) p, slope of the prior at the linearisation.
        root: (N, m, m) W.
        members: (G, S) rows of the readings of each group, unloaded ones first, −1 beyond the
            last; G = 0 for absolute readings.
    """

    residual: Floats
    columns: Floats
    precision: Floats
    pull: Floats
    root: Floats
    members: Ints

    def __len__(self) -> int:
        """Return the number of readings N."""
        return len(self.residual)

    @property
    def m(self) -> int:
        """Elements per reading."""
        return int(self.residual.shape[1])

    @cached_property
    def enough(self) -> int:
        """Number of readings whose elements are as many as the coordinates without a prior."""
        elements = max(int(np.median(self.read)), 1)
        return -(-int(np.count_nonzero(self.precision == 0)) // elements)

    @cached_property
    def read(self) -> Ints:
        """(N,) elements of each reading that were read."""
        return np.asarray(np.count_nonzero(np.any(self.root != 0, axis=2), axis=1))

    def _comparable(self, t2: Floats) -> Floats:
        """(N,) squared distances as of readings of m elements.

        Of a reading with fewer, as a distance has, χ² of the same probability; far beyond, where
        that is rounding, as much more.
        """
        read = self.read
        less = (read > 0) & (read < self.m)
        if not less.any():
            return t2
        near, out = np.minimum(t2[less], FAR), t2.copy()
        out[less] = chi2.isf(chi2.sf(near, read[less]), self.m) + t2[less] - near
        return out

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
        return ReadingModel(
            self.residual[rows],
            self.columns[rows],
            self.precision,
            self.pull,
            self.root[rows],
            members[(members >= 0).any(axis=1)],
        )

    def with_columns(self, columns: Floats) -> "ReadingModel":
        """Return the model with more whitened columns (N, m, P), of unit prior about zero."""
        more = np.ones(columns.shape[2])
        return ReadingModel(
            self.residual,
            np.concatenate([self.columns, columns], axis=2),
            np.append(self.precision, more),
            np.append(self.pull, 0.0 * more),
            self.root,
            self.members,
        )

    def fitted(self, used: Bools) -> tuple[Floats, Floats]:
        """Return δ (K,) from some readings (N,), and its covariance (K, K)."""
        delta, covariance, *_ = self._fitted(used)
        return delta, covariance

    def residuals(self, used: Bools) -> Floats:
        """(N, m) whitened residual of all readings from the fit to the used ones (N,)."""
        return self._fitted(used)[2]

    def distances(self, used: Bools) -> Floats:
        """(N,) squared distance t² of each reading from the fit to the used ones without it.

        With r_k the residual, H_k = W_k C_o W_kᵀ + B_k C_δ B_kᵀ from the covariance of offset and
        coordinates, t² = r_kᵀ (I − H_k)⁻ r_k of a used reading (Baarda's test of a shift of it),
        and r_kᵀ (I + H_k)⁻ r_k of another one; χ²_m of a good reading, whatever its leverage.
        """
        _, covariance, r, b = self._fitted(used)
        spread = np.empty((len(b), self.m, self.m))
        for k in range(0, len(b), AT_A_TIME):
            some = b[k : k + AT_A_TIME]
            spread[k : k + AT_A_TIME] = (some @ covariance) @ some.swapaxes(1, 2)
        if len(self.members):
            own = self.group >= 0
            root, offset = self.root[own], self._offset_covariance(used)[self.group[own]]
            spread[own] += root @ offset @ root.swapaxes(1, 2)
        a = np.eye(self.m) + np.where(used, -1.0, 1.0)[:, None, None] * spread
        values, vectors = np.linalg.eigh(a)
        c = np.einsum("nij,ni->nj", vectors, r)
        kept = values > LEVERAGE
        t2 = np.sum(np.where(kept, c**2 / np.where(kept, values, 1.0), 0.0), axis=1)
        return self._comparable(np.asarray(t2))

    def near(self, delta: Floats) -> tuple[Floats, Bools]:
        """Squared distances (N,) from the model with δ (K,), and which readings are centres (N,).

        Readings of a group are compared with one of them, its centre, at the distance zero: that
        with the least Σ log(1 + d²), which is near most others wherever the rest are.
        """
        r = self.residual - self.columns @ delta
        d2, centre = np.asarray(np.sum(r**2, axis=1)), np.zeros(len(self), dtype=np.bool_)
        if len(self.members):
            apart, there = self._apart(r), self.members >= 0
            total = np.log1p(np.where(there[:, None, :], apart, 0.0)).sum(axis=2)
            best = np.argmin(np.where(there, total, np.inf), axis=1)
            each = np.arange(len(best))
            g, s = np.nonzero(there)
            d2[self.members[g, s]] = apart[each, best][g, s]
            centre[self.members[each, best]] = True
        return self._comparable(d2), centre

    def with_lone_centres(self, used: Bools, centre: Bools) -> Bools:
        """Return the used readings (N,), and the centre of each group that has none."""
        if not len(self.members):
            return used
        has = np.append(np.any(used[self.members] & (self.members >= 0), axis=1), True)
        return np.asarray(used | (centre & ~has[self.group]))

    def _fitted(self, used: Bools) -> tuple[Floats, Floats, Floats, Floats]:
        """δ, its covariance; residual and columns of all, from the offsets of the used ones."""
        r, b = self.residual, self.columns
        if len(self.members):
            both = self._both - self._offsets(used)
            r, b = both[:, :, -1], both[:, :, :-1]
        some = b if used.all() else b[used]
        rows = some.reshape(self.m * len(some), b.shape[2])
        h = rows.T @ rows
        h[np.diag_indices_from(h)] += self.precision + self._guard
        covariance = np.asarray(np.linalg.inv(h), dtype=float)
        delta = covariance @ (rows.T @ r[used].reshape(-1) - self.pull)
        return delta, covariance, r - b @ delta, b

    @cached_property
    def _both(self) -> Floats:
        """(N, m, K + 1) columns and residual."""
        return np.asarray(np.concatenate([self.columns, self.residual[:, :, None]], axis=2))

    @cached_property
    def _guard(self) -> Floats:
        """(K,) ridge against singular equations."""
        squares = np.einsum("nik,nik->k", self.columns, self.columns)
        return np.asarray(SINGULAR * squares + 1e-300)

    def _offsets(self, used: Bools) -> Floats:
        """(N, m, K + 1) whitened offsets of columns and residual that the used readings have."""
        weight, own = used[:, None, None], self.group >= 0
        offset = self._offset_covariance(used) @ self._summed(self._parts * weight)
        out = np.zeros_like(self._both)
        out[own] = self.root[own] @ offset[self.group[own]]
        return out

    def _offset_covariance(self, used: Bools) -> Floats:
        """(G, m, m) covariance of the offset of each group; zero without a used reading."""
        weight = self._information * used[:, None, None]
        return np.asarray(np.linalg.pinv(self._summed(weight), hermitian=True), dtype=float)

    @cached_property
    def _information(self) -> Floats:
        """(N, m, m) WᵀW."""
        return np.asarray(self.root.swapaxes(1, 2) @ self.root)

    @cached_property
    def _parts(self) -> Floats:
        """(N, m, K + 1) Wᵀ times columns and residual."""
        return np.asarray(self.root.swapaxes(1, 2) @ self._both)

    def _summed(self, x: Floats) -> Floats:
        """(G, ...) sums of x (N, ...) over the readings of each group."""
        beyond = np.concatenate([x, np.zeros_like(x[:1])])
        return np.asarray(beyond[self.members].sum(axis=1))

    def _apart(self, r: Floats) -> Floats:
        """(G, S, S) squared distances of the readings of each group by residuals r (N, m)."""
        back, root = self._differences
        x = (back @ r[:, :, None])[:, :, 0][self.members]
        off = root @ (x[:, :, None] - x[:, None, :])[..., None]
        return np.asarray(np.sum(off[..., 0] ** 2, axis=3))

    @cached_property
    def _differences(self) -> tuple[Floats, Floats]:
        """(N, m, m) W⁻, and (G, S, S, m, m) roots of the precision of differences in a group."""
        back = np.asarray(np.linalg.pinv(self.root), dtype=float)
        v = (back @ back.swapaxes(1, 2))[self.members]
        return back, inverse_root(v[:, :, None] + v[:, None, :])
