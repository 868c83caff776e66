"""The score of a family of columns: what it would explain of a fit's whitened residual.

With r the whitened residual, B the whitened Jacobian of the fitted model and X (R, P) the
family's columns in ordinary magnitudes, everything follows from

    S = Xᵀ (I − B H⁻¹ Bᵀ) X,    g = Xᵀ r,    ‖r‖²

so that no refit is needed. The whole family is tested at once:

- p-value: F-test of all P columns; for a family that is large against the degrees of freedom,
  the variance-component test gᵀ g / ‖r‖² (Rao score of a common variance), whose null
  distribution is a ratio of quadratic forms. Both are exact for normal errors, also when the
  noise is misjudged by a common factor.
- evidence: logarithm of the marginal-likelihood ratio of the model with the family, its
  parameters N(0, τ²) in ordinary magnitudes, against that without it; τ by maximum, the noise
  factor integrated out. It prefers the smaller of two families that explain the same.
- shares, in-sample and on poses left out, of the misfit ‖r‖² − dof.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.regression.quadratic_form import ratio_tail
from hilcal.types import Floats

LARGE_FAMILY = 0.1
VISIBLE = 1e-2
"""Directions that move all data together by less than this many σ at ordinary magnitude are
left out of the tests."""
ROUNDING = 1e-12
STRENGTHS = np.logspace(-3, 3, 61)


@dataclass(frozen=True, slots=True, eq=False)
class Score:
    """What a family explains.

    Attributes:
        p_value: of the joint test.
        log_evidence: gain in log evidence by adding the family.
        strength: τ over the noise's spread where the evidence is largest.
        rank: number of visible directions of the family.
        effective: effective number of parameters at that strength.
        gain: reduction of ‖r‖² at that strength.
        delta_bic: change of the Bayesian information criterion; negative speaks for it.
        step: (P,) estimated parameters, in ordinary magnitudes.
    """

    p_value: float
    log_evidence: float
    strength: float
    rank: int
    effective: float
    gain: float
    delta_bic: float
    step: Floats


NOTHING = Score(1.0, 0.0, 0.0, 0, 0.0, 0.0, 0.0, np.zeros(0))


def score(s: Floats, g: Floats, yy: float, dof: float) -> Score:
    """Score a family from S (P, P), g (P,), ‖r‖² and the degrees of freedom."""
    values, vectors = np.linalg.eigh((s + s.T) / 2)
    visible = values > max(VISIBLE**2, 1e-10 * float(values.max(initial=0.0)))
    rank = int(visible.sum())
    if rank == 0 or yy <= 0 or dof <= 1:
        return NOTHING
    lam, u = values[visible], vectors[:, visible]
    c = u.T @ g
    explained = c**2 / lam
    if rank <= LARGE_FAMILY * dof:
        gain = min(float(explained.sum()), (1 - ROUNDING) * yy)
        rest = max((yy - gain) / (dof - rank), 1e-300)
        p_value = float(f_distribution.sf(gain / rank / rest, rank, dof - rank))
    else:
        p_value = ratio_tail(lam, dof, float(c @ c) / yy)
    # Evidence with the noise factor integrated out (a scale-invariant Student form).
    t2 = STRENGTHS[:, None] ** 2 * dof / yy
    shrunk = t2 * lam / (1 + t2 * lam)
    left = np.maximum(yy - (shrunk * explained).sum(axis=1), ROUNDING * yy)
    evidence = -0.5 * np.log1p(t2 * lam).sum(axis=1) - 0.5 * dof * np.log(left / yy)
    best = int(np.argmax(evidence))
    effective = float(shrunk[best].sum())
    gain = float((shrunk[best] * explained).sum())
    count = rank if rank <= LARGE_FAMILY * dof else effective
    full = float(explained.sum()) if rank <= LARGE_FAMILY * dof else gain
    delta_bic = dof * float(np.log(max(1 - full / yy, 1e-300))) + count * float(np.log(dof))
    return Score(
        p_value=p_value,
        log_evidence=float(evidence[best]),
        strength=float(STRENGTHS[best]),
        rank=rank,
        effective=effective,
        gain=gain,
        delta_bic=delta_bic,
        step=u @ (shrunk[best] * c / lam),
    )
