"""Estimate of an effect that is not in the model, from the readings so far.

The posterior of its parameters beside the fitted model, at the prior strength of most evidence:
what adding the effect would estimate, to first order, and how uncertain it is. Evidence, mean and
scale are those that a diagnosis scores the effect with; see `regression.evidence`.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.effect_columns import computable, effect_columns
from hilcal.identification.linearisation import Linearisation
from hilcal.types import Floats

SUPPORTED = 3.0
"""Log evidence from which the readings support an effect: odds of 20 : 1, e³."""


@dataclass(frozen=True, slots=True, eq=False)
class EffectEstimate:
    """Posterior of the P parameters of an effect that is not in the model.

    Attributes:
        mean: (P,) SI.
        root: (P, P) root of their scale matrix, SI.
        log_evidence: gain in log evidence by adding the effect.
    """

    mean: Floats
    root: Floats
    log_evidence: float

    @property
    def supported(self) -> bool:
        """Whether the readings support the effect."""
        return self.log_evidence > SUPPORTED

    def draws(self, count: int, rng: np.random.Generator) -> Floats:
        """Return (count, P) parameters: the mean, then draws from the posterior."""
        drawn = self.mean + rng.standard_normal((count, len(self.mean))) @ self.root.T
        drawn[0] = self.mean
        return np.asarray(drawn)


def estimate(linear: Linearisation, effect: Effect) -> EffectEstimate | None:
    """Estimate an effect beside the model.

    None where these readings lack a column that it needs, or cannot show any direction of it.

    Args:
        linear: of a fit in scaling gc, of a model without the effect.
        effect: built for any states.
    """
    if not computable(linear.fit, effect):
        return None
    columns = effect_columns(linear.fit, effect)
    found = linear.score(columns.white, most=effect.most())
    if not found.rank:
        return None
    scale = columns.scale
    return EffectEstimate(scale * found.step, scale[:, None] * found.root, found.log_evidence)
