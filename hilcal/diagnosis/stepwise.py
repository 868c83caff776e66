"""Changes of a model: add an effect, remove one, exchange one for another."""

from dataclasses import replace

import numpy as np

from hilcal.effects.options import Options
from hilcal.effects.written import read_effects_text
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.fit import Fit, fit_again
from hilcal.identification.linearisation import left_out_by_pose
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.regression.leave_out import LEAST_GAIN, improves
from hilcal.types import Floats


def add(before: Fit, effect: str, options: Options | None = None) -> Fit:
    """Refit with one more effect, starting from the parameters of the fit.

    A finer form of an effect of the model, such as joint_compliance(joints=each), replaces it. An
    effect of the background becomes a named effect and keeps its standard deviation.

    Args:
        effect: its name; with options as `read_effects_text` reads them.
        options: of the effect, where they are not the usual ones.

    Raises:
        InputError: unknown effect, one that the model has already, or one that these readings
            cannot show; an unknown option, or a bad value.
    """
    model, start = _grown(before.model, before.theta, effect, before.readings, options)
    return fit_again(before, model, start=start)


def trial(before: Fit, effect: str) -> Fit | None:
    """Refit with one more effect, see `add`; None where the readings do not allow it."""
    try:
        return add(before, effect)
    except CannotAnswerError:
        return None


def remove(before: Fit, effect: str) -> Fit:
    """Refit without an effect; InputError: the model lacks it."""
    model, start = _reduced(before.model, before.theta, effect)
    return fit_again(before, model, start=start)


def _reduced(model: Model, theta: Floats, effect: str) -> tuple[Model, Floats]:
    """Return the model without an effect, and its parameters."""
    reduced = model - effect
    return reduced, np.delete(theta, model.slices()[model.names.index(effect)])


def _grown(
    model: Model, theta: Floats, effect: str, readings: Readings, options: Options | None = None
) -> tuple[Model, Floats]:
    """Return the model with one more effect, or a finer one, and parameters to start from."""
    ((name, in_text),) = read_effects_text(effect, "effect", model.catalogue).items()
    merged = {**in_text, **(options or {})}
    if name in model.background and not merged:
        return replace(model, background=model.background - {name}), theta
    if name in model.names:
        present = model.effects[model.names.index(name)]
        added = present.with_options(readings.states, **merged)
        if not added.refines(present):
            raise InputError(f"effect {name} is in the model already: {', '.join(model.names)}")
        of_present = theta[model.slices()[model.names.index(name)]].tolist()
        values = dict(zip((p.name for p in present.parameters), of_present, strict=True))
        model, theta = _reduced(model, theta, name)
    else:
        added = model.catalogue.make(name, model.cell, readings.states, merged, readings.m)
        values = {}
    return model + added, np.append(theta, [values.get(p.name, 0.0) for p in added.parameters])


def exchange(before: Fit, effect: str, replacement: str) -> Fit:
    """Refit with an effect replaced by another, starting from the parameters of the fit.

    Raises:
        InputError: an effect that the model lacks, or a replacement that the model has already.
    """
    model, start = _reduced(before.model, before.theta, effect)
    names = before.model.names
    if replacement in names:
        raise InputError(f"effect {replacement} is in the model already: {', '.join(names)}")
    model, start = _grown(model, start, replacement, before.readings)
    return fit_again(before, model, start=start)


def predicts_better(before: Fit, after: Fit) -> bool:
    """Whether the error on poses left out falls, by more than it scatters from pose to pose."""
    if np.any(before.outlier != after.outlier):
        limit = (1 - LEAST_GAIN) * before.holdout_of_all.rms_sigma
        return after.holdout_of_all.rms_sigma < limit
    return improves(left_out_by_pose(before), left_out_by_pose(after))
