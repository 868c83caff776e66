"""Damped Gauss-Newton (Levenberg, Marquardt): a least sum of squares from a point that can move.

    minimise ‖r(p)‖²,    r(p ⊕ δ) = r(p) − J δ + …,    (JᵀJ + λ diag JᵀJ) δ = Jᵀr

p ⊕ δ need be no sum: frames turn. A prior about zero is one more row of r.
"""

from collections.abc import Callable
from typing import Protocol, Self, TypeVar

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.types import Floats

STEPS = 40
"""Most steps; a choice."""
DAMPING = 1e-3
"""λ of the first step; a choice."""
SETTLED = 1e-9
"""Share of the sum of squares by which a last step lowers it; a choice."""
SMALL = 1e-12
"""A step below this in every coordinate ends the search: rounding."""


class SolverPoint(Protocol):
    """A point of the parameters, whose coordinates δ are of ordinary size 1."""

    @property
    def residual(self) -> Floats:
        """(R,) r, whitened."""

    def jacobian(self) -> Floats:
        """(R, K) J, derivative of what is predicted."""

    def moved(self, step: Floats) -> Self:
        """Return p ⊕ δ (K,).

        Raises:
            CannotAnswerError: nothing can be predicted there.
        """


P = TypeVar("P", bound=SolverPoint)
T = TypeVar("T")


def minimise(at: P, steps: int = STEPS, damping: float = DAMPING, settled: float = SETTLED) -> P:
    """Return the point of least squares that a start leads to.

    Args:
        at: the start.
        steps: most steps.
        damping: λ of the first step; near zero where the start is close.
        settled: share of the sum of squares by which a last step lowers it.
    """
    square, normal = float(at.residual @ at.residual), None
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
        try:
            trial = at.moved(step)
            now = float(trial.residual @ trial.residual)
        except CannotAnswerError:
            now = np.inf
        if now <= square:
            done = square - now <= settled * square + 1e-12 * len(a) and damping <= DAMPING
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

    Args:
        moved: where a step leads to; may raise CannotAnswerError, as `cost` may.
        step: (K,) the whole one.
        most: number of trials.
        cost: what is not to grow.
        limit: the most that it may be.
    """
    for halving in range(most):
        try:
            found = moved(0.5**halving * step)
            if cost is None or cost(found) <= limit:
                return found
        except CannotAnswerError:
            continue
    return None
