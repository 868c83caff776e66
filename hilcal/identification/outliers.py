"""Limit of the squared Mahalanobis distance from which on a reading is a gross error."""

import numpy as np
from scipy.stats import chi2

from hilcal.types import Floats

FALSE_ALARMS = 1e-3
"""Expected number of good readings set aside per campaign under the right model; a choice."""
MISFIT_FACTOR = 6.25
"""Factor of the limit with a misfit, 2.5 in distance: its tails are heavier. A choice, no study set
it ..."""
MISFIT = (1.25, 1.5)
"""... reached gradually between these scales of the bulk, of noise alone and of a sure misfit."""


def bulk(distance2: Floats, m: int) -> float:
    """Scale of most squared distances: their median over that of χ²_m."""
    return float(np.median(distance2) / chi2.median(m))


def limit(m: int, count: int, scale: float = 1.0) -> float:
    """Squared distance from which on one of `count` measurements is a gross error.

    It is the χ²_m quantile that a good reading exceeds in one of a thousand campaigns, times the
    scale of the bulk where that is wider than the stated noise.
    """
    far = float(chi2.isf(FALSE_ALARMS / count, m)) * max(1.0, scale)
    chance, sure = MISFIT
    return far * float(MISFIT_FACTOR ** np.clip((scale - chance) / (sure - chance), 0.0, 1.0))
