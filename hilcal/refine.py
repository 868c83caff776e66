"""Diagnose and add, until the model is adequate or something must be measured."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Mode
from hilcal.diagnose.verdict import Diagnosis, Verdict, diagnose
from hilcal.effects.catalogue import make
from hilcal.effects.options import reading_options
from hilcal.errors import InputError
from hilcal.identify.fit import Fit, fit
from hilcal.model import Model
from hilcal.types import Floats

MOST_REVISIONS = 15
LEAST_GAIN = 0.002
"""Share by which the error on poses left out must fall for an effect to stay ..."""
SURE = 2.0
"""... and by how many of its standard errors, from pose to pose."""

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One revision: a fit, its diagnosis, and the effect that was added to get there."""

    fit: Fit
    diagnosis: Diagnosis
    added: str | None


@dataclass(frozen=True, slots=True, eq=False)
class Refinement:
    """The steps of a refinement, and why it stopped.

    Attributes:
        steps: from the starting model to the last one.
        verdict: of the last model; `ambiguous` where an added effect could as well have been
            another.
        message: the reason in a sentence.
        rejected: effects that were tried and did not lower the error on poses left out.
    """

    steps: tuple[Step, ...]
    verdict: Verdict
    message: str
    rejected: tuple[str, ...]


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


def refine(model: Model, readings: Readings, mode: Mode, say: Say | None = None) -> Refinement:
    """Fit, diagnose, add the leading suspect, and repeat.

    An effect stays only if the error on poses left out falls. Where the leading suspect
    cannot be told from others it is added all the same, since any of them lowers the error,
    but the final verdict names the doubt.

    Args:
        model: the starting model.
        readings: all readings.
        mode: "deflection" or "absolute".
        say: told what is being done, for people who wait.
    """
    tell = say or (lambda text: None)
    tell(f"fitting {_names(model)}")
    current = fit(model, readings, mode)
    tell("diagnosing")
    steps = [Step(current, diagnose(current), None)]
    rejected: list[str] = []
    doubts: list[str] = []
    while len(steps) < MOST_REVISIONS:
        diagnosis = steps[-1].diagnosis
        for name in diagnosis.significant:
            if name in rejected:
                continue
            tell(f"adding {name}")
            trial = add(steps[-1].fit, name)
            if predicts_better(steps[-1].fit, trial):
                same = next(s.same_as for s in diagnosis.suspects if s.effect == name)
                if same:
                    doubts.append(f"{name} could as well be {' or '.join(same)}")
                tell(f"added {name}; diagnosing")
                steps.append(Step(trial, diagnose(trial), name))
                break
            rejected.append(name)
        else:
            break
    last = steps[-1].diagnosis
    verdict, message = last.verdict, last.message
    if verdict in ("missing_effect", "ambiguous") and rejected:
        verdict = "unknown_effect"
        message = (
            f"{', '.join(rejected)} would explain part of the misfit, but does not lower the error "
            f"on poses left out; {message}"
        )
    if doubts and verdict == "adequate":
        verdict = "ambiguous"
        message = f"{message}; but {'; '.join(doubts)}: measure what separates them"
    return Refinement(tuple(steps), verdict, message, tuple(rejected))


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


def _names(model: Model) -> str:
    return " + ".join(model.names) or "the bare arm"
