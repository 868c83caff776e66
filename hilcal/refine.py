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

MOST_REVISIONS = 15
LEAST_GAIN = 0.002
"""Share by which the error on poses left out must fall for an effect to stay."""

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
            before = steps[-1].fit.holdout.rms_sigma
            if trial.holdout.rms_sigma < (1 - LEAST_GAIN) * before:
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


def _names(model: Model) -> str:
    return " + ".join(model.names) or "the bare arm"
