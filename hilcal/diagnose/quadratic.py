"""Tail probability of a ratio of quadratic forms in normal variables.

    P( zᵀ L z / zᵀ z > c ),  z ~ N(0, I_R), L with eigenvalues λ_i (and zeros)

which is P(Σ (λ_i − c) χ²_1 > 0), by the saddlepoint approximation of Lugannani and Rice.
Sources: Kuonen, *Saddlepoint approximations for distributions of quadratic forms in normal
variables*, Biometrika 86 (1999) 929-935; Lugannani and Rice, Adv. Appl. Prob. 12 (1980).
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import log_ndtr
from scipy.stats import norm

from hilcal.types import Floats


def ratio_tail(eigenvalues: Floats, dimension: float, c: float) -> float:
    """Probability that a ratio of quadratic forms exceeds c.

    Args:
        eigenvalues: (K,) non-zero eigenvalues λ of the numerator.
        dimension: R, dimension of z; the other R − K eigenvalues are zero.
        c: the observed ratio.
    """
    top = float(eigenvalues.max(initial=0.0))
    if c <= 0 or top <= 0:
        return 1.0
    if c >= top:
        return 0.0
    d = np.append(eigenvalues - c, -c)
    weight = np.append(np.ones(len(eigenvalues)), dimension - len(eigenvalues))
    scale = np.abs(d).max()
    d = d / scale

    def slope(t: float) -> float:
        return float(np.sum(weight * d / (1 - 2 * t * d)))

    # The cumulant generating function lives on 1/(2 d_min) < t < 1/(2 d_max).
    low, high = 0.5 / d.min(), 0.5 / d.max()
    edge = 1e-9 * (high - low)
    t = float(brentq(slope, low + edge, high - edge, xtol=1e-14, maxiter=500))
    cumulant = -0.5 * float(np.sum(weight * np.log1p(-2 * t * d)))
    curvature = 2 * float(np.sum(weight * (d / (1 - 2 * t * d)) ** 2))
    w = np.sign(t) * np.sqrt(max(-2 * cumulant, 0.0))
    v = t * np.sqrt(curvature)
    if abs(w) < 1e-3:
        third = 8 * float(np.sum(weight * d**3))
        # log(v/w)/w tends to a sixth of the skewness.
        return float(norm.sf(w + third / (6 * curvature**1.5)))
    if w > 8:
        # Deep tail, in logarithms: sf(w) + φ(w) (1/v − 1/w)
        return float(np.exp(log_ndtr(-(w + np.log(v / w) / w))))
    return float(np.clip(norm.sf(w + np.log(v / w) / w), 0.0, 1.0))
