"""Gross errors: readings that no noise and no smooth misfit explains."""

import numpy as np
from scipy.stats import chi2

from hilcal.types import Floats

FALSE_ALARMS = 1e-3
"""Expected number of good readings set aside in a whole campaign, when the model is right."""
MISFIT_FACTOR = 6.25
"""While the model is wrong, the limit is 2.5 times as far: a misfit has heavier tails ..."""
MISFIT = (1.25, 1.5)
"""... gradually so from the scale that chance allows to one that it does not."""


def bulk(distance2: Floats, m: int) -> float:
    """Scale of most squared distances: their median over that of χ²_m."""
    return float(np.median(distance2) / chi2.median(m))


def limit(m: int, count: int, scale: float = 1.0) -> float:
    """Squared distance from which on one of `count` measurements is a gross error.

    It is the χ²_m quantile that all good readings together exceed once in a thousand
    campaigns, times the scale of the bulk where that is wider than the stated noise.
    """
    far = float(chi2.isf(FALSE_ALARMS / count, m)) * max(1.0, scale)
    chance, sure = MISFIT
    return far * float(MISFIT_FACTOR ** np.clip((scale - chance) / (sure - chance), 0.0, 1.0))
