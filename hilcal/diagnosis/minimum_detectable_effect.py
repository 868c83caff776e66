"""Minimum detectable effect: the smallest strength of an effect that a campaign would reveal.

A family with the parameters t β in ordinary magnitudes adds the non-centrality t² βᵀ S β to its
F-test (see `regression.power`). The strength stated is the t at which the test, at the level of
naming an effect, has the power `POWER` for a typical direction β: the median over random ones. At
the tool it is the rms displacement that these parameters make at the measured target, beyond what
the fitted model can explain.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.regression.power import noncentrality_of_power
from hilcal.regression.spectrum import visible
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
        ordinary: the same in the effect's ordinary magnitudes.
        finest_m: displacement from which the effect would have been revealed were it finer than the
            poses resolve (see `Effect.fine`), infinite where never; None where no such limit is.
    """

    displacement_m: float
    parameters: tuple[tuple[str, float], ...]
    ordinary: float = np.inf
    finest_m: float | None = None

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
    rank: int | None = None,
) -> Strength:
    """Return the smallest strength of a family that would be revealed.

    Args:
        s: (P, P) information Xᵀ M X of the family in ordinary magnitudes, beside the model.
        motion: (D, 3, P) displacement of each measured position by the parameters in ordinary
            magnitudes, m.
        scale: (P,) ordinary magnitudes, SI.
        units: (P,) physical units.
        dof: degrees of freedom of the fit.
        variance: its variance factor: how much larger than stated the scatter is, at least 1.
        level: of the test, between 0 and 1.
        rank: number of directions that can be tested, where it is known.
    """
    if rank is None:
        values = np.asarray(np.linalg.eigvalsh((s + s.T) / 2), dtype=float)
        rank = int(visible(values).sum())
    unseen = Strength(np.inf, tuple((u, np.inf) for u in dict.fromkeys(units)))
    if rank == 0 or dof - rank < 1:
        return unseen
    wanted = noncentrality_of_power(rank, dof - rank, level, POWER)
    beta = np.random.default_rng(_SEED).standard_normal((DIRECTIONS, len(s)))
    gain = np.sum(beta @ s * beta, axis=1)
    if float(np.median(gain)) <= 0.0:
        return unseen
    t = np.sqrt(wanted * variance / np.maximum(gain, 1e-300))
    typical = float(np.median(t))
    flat = motion.reshape(-1, motion.shape[2])
    gram = flat.T @ flat / len(motion)
    moved = t * np.sqrt(np.sum(beta @ gram * beta, axis=1))
    names = np.array(units)
    own = tuple(
        (unit, typical * float(np.sqrt(np.mean(scale[names == unit] ** 2))))
        for unit in dict.fromkeys(units)
    )
    return Strength(float(np.median(moved)), own, typical)
