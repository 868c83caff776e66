"""Prediction of poses that were left out, and what leaving out does to the parameters.

Whole poses are left out, never single readings: readings of one pose share its errors. Each
fold is refitted by one Gauss-Newton step from the full fit, in which the fold's rows are
taken out of the normal equations exactly.

Without a fold the flat parameters have a prior about zero (see `regression.leave_out`), whose
standard deviation is their ordinary magnitude, or the rms of the effect's parameters in the full
fit where that is more.
"""

import numpy as np

from hilcal.data.whitening import Whitening
from hilcal.identify.gauss_newton import Solution
from hilcal.identify.priors import scales_of
from hilcal.model import Model
from hilcal.regression.leave_out import Fold, folds
from hilcal.types import Floats, Ints


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
    """Magnitude (P,) of each parameter: the ordinary one, or the rms over its effect if more."""
    out = scales_of(model)
    for mine in model.slices():
        out[mine] *= max(1.0, float(np.sqrt(np.mean((theta[mine] / out[mine]) ** 2))))
    return out


def changes(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Floats:
    """Return the parameters without each fold minus those with it (F, P).

    Args:
        model: the model.
        solution: the full fit.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    steps = [one.step() for one in folds_of(model, solution, w.rows_of(fold))]
    return np.asarray(np.array(steps) @ solution.equations.basis.transform.T)


def leave_out(
    model: Model, solution: Solution, jacobian: Floats, fold: Ints, w: Whitening
) -> Floats:
    """Return the residual (D, m) of each measurement, predicted without its fold.

    Args:
        model: the model.
        solution: the full fit.
        jacobian: (D, m, L) of the measurements by its live parameters.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    predicted = solution.raw.copy()
    for f, change in enumerate(changes(model, solution, fold, w)):
        predicted[fold == f] -= jacobian[fold == f] @ change[solution.live]
    return predicted
