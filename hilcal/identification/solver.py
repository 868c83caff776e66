"""Damped Gauss-Newton (Levenberg, Marquardt) for points that move by more than addition.

    minimise ‖r(p)‖²,    r(p ⊕ δ) = r(p) − J δ + …,    (JᵀJ + λ diag JᵀJ) δ = Jᵀr

p ⊕ δ need not be a sum, as frames rotate. A prior about zero is a further row of r.
"""

from collections.abc import Callable, Sequence
from typing import Protocol, Self, TypeVar

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.types import Floats

# The first three are choices; the last one is rounding.
STEPS = 40  # most steps
DAMPING = 1e-3  # λ of the first step
SETTLED = 1e-9  # relative decrease of the sum of squares below which the iteration ends
SMALL = 1e-12  # largest element of a step below which the iteration ends


class SolverPoint(Protocol):
    """A point of the parameters, whose coordinates δ are of ordinary size 1."""

    @property
    def residual(self) -> Floats:
        """(R,) r, whitened."""

    def jacobian(self) -> Floats:
        """(R, K) J, whitened derivative of the predictions."""

    def moved(self, step: Floats) -> Self:
        """Return p ⊕ δ (K,)."""


P = TypeVar("P", bound=SolverPoint)
T = TypeVar("T")


def minimise(at: P, steps: int = STEPS) -> P:
    """Return the point of least squares that is reached from a start."""
    square, normal, damping = float(at.residual @ at.residual), None, DAMPING
    for _ in range(steps):
        if normal is None:
            a = at.jacobian()
            normal = a.T @ a, a.T @ at.residual
        h, gradient = normal
        if not len(h):
            break
        # Damped in units of each column, too, so that no coordinate diverges.
        largest = h.diagonal().max()
        guard = damping * (h.diagonal() + 1e-6 * largest) + 1e-12 * largest + 1e-300
        step: Floats = np.asarray(np.linalg.solve(h + np.diag(guard), gradient), dtype=float)
        trial = at.moved(step)
        reduced = float(trial.residual @ trial.residual)
        if reduced <= square:
            done = square - reduced <= SETTLED * square + 1e-12 * len(a) and damping <= DAMPING
            at, square, normal = trial, reduced, None
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
    """Return the first result of the full step, half of it, … whose cost is at most the limit.

    None without one; `moved` and `cost` may raise CannotAnswerError.
    """
    for halving in range(most):
        try:
            reached = moved(0.5**halving * step)
            if cost is None or cost(reached) <= limit:
                return reached
        except CannotAnswerError:
            continue
    return None


def echelon(rows: Floats, blocks: Sequence[Sequence[int]], least: float = 0.0) -> Floats:
    """Bring directions (U, P) to reduced echelon form, so that each involves few parameters.

    Columns of a block become pivots before those of the next one; elements up to `least` are no
    pivots.
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
            remaining = np.arange(len(rows)) != done
            rows[remaining] -= rows[remaining, pivot][:, None] * rows[done]
            done += 1
    return rows
