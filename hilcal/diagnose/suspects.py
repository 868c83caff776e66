"""Which effects of the catalogue could be missing, best first."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnose.projection import Projection
from hilcal.diagnose.score import Score
from hilcal.effects.catalogue import catalogue, make
from hilcal.effects.options import reading_options
from hilcal.effects.protocol import Effect
from hilcal.types import Floats

SAME_EVIDENCE = 3.0
"""Two suspects whose evidence differs by less than e³ = 20 : 1 are not told apart."""


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """An effect that is not in the model, and what it would explain.

    Attributes:
        effect: canonical name.
        score: the joint test of the whole family.
        share: share of the misfit it explains.
        holdout_share: the same on poses left out.
        same_as: other suspects that these data cannot tell from it.
    """

    effect: str
    score: Score
    share: float
    holdout_share: float
    same_as: tuple[str, ...] = ()


def candidates(p: Projection) -> tuple[Effect, ...]:
    """Effects that are not in the model and can be computed from these readings."""
    fit = p.fit
    states = fit.readings[~fit.outlier].states
    out = []
    for name, kind in catalogue().items():
        if name not in fit.model.names and kind.computable(states):
            effect = make(name, fit.model.cell, states, reading_options(name, fit.whitening.m))
            out.append(effect.for_scoring(states))
    return tuple(out)


def columns(p: Projection, effect: Effect) -> Floats:
    """Whitened columns (R, P) of an effect in ordinary magnitudes of its parameters."""
    fit, w = p.fit, p.fit.whitening
    s = fit.solution
    jacobian = fit.model.jacobian_of((effect,), s.prediction, s.theta, w.m)
    scale = np.array([q.scale for q in effect.parameters])
    return w.whiten(w.raw(jacobian * scale)).reshape(-1, len(scale))


def rank_suspects(p: Projection, effects: tuple[Effect, ...]) -> tuple[Suspect, ...]:
    """Score all effects; best first by evidence, with those that cannot be told apart named."""
    found = []
    for effect in effects:
        x = columns(p, effect)
        result = p.score(x)
        found.append(
            Suspect(effect.name, result, p.share(result.gain), p.held_out_share(x, result))
        )
    found.sort(key=lambda s: (-s.score.log_evidence, s.score.p_value))
    return tuple(
        replace(
            s,
            same_as=tuple(
                o.effect
                for o in found
                if o is not s
                and min(o.score.log_evidence, s.score.log_evidence) > SAME_EVIDENCE
                and abs(o.score.log_evidence - s.score.log_evidence) < SAME_EVIDENCE
            ),
        )
        for s in found
    )
