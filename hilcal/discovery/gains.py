"""Gains of candidates beside others, and the short list of the best of all sites."""

import numpy as np

from hilcal.discovery.terms import ScreenedTerm
from hilcal.regression.projection import Projection
from hilcal.types import Bools, Floats, Ints

SHORT_LIST = 200
"""Candidates that are scored in full at each step; a choice."""
OF_SITE = 60
"""Of each site at most; a choice."""
SPANNED = 1e-9
"""Directions of chosen columns below this share of the largest are rounding."""


def orthonormal(model: Projection, x: Floats) -> Floats:
    """(R, K) M X T of columns X (R, P) with Tᵀ Xᵀ M X T = 1, without what X does not span."""
    free = model.project_out(x)
    gram = x.T @ free
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    kept = values > SPANNED * values[-1]
    return np.asarray(free @ (vectors[:, kept] / np.sqrt(values[kept])))


def together(
    square: Floats, slope: Floats, across: Floats, seen: Bools, which: Ints, other: Ints
) -> Floats:
    """(H,) gain of candidates at a site with another column each; zero where they are alike.

    Args:
        square: (F,) xᵀ M x, not zero.
        slope: (F,) xᵀ r.
        across: (F,) xᵀ M x' with the other.
        seen: (F,) whether the model leaves something of a candidate.
        which: (H,) of the candidates.
        other: (F,) the other of each.
    """
    a, b, h = square[which], square[other[which]], across[which]
    g, k = slope[which], slope[other[which]]
    det = a * b - h * h
    ok = seen[which] & seen[other[which]] & (det > 1e-3 * a * b)
    both = (b * g * g - 2 * h * g * k + a * k * k) / np.where(ok, det, 1.0)
    return np.where(ok, both, 0.0)


def keep_largest(
    found: list[ScreenedTerm], odds: Floats, s: int, which: Ints | None = None
) -> None:
    """Add the best candidates of a site to those of others, best first."""
    least = found[-1].odds if len(found) == SHORT_LIST else -np.inf
    top = np.flatnonzero(odds > least)
    if len(top) > OF_SITE:
        top = top[np.argpartition(-odds[top], OF_SITE - 1)[:OF_SITE]]
    found += [
        ScreenedTerm(s, int(f if which is None else which[f]), float(x))
        for f, x in zip(top.tolist(), odds[top].tolist(), strict=True)
    ]
    found.sort(key=lambda x: -x.odds)
    del found[SHORT_LIST:]
