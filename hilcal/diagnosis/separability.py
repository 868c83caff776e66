"""How well the readings at hand separate two suspects.

Suppose suspect A is the cause, with the parameters β that are estimated: it adds βᵀ S_A β to the
whitened sum of squares beside the fitted model, S_A the information on A. The share

    u = βᵀ S_A|B β / βᵀ S_A β,

S_A|B the Schur complement of suspect B, remains when B is fitted instead: λ = βᵀ S_A|B β is the
non-centrality of the test of A beyond B, as in planning. With k times as many readings like these
it is k λ; the two are separated when it reaches `NEEDED`.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.diagnosis.effect_ranking import Suspect
from hilcal.effects.protocol import Effect
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.linearisation import Linearisation
from hilcal.regression.schur import schur_complement

NEEDED = 12.0
"""Sum of squares, in σ², by which the right one of two suspects fits better when it is found in
nine cases of ten at odds of 20 : 1: the difference scatters by twice the root of it."""
ALIKE = 1e-3
"""Share below which no number of readings like these separates two effects; a guess."""


@dataclass(frozen=True, slots=True)
class Separability:
    """How a rival differs from a suspect.

    Attributes:
        effect: the rival.
        unlike: u, the share of the suspect's sum of squares that the rival cannot explain.
        times: k, how many times as many readings like these would separate them; infinite
            where no number would.
    """

    effect: str
    unlike: float
    times: float

    @property
    def possible(self) -> bool:
        """Whether more readings like these would separate them."""
        return bool(np.isfinite(self.times))


def separability(
    p: Linearisation, lead: Suspect, effects: tuple[Effect, ...]
) -> tuple[Separability, ...]:
    """Return how each rival in `lead.same_as` differs from the leading suspect.

    Args:
        p: linearisation of the fit.
        lead: the leading suspect.
        effects: all candidates.
    """
    by_name = {e.name: e for e in effects}
    own, beta = effect_columns(p.fit, by_name[lead.effect]).white, lead.score.step
    effect = np.arange(own.shape[1])
    out = []
    for name in lead.same_as:
        s = p.information(np.hstack([own, effect_columns(p.fit, by_name[name]).white]))
        total = float(beta @ s[np.ix_(effect, effect)] @ beta)
        unlike = float(beta @ schur_complement(s, effect) @ beta) / max(total, 1e-300)
        times = np.inf if unlike < ALIKE else NEEDED / max(unlike * total, 1e-300)
        out.append(Separability(name, unlike, times))
    return tuple(out)
