"""How large the effects of a type of arm are, beside those of other arms.

With x_i the log standard deviations of the families of campaign i (`hilcal.mixed.families`),

    x_i = mean + B b + d_i,    d_i ~ N(0, Λ⁻¹),    b ~ N(0, ARM² + EFFECT² 1)

mean and Λ are those that hold for any arm, B tells the effect of each family, and b is what the
arms of the type have in common. The restricted likelihood of a campaign is taken as quadratic about
its estimate, with information I and, there, slope Λ (x_i − mean). Without d_i it says

    J = I − I (I + Λ)⁻¹ I,    j = h − I (I + Λ)⁻¹ h,    h = I x_i + Λ (x_i − mean)

    b = (Σ_i Bᵀ J B + (ARM² + EFFECT² 1)⁻¹)⁻¹ Σ_i Bᵀ (j − J mean)

The factors exp b belong into the section [ordinary] of the cell of another arm of the type.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hilcal.errors import CannotAnswerError
from hilcal.identification.background import MOST_ROWS
from hilcal.identification.fit import Fit
from hilcal.identification.mixed_fit import mixed_fit
from hilcal.mixed.families import ARM, EFFECT
from hilcal.mixed.variances import Variances
from hilcal.model.model import Model
from hilcal.types import Floats

WIDTH = 1.96
"""Standard deviations of b that a 95 % interval reaches on either side."""


@dataclass(frozen=True, slots=True, eq=False)
class SizeEvidence:
    """What a campaign tells of the sizes of E effects."""

    effects: tuple[str, ...]  # their names
    information: Floats  # (E, E) Bᵀ J B
    vector: Floats  # (E,) Bᵀ (j − J mean)


@dataclass(frozen=True, slots=True)
class TypeSize:
    """The size of an effect on arms of a type, divided by that on other arms."""

    effect: str  # its name
    factor: float  # the size
    low: float  # lower end of its 95 % interval
    high: float  # upper end

    @property
    def differs(self) -> bool:
        """Whether its 95 % interval excludes 1, the size on other arms."""
        return self.low > 1.0 or self.high < 1.0


def size_evidence(start: Model, found: Fit) -> SizeEvidence | None:
    """Return what the readings of a fit tell; None where they do not determine its frames."""
    kept = found.readings[~found.outlier].as_stated()
    poses = np.unique(kept.pose)
    most = max(2, int(len(poses) * MOST_ROWS / (len(kept) * kept.m)))
    some = poses[np.unique(np.linspace(0, len(poses) - 1, most).astype(np.int64))]
    try:
        variances = mixed_fit(start, kept[np.isin(kept.pose, some)], found.mode).variances
    except CannotAnswerError:
        return None
    config = start.cell.config
    return evidence_of(variances, {} if config is None else config.ordinary)


def evidence_of(of: Variances, ordinary: dict[str, float]) -> SizeEvidence:
    """Return what estimated variances tell."""
    problem, x = of.equations.problem, of.log_std
    mean, precision = problem.log_std_prior
    families = [f for f in problem.families.random if not f.known]
    effects = tuple(dict.fromkeys(f.effect for f in families))
    b = np.zeros((len(x), len(effects)))
    for k, f in enumerate(problem.families.random):
        if not f.known:
            b[k, effects.index(f.effect)] = 1.0
    slope = precision @ (x - mean)
    # What logarithms add to the curvature of a falling likelihood; see `mixed.variances`.
    information = of.equations.information + np.diag(np.maximum(-2.0 * slope, 0.0))
    shipped = mean - b @ np.log([ordinary.get(e, 1.0) for e in effects])
    gain = information @ np.linalg.inv(information + precision)
    j = information - gain @ information
    h = information @ x + slope
    return SizeEvidence(effects, b.T @ j @ b, b.T @ (h - gain @ h - j @ shipped))


def type_sizes(of: Sequence[SizeEvidence]) -> tuple[TypeSize, ...]:
    """Return the sizes that the campaigns of a type tell together, by the effects' names."""
    effects = sorted({e for x in of for e in x.effects})
    if not effects:
        return ()
    count = len(effects)
    precision = np.linalg.inv(np.full((count, count), ARM**2) + EFFECT**2 * np.eye(count))
    vector = np.zeros(count)
    for x in of:
        at = np.array([effects.index(e) for e in x.effects])
        precision[np.ix_(at, at)] += x.information
        vector[at] += x.vector
    covariance = np.linalg.inv(precision)
    b, std = covariance @ vector, np.sqrt(np.diag(covariance))
    ends = np.exp(b[:, None] + WIDTH * std[:, None] * np.array([0.0, -1.0, 1.0]))
    return tuple(TypeSize(e, *map(float, row)) for e, row in zip(effects, ends, strict=True))
