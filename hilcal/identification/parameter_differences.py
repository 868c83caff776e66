"""Parameters of two campaigns of one arm side by side, in the same gauge.

Of the parameters that both models have, the likelihoods of the two campaigns have the means θ_A and
θ_B, and the information I_A and I_B, frames, tools and all other parameters marginalised out
(`Posterior`, without the effects' own priors). The information on d = θ_B − θ_A is the parallel sum

    P = I_A (I_A + I_B)⁻ I_B

which is singular along every direction that one of the campaigns did not determine: what a frame
absorbs, or a joint that one of them did not turn. There the two fits may stand anywhere. So each
parameter, and each effect as a whole, is compared with all others free within f = `FREE` of their
ordinary magnitudes: in these, S = ((P + 1/f²)⁻¹_mm)⁻¹ − 1/f² is the information on its difference.
What is known less well than to one magnitude is not compared: either the gauge moves it, or a
campaign tells nothing of it.

Source: Anderson and Duffin, *Series and parallel addition of matrices*, J. Math. Anal. Appl. 26
(1969) 576-594.
"""

from dataclasses import asdict, dataclass

import numpy as np
from scipy.stats import chi2

from hilcal.identification.posterior import Posterior
from hilcal.regression.normal_equations import INFORMATION
from hilcal.regression.schur import schur_complement
from hilcal.types import Floats, Ints

FREE = 10.0
"""How far other parameters may differ, in ordinary magnitudes, when one is compared: a change of
the arm may be of any of them. A choice."""
LEAST = INFORMATION**2 / 2
"""Information from which a direction is determined, in ordinary magnitudes; see `Posterior`."""
LISTED = 60
"""Parameters of an effect from which it is compared as a whole only; a choice."""


@dataclass(frozen=True, slots=True)
class ParameterDifference:
    """One parameter in both fits.

    Attributes:
        name: effect and parameter.
        unit: SI.
        before: of the earlier fit, SI.
        after: of the later fit, SI.
        difference: of the two, SI.
        std: its standard deviation, SI; None where frames absorb it or a campaign does not tell.
    """

    name: str
    unit: str
    before: float
    after: float
    difference: float
    std: float | None

    @property
    def z(self) -> float | None:
        """Difference over its standard deviation."""
        return None if self.std is None else self.difference / self.std


@dataclass(frozen=True, slots=True)
class EffectDifference:
    """All parameters of an effect in both fits.

    Attributes:
        effect: its name.
        chi2: dᵀ S d along the directions that can be compared.
        rank: degrees of freedom.
        p_value: of χ².
    """

    effect: str
    chi2: float
    rank: int
    p_value: float


@dataclass(frozen=True, slots=True)
class Differences:
    """Two fits of one arm.

    Attributes:
        rows: parameters of effects that have few, in the order of the earlier model.
        effects: each effect that both have.
        apart: effects of the arm that only one of them has, or with other parameters.
    """

    rows: tuple[ParameterDifference, ...]
    effects: tuple[EffectDifference, ...]
    apart: tuple[str, ...]

    def to_dict(self) -> dict[str, object]:
        """Return them as JSON, SI."""
        return {
            "rows": [{**asdict(r), "z": r.z} for r in self.rows],
            "effects": [asdict(e) for e in self.effects],
            "not_in_both": list(self.apart),
        }


def parameter_differences(earlier: Posterior, later: Posterior) -> Differences:
    """Compare the parameters that two fits have in common."""
    common = [n for n in earlier.names if n in set(later.names)]
    one, other = (
        np.array([p.names.index(n) for n in common], dtype=np.int64) for p in (earlier, later)
    )
    of = [n.split(".", 1)[0] for n in common]
    every = dict.fromkeys(n.split(".", 1)[0] for n in (*earlier.names, *later.names))
    apart = tuple(e for e in every if {len(earlier.index(e)), len(later.index(e))} != {of.count(e)})
    if not common:
        return Differences((), (), apart)
    scale = earlier.scale[one]
    first, before = _likelihood(earlier, one, scale)
    second, after = _likelihood(later, other, scale)
    parallel = _parallel_sum(first, second)
    covariance = np.asarray(np.linalg.inv(parallel + np.eye(len(common)) / FREE**2), dtype=float)
    known = 1.0 / np.diag(covariance) - 1.0 / FREE**2
    d, names = np.asarray(after - before, dtype=float), np.array(of)
    effects = [_effect(e, covariance, d, np.flatnonzero(names == e)) for e in dict.fromkeys(of)]
    rows = tuple(
        ParameterDifference(
            name=name,
            unit=earlier.units[one[k]],
            before=float(earlier.mean[one[k]]),
            after=float(later.mean[other[k]]),
            difference=float(scale[k] * d[k]),
            std=float(scale[k] / np.sqrt(known[k])) if known[k] > 1.0 else None,
        )
        for k, name in enumerate(common)
        if of.count(of[k]) < LISTED
    )
    return Differences(rows, tuple(effects), apart)


def _likelihood(p: Posterior, chosen: Ints, scale: Floats) -> tuple[Floats, Floats]:
    """Information (K, K) and mean (K,) by the readings alone, in ordinary magnitudes."""
    whole = p.information * (p.scale[:, None] * p.scale)
    own = p.own_precision * p.scale**2
    values, vectors = np.linalg.eigh(whole - np.diag(own))
    seen = values > LEAST
    data = (vectors[:, seen] * values[seen]) @ vectors[:, seen].T
    mean = (vectors[:, seen] / values[seen]) @ (vectors[:, seen].T @ (whole @ (p.mean / p.scale)))
    by = p.scale[chosen] / scale
    return schur_complement(data, chosen) / (by[:, None] * by), mean[chosen] * by


def _parallel_sum(a: Floats, b: Floats) -> Floats:
    """A (A + B)⁻ B (K, K) of two information matrices."""
    values, vectors = np.linalg.eigh(a + b)
    seen = values > LEAST
    half = vectors[:, seen] / np.sqrt(values[seen])
    p = (a @ half) @ (half.T @ b)
    return np.asarray((p + p.T) / 2)


def _effect(effect: str, covariance: Floats, d: Floats, mine: Ints) -> EffectDifference:
    """Test all parameters of an effect at once, the others not known.

    Args:
        effect: its name.
        covariance: (K, K) of all, as far as both campaigns and the prior tell.
        d: (K,) difference.
        mine: (I,) parameters of the effect.
    """
    some = np.linalg.inv(covariance[np.ix_(mine, mine)]) - np.eye(len(mine)) / FREE**2
    values, vectors = np.linalg.eigh((some + some.T) / 2)
    seen = values > 1.0
    total = float(np.sum(values[seen] * (vectors[:, seen].T @ d[mine]) ** 2))
    rank = int(seen.sum())
    return EffectDifference(effect, total, rank, float(chi2.sf(total, rank)) if rank else 1.0)
