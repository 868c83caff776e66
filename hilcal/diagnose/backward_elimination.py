"""One step of backward elimination: effects without which the readings are explained as well.

An effect that was added early, in place of another that was found later, is often redundant in
the end. It is scored like a suspect of the model without it, at the same linearisation; it is
redundant where its F-test is not significant.
"""

from dataclasses import dataclass

from hilcal.diagnose.score import Score, score
from hilcal.diagnose.without import Without, leave_out_effect, whitened_columns
from hilcal.identify.fit import Fit

CHANCE = 0.01
"""An effect with a smaller p-value is kept."""


@dataclass(frozen=True, slots=True, eq=False)
class Redundant:
    """An effect that can be removed.

    Attributes:
        effect: canonical name.
        score: of its columns, against the model without it.
    """

    effect: str
    score: Score


def backward_elimination(fit: Fit) -> tuple[Redundant, ...]:
    """Return the redundant effects of a fit, the least significant first."""
    judged = [e.name for e in fit.model.effects if e.role == "effect"]
    if not judged:
        return ()
    x = whitened_columns(fit)
    found = []
    for name in judged:
        result = own_score(leave_out_effect(fit, x, name))
        if result.p_value > CHANCE:
            found.append(Redundant(name, result))
    return tuple(sorted(found, key=lambda n: -n.score.p_value))


def own_score(w: Without) -> Score:
    """Score an effect against the model without it."""
    x = w.columns
    return score(x.T @ w.free(x), x.T @ w.rest, float(w.rest @ w.rest), w.dof)
