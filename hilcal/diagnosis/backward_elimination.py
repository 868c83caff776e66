"""One step of backward elimination: effects without which the readings are explained as well.

An effect that was added early, in place of another that was found later, is often redundant in
the end. It is scored like a suspect of the model without it, at the same linearisation; it is
redundant where its F-test is not significant.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.identification.carried_evidence import carried_effects, evidence_of_carried
from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import eliminate_effect, model_columns
from hilcal.regression.evidence import FamilyScore

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
    score: FamilyScore


def backward_elimination(
    fit: Fit, known: Mapping[str, FamilyScore] = MappingProxyType({})
) -> tuple[Redundant, ...]:
    """Return the redundant effects of a fit, the least significant first.

    Those with a carried prior are judged by `spoken_against`: other readings speak for them; random
    ones by `background_evidence`.

    Args:
        fit: the fit.
        known: scores of its effects against the model without them, as far as they were made.
    """
    carried = fit.solution.space.carried(fit.model.size)
    judged = [
        e.name
        for e, mine in zip(fit.model.effects, fit.model.slices(), strict=True)
        if e.role == "effect" and e.name not in fit.model.random and not carried[mine].any()
    ]
    if not judged:
        return ()
    scores = {name: known[name] for name in judged if name in known}
    if len(scores) < len(judged):
        x = model_columns(fit)
        scores = {n: scores.get(n) or eliminate_effect(fit, x, n).score() for n in judged}
    found = [Redundant(n, scores[n]) for n in judged if scores[n].p_value > CHANCE]
    return tuple(sorted(found, key=lambda n: -n.score.p_value))


def spoken_against(fit: Fit) -> tuple[str, ...]:
    """Return effects of a carried prior that the new readings speak against, the most so first.

    As after a repair: at odds of 20 : 1 they are likelier without the effect than with what the
    earlier readings said of it.
    """
    names = carried_effects(fit.model) if fit.scaling == "gc" else ()
    if not names:
        return ()
    of = evidence_of_carried(fit.model, fit.solution, fit.whitening, names)
    return tuple(n for n in sorted(of, key=lambda n: of[n]) if of[n] < -SAME_EVIDENCE)
