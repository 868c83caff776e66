"""Paired test of the errors on poses left out, before and after a change of the model."""

import numpy as np

from hilcal.regression.distributions import norm
from hilcal.types import Floats

LEAST_GAIN = 0.002
"""Share by which the rms error on poses left out must fall for an effect to stay ..."""
SURE = 2.0
"""... and by how many of its standard errors, from pose to pose; or as surely by its ranks."""
FEWEST = 8
"""Poses from which ranks are judged."""
EXACT = 50
"""Values up to which the distribution of signed ranks is exact; a choice, that of SciPy."""


def improves(before: Floats, after: Floats, sure: float = SURE) -> bool:
    """Compare the squared whitened residuals of poses (P,), each predicted without itself.

    The gain must be certain from pose to pose: by its mean, or where few poses gain very much
    (then the mean scatters, however sure the gain is) by Wilcoxon's signed ranks, at the same
    level. Source: Wilcoxon, *Individual comparisons by ranking methods*, Biometrics Bulletin 1
    (1945) 80-83.

    Args:
        before: (P,) of the model as it was.
        after: (P,) of the changed one.
        sure: how many standard errors the gain must be.
    """
    if float(np.sum(after)) >= (1 - LEAST_GAIN) ** 2 * float(np.sum(before)):
        return False
    gain = before - after
    error = float(np.std(gain)) / np.sqrt(max(len(gain) - 1, 1))
    if float(np.mean(gain)) > sure * error:
        return True
    if np.count_nonzero(gain) < FEWEST:
        return False
    return signed_ranks(gain) < float(norm.sf(sure))


def signed_ranks(x: Floats) -> float:
    """P-value of Wilcoxon's signed-rank test that values (P,) are symmetric about zero, or lower.

    Zeros are left out; equal sizes share their mean rank. Up to `EXACT` values the distribution of
    the sum of the positive ranks is exact, given the ranks; of more, normal.
    """
    x = x[x != 0]
    _, place, ties = np.unique(np.abs(x), return_inverse=True, return_counts=True)
    twice = (2 * np.cumsum(ties) - ties + 1)[place]  # ranks may be halves
    total, seen = int(twice.sum()), int(twice[x > 0].sum())
    if len(x) > EXACT:
        return float(norm.sf((seen - total / 2) / (np.sqrt(np.sum(twice.astype(float) ** 2)) / 2)))
    chance = np.zeros(total + 1)
    chance[0] = 1.0
    for rank in twice:
        chance[rank:] = (chance[rank:] + chance[: total + 1 - rank]) / 2
        chance[:rank] /= 2
    return float(chance[seen:].sum())
