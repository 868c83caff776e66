"""How probable it is that an arm has an effect, from the evidence of a refinement.

The odds for an effect are the prior odds times exp(L - 1), with L its log evidence at the strength
that the evidence prefers, which costs one unit. L is, whichever was said last:

    of an effect that was named: against the model without it
    of an effect of a background: half the restricted likelihood ratio, beside all others
    of another suspect: beside the model of the step that tested it
    of an effect that no step tested: 0

Where others explain as much as a named effect, they share the probability: the named one stays with
1 / (1 + exp(L_others - L - (number of others) + 1)), and the others have the rest.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from hilcal.diagnosis.diagnosis import Diagnosis

PRIOR_ODDS = 1.0 / 9.0
"""That an arm has an effect of the catalogue which readings can prove: one in ten; a choice."""
LARGEST = 30.0
"""Log evidence from which on nothing is gained: a probability of 1 - 2e-12."""


def effect_probabilities(steps: Sequence[Diagnosis], effects: Iterable[str]) -> dict[str, float]:
    """Return the probability that the arm has each effect.

    Each is judged by itself: the probabilities do not add up to 1.

    Args:
        steps: diagnoses of a refinement, in its order; the last one judges what was named.
        effects: names of the effects.
    """
    others = steps[-1].alternatives
    evidence = {a.effect: a.own for a in others}
    for d in reversed(steps):
        evidence = {b.effect: b.ratio / 2 for b in d.background} | evidence
        evidence = {s.effect: s.score.log_evidence for s in d.suspects} | evidence
    wanted = tuple(effects)
    p = {name: _present(evidence.get(name, 0.0)) for name in {*wanted, *evidence}}
    for a in others:
        stays = _logistic(a.own - a.log_evidence + len(a.others) - 1)
        p |= {name: max(p.get(name, 0.0), 1.0 - stays) for name in a.others}
        p[a.effect] = min(p[a.effect], stays)
    return {name: p[name] for name in wanted}


def _present(log_evidence: float) -> float:
    gain = np.clip(log_evidence, -LARGEST, LARGEST) - 1.0
    return float(1.0 / (1.0 + np.exp(-gain) / PRIOR_ODDS))


def _logistic(x: float) -> float:
    return float(1.0 / (1.0 + np.exp(-np.clip(x, -LARGEST, LARGEST))))
