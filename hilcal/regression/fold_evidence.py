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

from dataclasses import dataclass
from functools import reduce

import numpy as np
import scipy.linalg as sl

from hilcal.regression.empirical_bayes import maximise_evidence
from hilcal.regression.factored import Tall, gram, of_rows
from hilcal.regression.schur import eliminate
from hilcal.threads import in_threads
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

    rows: Tall
    target: Floats
    ridge: Floats
    pull: Floats
    groups: Ints
    std: Floats
    beta: float


def solutions(p: FamilyProblem, fold: Ints) -> Floats:
    """Return u (F + P) without each fold (folds, F + P).

    Args:
        p: the problem.
        fold: (R,) fold of each row, from 0.
    """
    flat, count_of = len(p.pull), np.bincount(fold)
    parts = in_threads(lambda f: _products(p, fold == f), range(len(count_of)), len(fold))
    whole, rhs = (reduce(np.add, of) for of in zip(*parts, strict=True))
    whole[:flat, :flat] += p.ridge
    rhs[:flat] += p.pull
    square = np.bincount(fold, weights=p.target**2)

    def without(f: int) -> Floats:
        own, side = parts[f]
        g, b, yy = whole - own, rhs - side, float(square.sum() - square[f])
        count = len(fold) - int(count_of[f]) - flat
        # Beside the unshrunk columns, which are eliminated once.
        h, c, left = eliminate(g, b, yy, slice(0, flat))
        h, c = h[flat:, flat:], c[flat:]
        first = maximise_evidence(h, c, left, count, 0, p.groups, p.std, p.beta)
        start = _with_dropped(h, c, p.groups, first.std, first.beta)
        last = maximise_evidence(h, c, left, count, 0, p.groups, start, first.beta)
        return _solve(g, b, flat, last.std, last.beta)[0]

    return np.array(in_threads(without, range(len(parts)), len(fold)))


def _products(p: FamilyProblem, rows: Bools) -> tuple[Floats, Floats]:
    """AᵀA and Aᵀy of some rows."""
    own = of_rows(p.rows, rows)
    return gram(own), own.T @ p.target[rows]


def _solve(
    gram: Floats, rhs: Floats, flat: int, std: Floats, beta: float
) -> tuple[Floats, Ints, Floats]:
    """Return u (F + P), the columns that are not held at zero, and their Cholesky factor."""
    live = np.concatenate([np.arange(flat), flat + np.flatnonzero(std > 0)])
    h = gram[np.ix_(live, live)].copy()
    h[np.diag_indices_from(h)] += np.concatenate([np.zeros(flat), beta / std[std > 0] ** 2])
    low = sl.cholesky(h, lower=True, check_finite=False)
    u = np.zeros(len(rhs))
    u[live] = sl.cho_solve((low, True), rhs[live], check_finite=False)
    return u, live, low


def _with_dropped(gram: Floats, rhs: Floats, groups: Ints, std: Floats, beta: float) -> Floats:
    """Return the strengths (P,) with dropped groups entered again where the rows speak for them."""
    flat = len(rhs) - len(groups)
    out = np.flatnonzero(std == 0)
    if not len(out):
        return std
    _, live, low = _solve(gram, rhs, flat, std, beta)
    columns = flat + out
    x = sl.solve_triangular(
        low,
        np.column_stack([gram[np.ix_(live, columns)], rhs[live]]),
        lower=True,
        check_finite=False,
    )
    free = np.maximum(np.diag(gram)[columns] - np.sum(x[:, :-1] ** 2, axis=0), 1e-300)
    told = rhs[columns] - x[:, :-1].T @ x[:, -1]
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
