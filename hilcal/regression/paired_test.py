"""Paired test of the errors on poses left out, before and after a change of the model."""

import numpy as np
from scipy.stats import norm, wilcoxon

from hilcal.types import Floats

LEAST_GAIN = 0.002
"""Share by which the rms error on poses left out must fall for an effect to stay ..."""
SURE = 2.0
"""... and by how many of its standard errors, from pose to pose; or as surely by its ranks."""
FEWEST = 8
"""Poses from which ranks are judged."""


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
    return float(wilcoxon(gain, alternative="greater").pvalue) < float(norm.sf(sure))
