"""How well the arm comes back: the scatter of unloaded readings of one pose over its cycles."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class UnloadedVisit:
    """One unloaded reading."""

    pose: str
    position: Floats  # (3,) m, sensor axes
    tracker: Floats  # (3, 3) covariance of the instrument alone, m²
    gain: float  # tr(J Jᵀ) of the target's translation, m²/rad²


@dataclass(frozen=True, slots=True)
class RepeatabilityEstimate:
    """The scatter from one arrival to the next."""

    poses: int  # poses with several readings
    dof: int  # readings less poses
    scatter: float  # rms distance of a reading from its pose's mean, m, unbiased
    instrument: float  # the same as the instrument alone would make it, m
    joint_std: float  # the scatter of every joint that explains the rest, rad; 0 where none is left
    iso_9283: float = float("nan")
    """The worst pose's RP = mean distance + 3 standard deviations of it, m (ISO 9283, 7.2.2), the
    instrument's noise included; NaN in campaigns of older versions."""

    @property
    def shown(self) -> bool:
        """Whether the arm scatters beyond what the instrument does by chance, about 1 in 100."""
        total, noise = self.scatter**2, self.instrument**2
        return bool(total - noise > 3.0 * noise * np.sqrt(2.0 / (3.0 * max(self.dof, 1))))

    def words(self, configured: Floats) -> str:
        """Return it for people, beside the configured standard deviations (n,), rad."""
        told = float(np.sqrt(np.mean(configured**2)))
        joints = f"is about {self.joint_std:.1g}" if self.shown else "does not show beside it"
        return (
            f"{self.dof} returns to {self.poses} poses scatter by {1e6 * self.scatter:.0f} µm, "
            f"the instrument alone by {1e6 * self.instrument:.0f} µm: joint_std_rad {joints}, "
            f"configured {told:.1g}"
        )


def repeatability(visits: Sequence[UnloadedVisit]) -> RepeatabilityEstimate | None:
    """Estimate it from unloaded readings; None where no pose has two.

    With S = Σ |x − x̄|² over the readings of a pose that was visited k times,

        E S = (1 − 1/k) Σ (tr C + σ² tr(J Jᵀ))

    which is solved for σ², one for all joints, over all poses together.
    """
    spread = instrument = gain = worst = 0.0
    poses = dof = 0
    for name in dict.fromkeys(v.pose for v in visits):
        mine = [v for v in visits if v.pose == name]
        k = len(mine)
        if k < 2:
            continue
        at = np.array([v.position for v in mine])
        away = np.linalg.norm(at - at.mean(axis=0), axis=1)
        spread += float(np.sum(away**2))
        instrument += (1 - 1 / k) * sum(float(np.trace(v.tracker)) for v in mine)
        gain += (1 - 1 / k) * sum(v.gain for v in mine)
        worst = max(worst, float(away.mean() + 3 * away.std(ddof=1)))
        poses, dof = poses + 1, dof + k - 1
    if not poses:
        return None
    left = max(spread - instrument, 0.0)
    return RepeatabilityEstimate(
        poses=poses,
        dof=dof,
        scatter=float(np.sqrt(spread / dof)),
        instrument=float(np.sqrt(instrument / dof)),
        joint_std=float(np.sqrt(left / gain)) if gain > 0 else 0.0,
        iso_9283=worst,
    )
