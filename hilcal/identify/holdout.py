"""Prediction of poses that were left out, and what leaving out does to the parameters.

Whole poses are left out, never single readings: readings of one pose share its errors. Each
fold is refitted by one Gauss-Newton step from the full fit, in which the fold's rows are
taken out of the normal equations exactly.

What a single pose has told of a direction, the others may not see at all. A flat estimate along
it would be noise, magnified without limit, and one such pose would outweigh all others in the
error. So without a fold the flat parameters have a prior about zero, whose standard deviation is
their ordinary magnitude, or the rms of the effect's parameters in the full fit where that is more
(empirical Bayes). A direction that the rest sees by s σ per ordinary magnitude shrinks by the
share 1/(1 + s²): not at all where it is well seen, to the model without it where it is not.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.data.whitening import Whitening
from hilcal.identify.gauss_newton import Solution, scales_of
from hilcal.model import Model
from hilcal.types import Floats, Ints

ROUNDING = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Folds:
    """Refits without each fold.

    Attributes:
        raw: (D, m) residual of each measurement, predicted without its fold.
        change: (F, P) parameters without the fold minus those with it.
    """

    raw: Floats
    change: Floats


def fold_equations(model: Model, solution: Solution) -> tuple[Floats, Floats]:
    """Matrix (K, K) and right-hand side (K,) of a step from the fit, all folds still in them.

    Args:
        model: the model.
        solution: its fit.
    """
    basis, beta = solution.equations.basis, solution.beta
    flat = slice(0, len(basis.singular))
    h = solution.equations.gram + np.diag(beta * basis.prior_precision)
    h[np.diag_indices_from(h)] += np.where(basis.prior_precision > 0, 0.0, ROUNDING)
    pull = np.zeros(len(h))
    held = basis.held
    pull[flat.stop :] = solution.theta[held] / solution.prior[held]
    known = ordinary(model, solution.theta)
    per_ordinary = basis.transform[:, flat] / known[:, None]
    h[flat, flat] += beta * per_ordinary.T @ per_ordinary
    pull[flat] = per_ordinary.T @ (np.where(basis.flat, solution.theta, 0.0) / known)
    return h, solution.rows.T @ solution.white - beta * pull


def ordinary(model: Model, theta: Floats) -> Floats:
    """Magnitude (P,) of each parameter: the ordinary one, or the rms of its effect's."""
    out = scales_of(model)
    for mine in model.slices():
        out[mine] *= max(1.0, float(np.sqrt(np.mean((theta[mine] / out[mine]) ** 2))))
    return out


def leave_out(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Folds:
    """Refit without each fold and predict it.

    Args:
        model: the model.
        solution: the full fit.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    basis = solution.equations.basis
    full, rhs = fold_equations(model, solution)
    live = basis.transform[solution.live]
    of_row = w.rows_of(fold)
    predicted = solution.raw.copy()
    change = np.empty((int(fold.max()) + 1, basis.transform.shape[0]))
    for f in range(len(change)):
        out = of_row == f
        rows = solution.rows[out]
        h, b = full - rows.T @ rows, rhs - rows.T @ solution.white[out]
        step = sl.solve(h, b, assume_a="pos", check_finite=False)
        change[f] = basis.transform @ step
        mine = fold == f
        predicted[mine] -= solution.jacobian[mine] @ (live @ step)
    return Folds(predicted, change)
