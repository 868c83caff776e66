"""Prediction of poses that were left out, and what leaving out does to the parameters.

Whole poses are left out, never single readings: readings of one pose share its errors. Each
fold is refitted by one Gauss-Newton step from the full fit, in which the fold's rows are
taken out of the normal equations exactly.

Without a fold the flat parameters have a prior about zero (see `regression.leave_out`), whose
standard deviation is their ordinary magnitude, or the rms of the effect's parameters in the full
fit where that is more.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.data.whitening import Whitening
from hilcal.identify.gauss_newton import Solution, scales_of
from hilcal.model import Model
from hilcal.regression.leave_out import Fold, folds
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Folds:
    """Refits without each fold.

    Attributes:
        raw: (D, m) residual of each measurement, predicted without its fold.
        change: (F, P) parameters without the fold minus those with it.
    """

    raw: Floats
    change: Floats


def folds_of(model: Model, solution: Solution, fold: Ints) -> tuple[Fold, ...]:
    """Return the normal equations of a fit without each fold.

    Args:
        model: the model.
        solution: its fit.
        fold: (R,) fold of each row.
    """
    return folds(
        solution.projection(),
        solution.white,
        solution.equations,
        solution.theta,
        solution.prior,
        ordinary(model, solution.theta),
        solution.beta,
        fold,
    )


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
    live = basis.transform[solution.live]
    predicted = solution.raw.copy()
    change = np.empty((int(fold.max()) + 1, basis.transform.shape[0]))
    for f, equations in enumerate(folds_of(model, solution, w.rows_of(fold))):
        step = equations.step()
        change[f] = basis.transform @ step
        mine = fold == f
        predicted[mine] -= solution.jacobian[mine] @ (live @ step)
    return Folds(predicted, change)
