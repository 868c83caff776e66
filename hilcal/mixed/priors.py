"""What arms are like before anything is measured: log standard deviations, normal and correlated.

    log s_f = mean_f + a + b_effect(f) + c_f
    a ~ N(0, ARM²),  b ~ N(0, EFFECT²),  c_f ~ N(0, spread_f²)

An arm is precise or not in most of its parts (a), and the families of one effect, as the octaves of
a gear's error, are large or small together (b). With few poses this keeps one octave from taking
what others explain; independent priors of the same spread predicted 4 % worse with 20 poses of the
real UR10 and of a real UR5. Components of the noise have their own spread alone.
"""

from collections.abc import Sequence

import numpy as np

from hilcal.mixed.families import Family, LogStdPrior
from hilcal.types import Floats

ARM = 1.5
"""Of an arm as a whole: a factor of 4.5 either way, so that one whose errors are a tenth or ten
times the ordinary ones is no surprise; a choice."""
EFFECT = 1.0
"""Of an effect beside its arm: a factor of 2.7; a choice."""


def log_std_prior(
    priors: Sequence[LogStdPrior], families: Sequence[Family]
) -> tuple[Floats, Floats]:
    """Mean (F + N,) and precision (F + N, F + N) of log s and η.

    Args:
        priors: of each of them by itself.
        families: the first F of them.
    """
    covariance = np.diag([p.spread**2 for p in priors])
    effect = np.array([f.effect for f in families])
    unknown = np.array([not f.known for f in families], dtype=float)
    shared = (ARM**2 + EFFECT**2 * (effect[:, None] == effect)) * np.outer(unknown, unknown)
    covariance[: len(effect), : len(effect)] += shared
    return np.array([p.mean for p in priors]), np.linalg.inv(covariance)
