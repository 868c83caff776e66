"""Recorded variables that the readings cannot tell apart as the cause of an effect.

Time, air temperature and joint temperatures often rise together. An effect that depends on one of
them is then explained as well by another, which no other effect of the catalogue may do: a tracker
that drifts in time and a floor that moves with the air temperature displace the readings alike.

An effect's variable x is replaced by its best linear function of another recorded variable y,
x' = a + b y, within the range of x. The columns of the effect with x' are scored against the model
without the effect. If their evidence is at most 20 : 1 below that of the effect itself, the
readings do not distinguish x from y.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import (
    effect_columns,
    eliminate_effect,
    linearise,
    model_columns,
)
from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.types import Floats

VARIABLES = {
    "time": "time",
    "load_time": "time under load",
    "air_temperature": "air temperature",
    "joint_temperature": "joint temperature",
}
"""Columns of `States` that may change together, and their names; of the joints' temperatures the
mean stands for all."""


@dataclass(frozen=True, slots=True)
class Confounded:
    """An effect that could as well depend on another recorded variable."""

    effect: str
    variable: str  # on which the effect depends
    instead: tuple[str, ...]  # variables that explain the readings as well


def confounded(fit: Fit, suspect: Effect | None = None) -> tuple[Confounded, ...]:
    """Return the named effects, and the suspect, whose variable the readings do not prove.

    Args:
        fit: gc-scaled.
        suspect: an effect that is not in the model.
    """
    states = fit.solution.prediction.situation.states
    changing = {
        field: values.reshape(len(states), -1).mean(axis=1)
        for field in VARIABLES
        if (values := getattr(states, field)) is not None and np.ptp(values) > 0.0
    }
    named = [e for e in fit.model.effects if e.name in fit.model.named]
    effects = [e for e in (*named, suspect) if e is not None and _fields(e, changing)]
    if len(changing) < 2 or not effects:
        return ()
    out = []
    for effect in effects:
        score = _beside_others(fit, effect) if effect is not suspect else linearise(fit).score
        white = effect_columns(fit, effect).white
        least = score(white).log_evidence - SAME_EVIDENCE
        if least <= 0.0:
            continue
        for field in _fields(effect, changing):
            instead = []
            for other, y in changing.items():
                swapped = _with_function_of(fit, effect, field, y)
                uses = other != field and not np.array_equal(swapped, white)
                if uses and score(swapped).log_evidence > least:
                    instead.append(VARIABLES[other])
            if instead:
                out.append(Confounded(effect.name, VARIABLES[field], tuple(instead)))
    return tuple(out)


def _beside_others(fit: Fit, effect: Effect) -> Callable[[Floats], FamilyScore]:
    """Return the scoring of whitened columns (R, P) in place of an effect of the model."""
    columns = model_columns(fit)
    reduced = eliminate_effect(fit, columns, effect.name)

    def score(x: Floats) -> FamilyScore:
        s = reduced.information(x, x.T @ x, columns.white.T @ x)
        return score_family(s, x.T @ reduced.residual, reduced.rss, reduced.dof)

    return score


def _fields(effect: Effect, changing: dict[str, Floats]) -> list[str]:
    """Return the changing variables on which an effect may depend."""
    needed = {field for need in effect.needs for field in need.split(" or ")}
    return [field for field in changing if field in needed]


def _with_function_of(fit: Fit, effect: Effect, field: str, y: Floats) -> Floats:
    """Return the whitened columns (R, P) of an effect with x' for x; the same if it uses no x."""
    solution = fit.solution
    situation = solution.prediction.situation
    a = np.column_stack([np.ones(len(y)), y - y.mean()])
    x: Floats = getattr(situation.states, field)
    function = np.clip(a @ np.linalg.lstsq(a, x)[0], x.min(axis=0), x.max(axis=0))
    changed: dict[str, Any] = {field: function}
    states = replace(situation.states, **changed)
    prediction = replace(solution.prediction, situation=replace(situation, states=states))
    swapped = replace(fit, solution=replace(solution, prediction=prediction))
    return effect_columns(swapped, effect).white
