"""What the linearisation promised of an effect, and what the exact model keeps of it.

A suspect is scored at the linearisation of the fit. An effect that acts on the readings in the
second order only, as geometry does on deflections, is then scored by columns that hold for small
parameters; those that it would need may be too large for them. So the step that the score promises
is taken, with the model's own parameters beside it, and the exact model is evaluated there. Where
that loses much of the promise, a refit decides.

The promise, and what was kept of it, are reductions of ‖r‖² − dof, the misfit beyond the noise.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.identification.effect_columns import EffectColumns
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import Linearisation
from hilcal.identification.residual import residual
from hilcal.regression.evidence import FamilyScore

LEAST_KEPT = 0.5
"""Share of the promise that must be kept; a choice, true effects of 3 σ keep 0.9 and more."""


def promised(score: FamilyScore) -> float:
    """Return the reduction of the misfit that a score promises."""
    return score.gain - score.effective


def kept_by_refit(before: Fit, after: Fit, score: FamilyScore) -> float:
    """Return the share of the promise that a refit with the effect kept; 1 where none was made.

    Fits that set other readings aside are not compared.
    """
    if promised(score) <= 0 or np.any(before.outlier != after.outlier):
        return 1.0
    kept = (before.chi2 - before.dof) - (after.chi2 - after.dof)
    return kept / promised(score)


def kept_by_step(p: Linearisation, of: EffectColumns, score: FamilyScore) -> float:
    """Return the share of the promise that the exact model keeps where the promise is made.

    Args:
        p: linearisation of the fit.
        of: columns of an effect that is not in its model.
        score: of the effect.
    """
    fit, s = p.fit, p.fit.solution
    aim = s.white - of.white @ score.step
    z = p.projection.solve(p.rows.T @ aim - p.projection.ridge * s.coordinates())
    model = replace(fit.model, effects=(*fit.model.effects, of.effect))
    theta = [s.theta + s.transform @ z, of.scale * score.step]
    linear = float(np.sum((aim - p.rows @ z) ** 2))
    try:
        states = s.prediction.situation.states
        found = model.predict(states, np.concatenate(theta), near=s.prediction)
    except CannotAnswerError:
        return 0.0
    w, readings = fit.whitening, fit.readings[~fit.outlier]
    exact = float(np.sum(w.whiten(residual(readings, found, w)) ** 2))
    return (fit.chi2 - exact) / max(fit.chi2 - linear, 1e-300)


def kept(
    p: Linearisation, of: EffectColumns, score: FamilyScore, refit: Callable[[Fit, str], Fit]
) -> float:
    """Return the share of the promise that is kept, by the step, or where that is little a refit.

    Args:
        p: linearisation of the fit.
        of: columns of an effect that is not in its model.
        score: of the effect.
        refit: returns a fit with one more effect.
    """
    share = kept_by_step(p, of, score)
    if share >= LEAST_KEPT:
        return share
    return max(share, kept_by_refit(p.fit, refit(p.fit, of.effect.name), score))
