"""What could have been seen: the smallest strength of an effect that this campaign would reveal.

A family with the parameters t β in ordinary magnitudes adds the non-centrality t² βᵀ S β to its
F-test (see `score`). The strength stated is the t at which the test, at the level that naming an
effect asks for, finds it in nine campaigns of ten, for a typical direction β: the median over
random ones. At the tool it is the rms displacement that these parameters make at the measured
target, beyond what the fitted model can take up itself.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq
from scipy.stats import f as f_distribution
from scipy.stats import ncf

from hilcal.types import Floats

POWER = 0.9
DIRECTIONS = 64
_SEED = 20240611


@dataclass(frozen=True, slots=True)
class Strength:
    """The smallest strength of an effect that would have been revealed.

    Attributes:
        displacement_m: rms displacement of the target (of the deflection), m; infinite where
            these readings cannot show the effect.
        parameters: the same in the effect's own units: (unit, rms of its parameters), SI.
    """

    displacement_m: float
    parameters: tuple[tuple[str, float], ...]

    @property
    def visible(self) -> bool:
        """Whether any strength would be revealed."""
        return bool(np.isfinite(self.displacement_m))


def least_strength(
    s: Floats,
    motion: Floats,
    scale: Floats,
    units: tuple[str, ...],
    dof: float,
    variance: float,
    level: float,
) -> Strength:
    """Return the smallest strength of a family that would be revealed.

    Args:
        s: (P, P) information Xᵀ M X of the family in ordinary magnitudes, freed of the model.
        motion: (D, 3, P) displacement of each measured position by the parameters in ordinary
            magnitudes, m.
        scale: (P,) ordinary magnitudes, SI.
        units: (P,) physical units.
        dof: degrees of freedom of the fit.
        variance: its variance factor: how much larger than stated the scatter is, at least 1.
        level: of the test, between 0 and 1.
    """
    values = np.linalg.eigvalsh((s + s.T) / 2)
    rank = int(np.sum(values > max(1e-4, 1e-10 * float(values.max(initial=0.0)))))
    unseen = Strength(np.inf, tuple((u, np.inf) for u in dict.fromkeys(units)))
    if rank == 0 or dof - rank < 1:
        return unseen
    wanted = noncentrality(rank, dof - rank, level)
    beta = np.random.default_rng(_SEED).standard_normal((DIRECTIONS, len(s)))
    gain = np.einsum("kp,pq,kq->k", beta, s, beta)
    if float(np.median(gain)) <= 0.0:
        return unseen
    t = np.sqrt(wanted * variance / np.maximum(gain, 1e-300))
    typical = float(np.median(t))
    flat = motion.reshape(-1, motion.shape[2])
    gram = flat.T @ flat / len(motion)
    moved = t * np.sqrt(np.einsum("kp,pq,kq->k", beta, gram, beta))
    names = np.array(units)
    own = tuple(
        (unit, typical * float(np.sqrt(np.mean(scale[names == unit] ** 2))))
        for unit in dict.fromkeys(units)
    )
    return Strength(float(np.median(moved)), own)


def noncentrality(rank: int, rest: float, level: float) -> float:
    """Return the non-centrality at which the F-test at `level` has the power `POWER`."""
    limit = float(f_distribution.isf(level, rank, rest))
    high = 10.0 * (rank + 1.0) + 4.0 * rank * limit

    def lacks(value: float) -> float:
        return float(ncf.sf(limit, rank, rest, value)) - POWER

    while lacks(high) < 0.0:
        high *= 2.0
    return float(brentq(lacks, 0.0, high, xtol=1e-6 * high))
