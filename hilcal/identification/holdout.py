"""Prediction of poses that were left out, and what leaving out does to the parameters.

Whole poses are left out, never single readings: readings of one pose share its errors. Each
fold is refitted by one Gauss-Newton step from the full fit, in which the fold's rows are
taken out of the normal equations exactly. The strengths of shrunk families are chosen anew in each
fold (`regression.empirical_bayes`).

Without a fold the flat parameters have a prior about zero (see `regression.leave_out`), whose
standard deviation is their ordinary magnitude, or the rms of the effect's parameters in the full
fit where that is more.
"""

import numpy as np

from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.identification.priors import FIRST_GUESS, prior_of, scales_of
from hilcal.model.model import Model
from hilcal.readings.whitening import Whitening
from hilcal.regression.empirical_bayes import FamilyProblem, solutions
from hilcal.regression.leave_out import Fold, folds
from hilcal.types import Floats, Ints

MOST_ELEMENTS = 5e7
"""Elements of the columns of dropped groups up to which they may enter again in a fold. A choice,
for memory; with more readings than that a fold of a tenth hardly decides what is dropped."""


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
        solution.y,
        solution.prior,
        ordinary_y(model, solution),
        solution.beta,
        fold,
    )


def ordinary(model: Model, theta: Floats) -> Floats:
    """Magnitude (P,) of each parameter: the ordinary one, or the rms over its effect if more."""
    out = scales_of(model)
    for mine in model.slices():
        out[mine] *= max(1.0, float(np.sqrt(np.mean((theta[mine] / out[mine]) ** 2))))
    return out


def ordinary_y(model: Model, solution: Solution) -> Floats:
    """(P,) the same for the coordinates y."""
    return solution.space.scales(ordinary(model, solution.theta))


def changes(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Floats:
    """Return the parameters without each fold minus those with it (F, P).

    Args:
        model: the model.
        solution: the full fit.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    steps = [one.step() for one in folds_of(model, solution, w.rows_of(fold))]
    return np.asarray(np.array(steps) @ solution.transform.T)


def leave_out(model: Model, solution: Solution, fold: Ints, w: Whitening) -> Floats:
    """Return the residual (D, m) of each measurement, predicted without its fold.

    Args:
        model: the model.
        solution: the full fit.
        fold: (D,) fold of each measurement.
        w: the scaling of the fit.
    """
    groups = prior_of(model)[1]
    if w.scaling != "none" and bool((groups >= 0).any()):
        change = _with_families(model, solution, fold, w, groups)
    else:
        change = changes(model, solution, fold, w)
    moved = np.flatnonzero(np.any(change != 0, axis=0))
    columns = w.raw(model.jacobian(solution.prediction, solution.theta, w.m, moved))
    predicted = solution.raw.copy()
    for f, by in enumerate(change[:, moved]):
        predicted[fold == f] -= columns[fold == f] @ by
    return predicted


def _with_families(
    model: Model, solution: Solution, fold: Ints, w: Whitening, groups: Ints
) -> Floats:
    """`changes` for a model with shrunk families, whose strengths each fold chooses."""
    basis = solution.equations.basis
    flat, count = len(basis.singular), len(basis.prior_precision)
    dropped = np.flatnonzero((groups >= 0) & (solution.prior == 0))
    if len(dropped) * solution.raw.size > MOST_ELEMENTS:
        dropped = dropped[:0]
    guess = FIRST_GUESS * scales_of(model)[dropped]
    more = whitened_jacobian(model, solution.prediction, solution.theta, w, dropped)
    shrunk = groups[basis.held] >= 0
    others = np.concatenate([np.arange(flat), flat + np.flatnonzero(~shrunk)])
    kept = flat + np.flatnonzero(shrunk)
    family = np.concatenate([groups[basis.held[shrunk]], groups[dropped]])
    coordinates, order = solution.coordinates(), np.concatenate([others, kept])
    # Flat parameters have the prior about zero of `folds_of`, unshrunk ones their own.
    magnitude = ordinary_y(model, solution)
    per = basis.transform[:, :flat] / magnitude[:, None]
    own = np.where(basis.flat, solution.y / magnitude, 0.0)
    ridge = np.zeros((len(others), len(others)))
    ridge[:flat, :flat] = solution.beta * per.T @ per
    ridge[np.arange(flat, len(others)), np.arange(flat, len(others))] = solution.beta
    rows = solution.rows  # copied only where it must be: it may take a gigabyte
    if len(dropped) or np.any(np.diff(order) != 1):
        rows = np.hstack([rows[:, order], more * guess])
    found = solutions(
        FamilyProblem(
            rows=rows,
            target=solution.white + solution.rows @ coordinates,
            ridge=ridge,
            pull=np.concatenate([-solution.beta * per.T @ own, np.zeros(len(others) - flat)]),
            groups=np.unique(family, return_inverse=True)[1],
            std=np.concatenate([np.ones(len(kept)), np.zeros(len(dropped))]),
            beta=solution.beta,
        ),
        w.rows_of(fold),
    )
    z = np.empty((len(found), count))
    z[:, order] = found[:, :count]
    change = (z - coordinates) @ solution.transform.T
    change[:, dropped] = found[:, count:] * guess
    return np.asarray(change)
