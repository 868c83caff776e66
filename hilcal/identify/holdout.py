"""Prediction of poses that were left out, and what leaving out does to the parameters.

Whole poses are left out, never single readings: readings of one pose share its errors. Each
fold is refitted by one Gauss-Newton step from the full fit, in which the fold's rows are
taken out of the normal equations exactly.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.data.whitening import Whitening
from hilcal.identify.gauss_newton import Solution
from hilcal.identify.linear import NormalEquations
from hilcal.types import Floats, Ints

ROUNDING = 1e-6
WEAK = 1e-6
"""Weight that holds a direction which a fold cannot see near the full fit: its prior is a
thousand times the ordinary magnitude."""


@dataclass(frozen=True, slots=True, eq=False)
class Folds:
    """Refits without each fold.

    Attributes:
        raw: (D, m) residual of each measurement, predicted without its fold.
        change: (F, P) parameters without the fold minus those with it.
    """

    raw: Floats
    change: Floats


def fold_ridge(equations: NormalEquations, beta: float) -> Floats:
    """(K,) what is added to the diagonal of a fold's normal equations."""
    basis = equations.basis
    ridge = beta * basis.prior_precision
    ridge[: len(basis.singular)] = np.maximum(WEAK * beta / basis.singular**2, ROUNDING)
    return ridge


def leave_out(solution: Solution, fold: Ints, w: Whitening) -> Folds:
    """Refit without each fold and predict it.

    Args:
        solution: the full fit.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    equations, basis = solution.equations, solution.equations.basis
    z = equations.solve(solution.beta)
    ridge = fold_ridge(equations, solution.beta)
    flat = len(basis.singular)
    full = equations.gram + np.diag(ridge)
    target = solution.white + solution.rows @ z
    rhs = solution.rows.T @ target + np.where(np.arange(len(z)) < flat, ridge, 0.0) * z
    live = basis.transform[solution.live]
    of_row = w.rows_of(fold)
    predicted = solution.raw.copy()
    change = np.empty((int(fold.max()) + 1, basis.transform.shape[0]))
    for f in range(len(change)):
        rows = solution.rows[of_row == f]
        h = full - rows.T @ rows
        b = rhs - rows.T @ target[of_row == f]
        step = sl.solve(h, b, assume_a="pos", check_finite=False) - z
        change[f] = basis.transform @ step
        mine = fold == f
        predicted[mine] -= solution.jacobian[mine] @ (live @ step)
    return Folds(predicted, change)
