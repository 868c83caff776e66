"""How well the readings at hand separate two suspects.

Suppose suspect A is the cause, as strong as it is estimated: it adds y = M X_A β to the whitened
residual, M the projection that the fitted model leaves. What suspect B cannot imitate of it,

    u = ‖y − M X_B (X_Bᵀ M X_B)⁻¹ X_Bᵀ M y‖² / ‖y‖²,

adds u ‖y‖² to the sum of squares that remains when B is fitted instead. With k times as many
readings like these it is k times that; they are separated when it reaches `NEEDED`.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.diagnose.effect_ranking import Suspect, family
from hilcal.diagnose.projection import Projection
from hilcal.effects.protocol import Effect
from hilcal.types import Floats

NEEDED = 12.0
"""Sum of squares, in σ², by which the right one of two suspects fits better when it is found in
nine cases of ten at odds of 20 : 1: the difference scatters by twice the root of it."""
ALIKE = 1e-3
"""Share below which no number of readings like these separates two effects; a guess."""
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class Separability:
    """How a rival differs from a suspect.

    Attributes:
        effect: the rival.
        unlike: u, the share of what the suspect does that the rival cannot imitate.
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
    p: Projection, lead: Suspect, effects: tuple[Effect, ...]
) -> tuple[Separability, ...]:
    """Return how each rival in `lead.same_as` differs from the leading suspect.

    Args:
        p: the fitted model's part.
        lead: the leading suspect.
        effects: all candidates.
    """
    by_name = {e.name: e for e in effects}
    own = p.free(family(p.fit, by_name[lead.effect]).white)
    y = own @ lead.score.step
    total = float(y @ y)
    out = []
    for name in lead.same_as:
        rival = p.free(family(p.fit, by_name[name]).white)
        unlike = float(np.sum(_left(rival, y) ** 2)) / max(total, 1e-300)
        times = np.inf if unlike < ALIKE else NEEDED / max(unlike * total, 1e-300)
        out.append(Separability(name, unlike, times))
    return tuple(out)


def _left(x: Floats, y: Floats) -> Floats:
    """Residual (R,) of y by the columns (R, P)."""
    u, s, _ = np.linalg.svd(x, full_matrices=False)
    u = u[:, s > ROUNDING * s.max(initial=0.0)]
    return np.asarray(y - u @ (u.T @ y))
