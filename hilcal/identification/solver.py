"""Damped Gauss-Newton (Levenberg, Marquardt): a least sum of squares from a point that can move.

    minimise ‖r(p)‖²,    r(p ⊕ δ) = r(p) − J δ + …,    (JᵀJ + λ diag JᵀJ) δ = Jᵀr

p ⊕ δ need be no sum: frames turn. A prior about zero is one more row of r.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, Self, TypeVar

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.types import Floats

# Choices, but for the last one, which is rounding.
STEPS = 40  # at most
DAMPING = 1e-3  # λ of the first step
SETTLED = 1e-9  # share of the sum of squares by which a last step lowers it
SMALL = 1e-12  # a step below this in every coordinate ends the search


class SolverPoint(Protocol):
    """A point of the parameters, whose coordinates δ are of ordinary size 1."""

    @property
    def residual(self) -> Floats:
        """(R,) r, whitened."""

    def jacobian(self) -> Floats:
        """(R, K) J, derivative of what is predicted."""

    def moved(self, step: Floats) -> Self:
        """Return p ⊕ δ (K,)."""


P = TypeVar("P", bound=SolverPoint)
T = TypeVar("T")


def minimise(at: P, steps: int = STEPS) -> P:
    """Return the point of least squares that a start leads to."""
    square, normal, damping = float(at.residual @ at.residual), None, DAMPING
    for _ in range(steps):
        if normal is None:
            a = at.jacobian()
            normal = a.T @ a, a.T @ at.residual
        h, gradient = normal
        if not len(h):
            break
        # In units of each column as well, so that nothing runs away.
        largest = h.diagonal().max()
        guard = damping * (h.diagonal() + 1e-6 * largest) + 1e-12 * largest + 1e-300
        step: Floats = np.asarray(np.linalg.solve(h + np.diag(guard), gradient), dtype=float)
        trial = at.moved(step)
        now = float(trial.residual @ trial.residual)
        if now <= square:
            done = square - now <= SETTLED * square + 1e-12 * len(a) and damping <= DAMPING
            at, square, normal = trial, now, None
            damping = max(0.1 * damping, 1e-9)
            if done or np.abs(step).max() < SMALL:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    return at


def shortened(
    moved: Callable[[Floats], T],
    step: Floats,
    most: int,
    cost: Callable[[T], float] | None = None,
    limit: float = np.inf,
) -> T | None:
    """Return what the whole step, half of it, a quarter … first leads to; None for nothing good.

    `moved` and `cost`, which must not exceed the limit, may raise CannotAnswerError.
    """
    for halving in range(most):
        try:
            found = moved(0.5**halving * step)
            if cost is None or cost(found) <= limit:
                return found
        except CannotAnswerError:
            continue
    return None


def echelon(rows: Floats, blocks: Sequence[Sequence[int]], least: float = 0.0) -> Floats:
    """Bring directions (U, P) to reduced echelon form, so that each involves few parameters.

    Columns of a block are pivots before those of the next; elements up to `least` are none.
    """
    rows, done = rows.copy(), 0
    for block in blocks:
        while done < len(rows) and len(block):
            sub = np.abs(rows[done:][:, block])
            i, j = np.unravel_index(int(np.argmax(sub)), sub.shape)
            if sub[i, j] <= least:
                break
            pivot = block[int(j)]
            rows[[done, done + int(i)]] = rows[[done + int(i), done]]
            rows[done] /= rows[done, pivot]
            others = np.arange(len(rows)) != done
            rows[others] -= rows[others, pivot][:, None] * rows[done]
            done += 1
    return rows
