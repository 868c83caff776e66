"""How strong suspects are: what the readings so far say of parameters that the model lacks.

With r the whitened residual of a fit, X the whitened columns of an effect, freed of what the
model can do itself, S = XᵀX and a prior N(0, τ²) of its parameters,

    β | r ~ N(C Xᵀr, C),   C = (S + τ⁻²)⁻¹,

and τ is where the evidence is largest: the parameters as adding the effect would estimate them,
to first order, and how far they could be off.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.effects.protocol import Effect
from hilcal.identify.fit import Fit
from hilcal.types import Floats

STRENGTHS = np.logspace(-3, 3, 61)
"""τ that are tried, in ordinary magnitudes."""
TELLING = 3.0
"""Evidence from which readings speak for an effect: 20 to 1, e³."""


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What is known of the P parameters of an effect that is not in the model.

    Attributes:
        mean: (P,) SI.
        root: (P, P) root of their covariance, SI.
        log_evidence: how far the readings speak for it.
    """

    mean: Floats
    root: Floats
    log_evidence: float

    @property
    def told(self) -> bool:
        """Whether the readings speak for the effect."""
        return self.log_evidence > TELLING

    def draws(self, count: int, rng: np.random.Generator) -> Floats:
        """Return (count, P) parameters: the mean, then such as could be as well."""
        drawn = self.mean + rng.standard_normal((count, len(self.mean))) @ self.root.T
        drawn[0] = self.mean
        return np.asarray(drawn)


def estimate(fit: Fit, effect: Effect) -> Estimate | None:
    """Estimate an effect beside the model; None where these readings lack what it needs.

    Args:
        fit: in scaling gc, of a model without the effect.
        effect: built for any states.
    """
    solution, w = fit.solution, fit.whitening
    if not type(effect).computable(solution.prediction.situation.states):
        return None
    scale = np.array([p.scale for p in effect.parameters])
    jacobian = fit.model.jacobian_of((effect,), solution.prediction, fit.theta, w.m)
    x = w.whiten(w.raw(jacobian * scale)).reshape(-1, len(scale))
    free = x
    if solution.rows.shape[1]:
        factor = solution.equations.factor(solution.beta)
        free = x - solution.rows @ sl.cho_solve(factor, solution.rows.T @ x)
    s = x.T @ free
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    values, c = np.maximum(values, 0.0), vectors.T @ (x.T @ solution.rest())
    tau2 = STRENGTHS[:, None] ** 2
    evidence = 0.5 * np.sum(tau2 * c**2 / (1 + tau2 * values) - np.log1p(tau2 * values), axis=1)
    best = int(np.argmax(evidence))
    variance = tau2[best] / (1 + tau2[best] * values)
    return Estimate(
        scale * (vectors @ (variance * c)),
        scale[:, None] * vectors * np.sqrt(variance),
        float(evidence[best]),
    )
