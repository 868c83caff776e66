"""Changes of a model: an effect more, one less, one in place of another."""

from dataclasses import replace

import numpy as np

from hilcal.effects.options import Options
from hilcal.effects.written import read_effects_text
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import left_out_by_pose
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.regression.leave_out import LEAST_GAIN, improves
from hilcal.types import Floats


def add(before: Fit, effect: str, options: Options | None = None) -> Fit:
    """Refit with one more effect, from where the fit stands.

    One that is finer than an effect of the model, as joint_compliance(joints=each) where the model
    has one for all joints, takes its place. One of the background becomes a named one, and keeps
    its standard deviation.

    Args:
        effect: its name; with options as `read_effects_text` reads them.
        options: of the effect, where they are not the usual ones.

    Raises:
        InputError: unknown effect, one that is there already, or one that these readings
            cannot show; an unknown option, or a bad value.
    """
    model, start = _grown(before.model, before.theta, effect, before.readings, options)
    return fit(model, before.readings, before.mode, before.scaling, start)


def trial(before: Fit, effect: str) -> Fit | None:
    """Refit with one more effect, see `add`; None where the readings do not allow it.

    They are too few to determine its parameters, or the arm has no equilibrium with it.
    """
    try:
        return add(before, effect)
    except CannotAnswerError:
        return None


def remove(before: Fit, effect: str) -> Fit:
    """Refit without an effect, from where the fit stands.

    Raises:
        InputError: an effect that is not there.
    """
    model, start = _rest(before.model, before.theta, effect)
    return fit(model, before.readings, before.mode, before.scaling, start)


def _rest(model: Model, theta: Floats, effect: str) -> tuple[Model, Floats]:
    """Return the model without an effect, and its parameters."""
    if effect not in model.names:
        raise InputError(f"effect {effect} is not in the model: {', '.join(model.names)}")
    place = model.names.index(effect)
    rest = tuple(e for e in model.effects if e.name != effect)
    random = {name: std for name, std in model.random.items() if name != effect}
    left = replace(model, effects=rest, random=random, background=model.background - {effect})
    return left, np.delete(theta, model.slices()[place])


def _grown(
    model: Model, theta: Floats, effect: str, readings: Readings, options: Options | None = None
) -> tuple[Model, Floats]:
    """Return the model with one more effect, or a finer one, and parameters to start from."""
    ((name, given),) = read_effects_text(effect, "effect", model.catalogue).items()
    given = {**given, **(options or {})}
    if name in model.background and not given:
        return replace(model, background=model.background - {name}), theta
    if name in model.names:
        present = model.effects[model.names.index(name)]
        made = present.with_options(readings.states, **given)
        if not made.refines(present):
            raise InputError(f"effect {name} is in the model already: {', '.join(model.names)}")
        model, theta = _rest(model, theta, name)
    else:
        made = model.catalogue.make(name, model.cell, readings.states, given, readings.m)
    grown = model + made
    return grown, np.concatenate([theta, np.zeros(grown.size - model.size)])


def exchange(before: Fit, effect: str, other: str) -> Fit:
    """Refit with another effect in the place of one, from where the fit stands.

    Raises:
        InputError: an effect that is not there, or another that is.
    """
    rest, start = _rest(before.model, before.theta, effect)
    if other in before.model.names:
        raise InputError(f"effect {other} is in the model already: {', '.join(before.model.names)}")
    model, start = _grown(rest, start, other, before.readings)
    return fit(model, before.readings, before.mode, before.scaling, start)


def predicts_better(before: Fit, after: Fit) -> bool:
    """Whether the error on poses left out falls, by more than it scatters from pose to pose."""
    if np.any(before.outlier != after.outlier):
        one, other = before.holdout_of_all.rms_sigma, after.holdout_of_all.rms_sigma
        return other < (1 - LEAST_GAIN) * one
    return improves(left_out_by_pose(before), left_out_by_pose(after))
