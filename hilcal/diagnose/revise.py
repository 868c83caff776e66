"""Changes of a model: an effect more, one less, one in place of another."""

import numpy as np

from hilcal.diagnose.projection import projection
from hilcal.diagnose.suspects import SAME_EVIDENCE, Suspect, candidates, rank_suspects
from hilcal.effects.catalogue import make
from hilcal.effects.options import reading_options
from hilcal.errors import InputError
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model
from hilcal.types import Floats

LEAST_GAIN = 0.002
"""Share by which the error on poses left out must fall for an effect to stay ..."""
SURE = 2.0
"""... and by how many of its standard errors, from pose to pose."""


def add(before: Fit, effect: str) -> Fit:
    """Refit with one more effect, from where the fit stands.

    Raises:
        InputError: unknown effect, one that is there already, or one that these readings
            cannot show.
    """
    readings = before.readings
    if effect in before.model.names:
        raise InputError(
            f"effect {effect} is in the model already: {', '.join(before.model.names)}"
        )
    options = reading_options(effect, readings.m)
    model = before.model + make(effect, before.model.cell, readings.states, options)
    start = np.concatenate([before.theta, np.zeros(model.size - before.model.size)])
    return fit(model, readings, before.mode, before.scaling, start)


def remove(before: Fit, effect: str) -> Fit:
    """Refit without an effect, from where the fit stands.

    Raises:
        InputError: an effect that is not there.
    """
    model = before.model
    if effect not in model.names:
        raise InputError(f"effect {effect} is not in the model: {', '.join(model.names)}")
    place = model.names.index(effect)
    rest = tuple(e for e in model.effects if e.name != effect)
    start = np.delete(before.theta, model.slices()[place])
    return fit(Model(model.cell, rest), before.readings, before.mode, before.scaling, start)


def rivals_of(without: Fit, effect: str) -> tuple[Suspect, tuple[Suspect, ...]]:
    """Score an effect anew, against the model without it; returns it and those that are better.

    Args:
        without: a fit that lacks the effect.
        effect: that was in the model.

    Returns:
        The effect as a suspect, with what it is not told from now; and the suspects that the
        readings prefer beyond doubt, best first.
    """
    p = projection(without)
    ranked = rank_suspects(p, candidates(p))
    own = next(s for s in ranked if s.effect == effect)
    limit = own.score.log_evidence + SAME_EVIDENCE
    return own, tuple(s for s in ranked if s.score.log_evidence > limit)


def predicts_better(before: Fit, after: Fit) -> bool:
    """Whether the error on poses left out falls, by more than it scatters from pose to pose."""
    if after.holdout.rms_sigma >= (1 - LEAST_GAIN) * before.holdout.rms_sigma:
        return False
    if np.any(before.outlier != after.outlier):
        return True
    gain = _squares_by_pose(before) - _squares_by_pose(after)
    error = float(np.std(gain)) / np.sqrt(max(len(gain) - 1, 1))
    return bool(np.mean(gain) > SURE * error)


def _squares_by_pose(f: Fit) -> Floats:
    """Squared whitened residual of each pose, predicted without it."""
    white = f.whitening.whiten(f.left_out).reshape(len(f.left_out), -1)
    return np.asarray(np.bincount(f.pose, weights=np.sum(white**2, axis=1)), dtype=float)
