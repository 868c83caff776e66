"""Which effects of the catalogue could be missing, best first.

A suspect passes all tests where the F-test over the whole catalogue rejects that it is absent,
its evidence is positive, it explains a share of the misfit on poses left out, and the error there
falls by more than it scatters from pose to pose.
"""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.diagnose.minimum_detectable_effect import Strength, least_strength
from hilcal.effects.protocol import Effect
from hilcal.identify.fit import Fit
from hilcal.identify.linearisation import EffectColumns, Linearisation, effect_columns
from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats

SAME_EVIDENCE = 3.0
"""Two suspects whose evidence differs by less than e³ = 20 : 1 count as inseparable."""
FALSE_ALARM = 0.001
"""Chance of naming any effect where none is missing, over the whole catalogue."""
LEAST_SHARE = 0.01
"""An effect that explains less of the misfit on poses left out is not worth adding; a guess."""


@dataclass(frozen=True, slots=True, eq=False)
class Suspect:
    """An effect that is not in the model, and what it would explain.

    Attributes:
        effect: canonical name.
        score: the joint test of the whole family.
        share: share of the misfit it explains.
        holdout_share: the same on poses left out.
        explains: whether it passes the tests of the fitted readings and of its share.
        sure: whether the error on poses left out falls by more than it scatters from pose to
            pose; not so where a refit has shown that it does not fall.
        least: the smallest strength of it that these readings would reveal.
        same_as: other suspects that these readings do not separate from it.
    """

    effect: str
    score: FamilyScore
    share: float
    holdout_share: float
    explains: bool
    sure: bool
    least: Strength
    same_as: tuple[str, ...] = ()

    @property
    def passes(self) -> bool:
        """Whether it passes all tests."""
        return self.explains and self.sure


def candidates(fit: Fit) -> tuple[Effect, ...]:
    """Effects that are not in the model and can be computed from these readings."""
    states = fit.readings[~fit.outlier].states
    model, out = fit.model, []
    for kind in model.catalogue.effects:
        if kind.name not in model.names and kind.computable(states):
            effect = model.catalogue.make(kind.name, model.cell, states, m=fit.whitening.m)
            out.append(effect.for_scoring(states))
    return tuple(out)


def catalogue_columns(fit: Fit) -> tuple[Floats, dict[str, slice]]:
    """Return the columns (R, P) of all `candidates`, and which are whose."""
    families = [effect_columns(fit, e) for e in candidates(fit)]
    ends = np.cumsum([0] + [f.white.shape[1] for f in families])
    columns = np.hstack([np.zeros((len(fit.white), 0)), *(f.white for f in families)])
    return columns, {
        f.effect.name: slice(int(a), int(b))
        for f, a, b in zip(families, ends[:-1], ends[1:], strict=True)
    }


def rank_suspects(
    p: Linearisation, effects: Sequence[Effect], level: float = FALSE_ALARM
) -> tuple[Suspect, ...]:
    """Score all effects; best first, see `ranked`.

    Args:
        p: linearisation of the fit.
        effects: that are not in the model.
        level: of the test over all of them together.
    """
    found = [_suspect(p, effect_columns(p.fit, e), level / len(effects)) for e in effects]
    tested = max(sum(s.score.rank > 0 for s in found), 1)
    return ranked(
        replace(
            s,
            explains=s.score.p_value * tested < level
            and s.score.log_evidence > 0
            and s.holdout_share >= LEAST_SHARE,
        )
        for s in found
    )


def ranked(suspects: Iterable[Suspect], rejected: Collection[str] = ()) -> tuple[Suspect, ...]:
    """Order suspects, and name those that are inseparable.

    First come those that pass all tests, then those that explain the misfit but do not surely
    lower the error on poses left out, then the others; by evidence in each of these groups.

    Args:
        suspects: in any order.
        rejected: names of those whose addition did not lower the error on poses left out.
    """
    found = [replace(s, sure=s.sure and s.effect not in rejected) for s in suspects]
    found.sort(key=lambda s: (-s.passes, -s.explains, -s.score.log_evidence, s.score.p_value))
    return tuple(
        replace(
            s,
            same_as=tuple(
                o.effect
                for o in found
                if o is not s
                and o.effect not in rejected
                and min(o.score.log_evidence, s.score.log_evidence) > SAME_EVIDENCE
                and abs(o.score.log_evidence - s.score.log_evidence) < SAME_EVIDENCE
            ),
        )
        for s in found
    )


def _suspect(p: Linearisation, of: EffectColumns, level: float) -> Suspect:
    s = p.information(of.white)
    result = p.score(of.white, s)
    held = p.held_out(of.white, result)
    return Suspect(
        effect=of.effect.name,
        score=result,
        share=p.share(result.gain),
        holdout_share=held.share,
        explains=False,
        sure=held.sure,
        least=least_strength(
            s,
            of.motion,
            of.scale,
            tuple(q.unit for q in of.effect.parameters),
            p.fit.dof,
            max(p.fit.variance_factor, 1.0),
            level,
        ),
    )
