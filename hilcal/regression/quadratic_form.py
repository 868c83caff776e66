"""Tail probability of a ratio of quadratic forms in normal variables.

    P( zᵀ L z / zᵀ z > c ),  z ~ N(0, I_R), L with eigenvalues λ_i (and zeros)

which is P(Σ (λ_i − c) χ²_1 > 0), by the saddlepoint approximation of Lugannani and Rice.
Sources: Kuonen, *Saddlepoint approximations for distributions of quadratic forms in normal
variables*, Biometrika 86 (1999) 929-935; Lugannani and Rice, Adv. Appl. Prob. 12 (1980).
"""

import numpy as np
from scipy.special import log_ndtr
from scipy.stats import norm

from hilcal.types import Floats

NEAR_MEAN = 2e-3
"""Distance from the mean, in standard deviations, within which the formula loses digits."""


def ratio_tail(eigenvalues: Floats, dimension: float, c: float) -> float:
    """Probability that a ratio of quadratic forms exceeds c.

    Args:
        eigenvalues: (K,) non-zero eigenvalues λ of the numerator.
        dimension: R, dimension of z, at least K; the other R − K eigenvalues are zero.
    """
    top = float(eigenvalues.max(initial=0.0))
    if c <= 0 or top <= 0:
        return 1.0
    if c >= top:
        return 0.0
    d = np.append(eigenvalues - c, -c)
    weight = np.append(np.ones(len(eigenvalues)), max(dimension - len(eigenvalues), 0.0))
    d, weight = d[weight > 0], weight[weight > 0]
    if d.min() >= 0:
        return 1.0
    scale = np.abs(d).max()
    d = d / scale

    from scipy.optimize import brentq  # slow to import

    def slope(t: float) -> float:
        return float(np.sum(weight * d / (1 - 2 * t * d)))

    # The cumulant generating function lives on 1/(2 d_min) < t < 1/(2 d_max).
    low, high = 0.5 / d.min(), 0.5 / d.max()
    inside = 1 - 1e-9
    t = float(brentq(slope, low * inside, high * inside, xtol=1e-14, maxiter=500))
    cumulant = -0.5 * float(np.sum(weight * np.log1p(-2 * t * d)))
    curvature = 2 * float(np.sum(weight * (d / (1 - 2 * t * d)) ** 2))
    w = np.sign(t) * np.sqrt(max(-2 * cumulant, 0.0))
    v = t * np.sqrt(curvature)
    if abs(w) < NEAR_MEAN:
        # The formula is 0/0 at the mean: go straight from one side of it to the other.
        total = float(weight.sum())
        mean = float(eigenvalues.sum()) / total
        spread = np.sqrt(2 * float(np.sum(weight * (scale * d + c - mean) ** 2))) / total
        low, high = mean - 3 * NEAR_MEAN * spread, mean + 3 * NEAR_MEAN * spread
        p_low, p_high = (ratio_tail(eigenvalues, dimension, at) for at in (low, high))
        return float(p_low + (p_high - p_low) * (c - low) / (high - low))
    if w > 8:
        # Deep tail, in logarithms: sf(w) + φ(w) (1/v − 1/w)
        return float(np.exp(log_ndtr(-(w + np.log(v / w) / w))))
    return float(np.clip(norm.sf(w + np.log(v / w) / w), 0.0, 1.0))
