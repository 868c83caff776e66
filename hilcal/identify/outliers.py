"""Gross errors: readings that no noise and no smooth misfit explains."""

import numpy as np
from scipy.stats import chi2

from hilcal.types import Bools, Floats

FALSE_ALARMS = 1e-3
"""Expected number of good readings set aside in a whole campaign, when the model is right."""
MISFIT_FACTOR = 6.25
"""While the model is wrong, the limit is 2.5 times as far: a misfit has heavier tails."""
MISFIT = 1.3


def find_outliers(distance2: Floats, m: int) -> Bools:
    """Which measurements (D,) are gross errors, by their squared Mahalanobis distances.

    The limit is the χ²_m quantile that all good readings together exceed once in a thousand
    campaigns, times the scale of the bulk (median of the distances over that of χ²_m) where
    the bulk is wider than the stated noise.
    """
    scale = float(np.median(distance2) / chi2.median(m))
    limit = float(chi2.isf(FALSE_ALARMS / len(distance2), m)) * max(1.0, scale)
    if scale > MISFIT:
        limit *= MISFIT_FACTOR
    return np.asarray(distance2 > limit)
