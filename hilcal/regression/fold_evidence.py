"""Solutions without each fold, with the strengths of shrunk families chosen without it, too.

Strengths that maximise the evidence of all rows know of the rows of a fold: groups that fit its
noise were kept, with strengths that fit it. With 150 poses and 360 parameters the error on poses
left out was so predicted 1.1 to 1.4 times too small. So each fold maximises the evidence of its own
rows, from the strengths of all rows. Groups that were dropped enter again where the other rows
speak for them: where Σ q²/s over the group exceeds its size, with the variance that its moments
give (see `empirical_bayes`),

    q = dᵀ M y,   s = β dᵀ M d,   σ² = Σ (q² − s) / Σ (s/β)²

d the columns of the group, M the projection off the others.
"""

from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import scipy.linalg as sl

from hilcal.regression.empirical_bayes import EmpiricalPrior, maximise_evidence
from hilcal.regression.schur import inverse_root
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class FamilyProblem:
    """The linear problem y = A u: unshrunk columns first, then those of groups that share a prior.

    Attributes:
        rows: (R, F + P) A.
        target: (R,) y.
        ridge: (F, F) prior precision of the unshrunk columns, times β.
        pull: (F,) right-hand side that this prior adds.
        groups: (P,) group of each shrunk column.
        std: (P,) strengths by all rows, zero for groups that were dropped.
        beta: noise variance factor by all rows.
    """

    rows: Floats
    target: Floats
    ridge: Floats
    pull: Floats
    groups: Ints
    std: Floats
    beta: float


def solutions(p: FamilyProblem, fold: Ints) -> Floats:
    """Return u (F + P) without each fold (folds, F + P).

    Args:
        fold: (R,) fold of each row, from 0.
    """
    flat, count_of = len(p.pull), np.bincount(fold)
    parts = [_products(p, fold == f) for f in range(len(count_of))]
    whole, rhs = (reduce(np.add, of) for of in zip(*parts, strict=True))
    whole[:flat, :flat] += p.ridge
    rhs[:flat] += p.pull
    square = np.bincount(fold, weights=p.target**2)

    def without(f: int) -> Floats:
        own, side = parts[f]
        rest = _Rest.of(whole, own, rhs - side, flat, float(square.sum() - square[f]))
        count = len(fold) - int(count_of[f]) - flat
        live = np.flatnonzero(p.std > 0)
        first = rest.maximised(live, p.groups, p.std, p.beta, count)
        start = rest.with_dropped(p.groups, first.std, first.beta)
        last = rest.maximised(np.flatnonzero(start), p.groups, start, first.beta, count)
        return rest.solution(last.std, last.beta)

    return np.array([without(f) for f in range(len(parts))])


def _products(p: FamilyProblem, rows: Bools) -> tuple[Floats, Floats]:
    """AᵀA and Aᵀy of some rows."""
    own = p.rows[rows]
    return own.T @ own, own.T @ p.target[rows]


@dataclass(frozen=True, slots=True, eq=False)
class _Rest:
    """The problem of all rows but a fold's; of its products only what is needed is formed.

    Attributes:
        whole: (F + P, F + P) AᵀA of all rows.
        own: the same of the fold.
        rhs: (F + P,) Aᵀy of the rest.
        flat: number F of unshrunk columns.
        square: ‖y‖² of the rest, beside the unshrunk columns.
        cross: (F, P) what they take off AᵀA of the shrunk columns, as crossᵀ cross.
        beside: (P,) Aᵀy of the shrunk columns, beside the unshrunk ones.
    """

    whole: Floats
    own: Floats
    rhs: Floats
    flat: int
    square: float
    cross: Floats
    beside: Floats

    @classmethod
    def of(cls, whole: Floats, own: Floats, rhs: Floats, flat: int, square: float) -> "_Rest":
        """Eliminate the unshrunk columns."""
        rows = whole[:flat] - own[:flat]
        solved = inverse_root(rows[:, :flat]) @ np.column_stack([rows[:, flat:], rhs[:flat]])
        cross, along = solved[:, :-1], solved[:, -1]
        left = square - float(along @ along)
        return cls(whole, own, rhs, flat, left, cross, rhs[flat:] - cross.T @ along)

    def gram(self, rows: Ints, columns: Ints) -> Floats:
        """AᵀA between some shrunk columns and others, beside the unshrunk ones."""
        at = np.ix_(self.flat + rows, self.flat + columns)
        return np.asarray(
            self.whole[at] - self.own[at] - self.cross[:, rows].T @ self.cross[:, columns]
        )

    def maximised(
        self, live: Ints, groups: Ints, std: Floats, beta: float, count: int
    ) -> EmpiricalPrior:
        """Maximise the evidence over the strengths of some shrunk columns; the others have none."""
        found = maximise_evidence(
            self.gram(live, live),
            self.beside[live],
            self.square,
            count,
            0,
            groups[live],
            std[live],
            beta,
        )
        out = np.zeros(len(groups))
        out[live] = found.std
        return replace(found, std=out)

    def with_dropped(self, groups: Ints, std: Floats, beta: float) -> Floats:
        """Return strengths (P,), with dropped groups where the rows speak for them."""
        out, live = np.flatnonzero(std == 0), np.flatnonzero(std > 0)
        if not len(out):
            return std
        h = self.gram(live, live) + np.diag(beta / std[live] ** 2)
        x = np.column_stack([self.gram(live, out), self.beside[live]])
        x = sl.solve_triangular(sl.cholesky(h, lower=True), x, lower=True)
        at = self.flat + out
        size = self.whole[at, at] - self.own[at, at] - np.sum(self.cross[:, out] ** 2, axis=0)
        free = np.maximum(size - np.sum(x[:, :-1] ** 2, axis=0), 1e-300)
        told = self.beside[out] - x[:, :-1].T @ x[:, -1]
        group, count = groups[out], int(groups.max()) + 1
        members = np.bincount(group, minlength=count)
        quality = np.bincount(group, weights=told**2 / (beta * free), minlength=count)
        excess = np.bincount(group, weights=told**2 - beta * free, minlength=count)
        spread = np.bincount(group, weights=free**2, minlength=count)
        enters = (quality > members) & (excess > 0)
        variance = np.where(enters, excess / np.maximum(spread, 1e-300), 0.0)
        start = std.copy()
        start[out] = np.sqrt(variance[group])
        return start

    def solution(self, std: Floats, beta: float) -> Floats:
        """Return u (F + P) for strengths (P,)."""
        kept = std > 0
        live = np.concatenate([np.arange(self.flat), self.flat + np.flatnonzero(kept)])
        at = np.ix_(live, live)
        ridge = np.concatenate([np.zeros(self.flat), beta / std[kept] ** 2])
        h = self.whole[at] - self.own[at] + np.diag(ridge)
        u = np.zeros(len(self.rhs))
        u[live] = sl.cho_solve(sl.cho_factor(h), self.rhs[live])
        return u
