"""Least trimmed squares: the readings that agree best on one model.

    minimise Σ_{k ≤ h} d²_(k)(δ)

d²_(k) ascending squared distances of the readings from the linear model with δ, h a little more
than half of them, so that nearly half may be wrong, by any amount, and neither mask each other nor
make good ones look wrong. A fit to the h readings that are nearest to a model has a lower sum
(concentration); it is begun from many random subsets that just determine the model, and the lowest
sum of all is taken.

From the bulk of the distances follows the limit from which on a reading is a gross error (`limit`).

Source: Rousseeuw and Van Driessen, *Computing LTS regression for large data sets*, Data Mining and
Knowledge Discovery 12 (2006) 29-45.
"""

from typing import Protocol, Self, TypeVar

import numpy as np
from scipy.stats import chi2

from hilcal.identification.reading_model import ReadingModel
from hilcal.identification.solver import shortened
from hilcal.types import Bools, Floats, Ints

MOST = 0.45
"""Share of the readings that may be wrong. A choice: with few readings half of them agree on some
model by chance; least trimmed squares does not allow more than that."""
MISSED, STARTS = 1e-3, 300
"""Probability that no random subset is without a wrong reading where `MOST` of all are wrong, and
subsets at most; choices."""
FEW, BEST, LAST = 300, 20, 20
"""Readings that subsets are drawn from, the choice of the source; best subsets that are followed to
the end, and steps at most; choices."""
HALVINGS = 6
"""Shorter steps that are tried; a choice."""
ANEW = 6
"""Most linearisations; a choice: gross errors may have led the first one far off."""
FALSE_ALARMS = 1e-3
"""Expected number of good readings set aside per campaign under the right model; a choice."""
MISFIT_FACTOR = 6.25
"""Factor of the limit with a misfit, 2.5 in distance: its tails are heavier. A choice, no study set
it ..."""
MISFIT = (1.25, 1.5)
"""... reached gradually between these scales of the bulk, of noise alone and of a sure misfit."""


class Linearised(Protocol):
    """A model of readings at some parameters."""

    @property
    def linear(self) -> ReadingModel:
        """The linear model of the readings there."""

    def moved(self, delta: Floats) -> Self:
        """Return the model after a step δ (K,)."""


L = TypeVar("L", bound=Linearised)


def robust_start(at: L, rng: np.random.Generator) -> tuple[L, Bools]:
    """Return the linearisation that most readings agree on, and which readings do (N,)."""
    used, delta = _trimmed(at.linear, rng)
    for _ in range(ANEW):
        at = shortened(at.moved, delta, HALVINGS) or at
        _, now, delta = _concentrated(at.linear, used, LAST)
        if np.array_equal(now, used):
            break
        used = now
    return at, used


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


def _trusted(of: ReadingModel, n: int) -> int:
    """Return h, how many of n readings that are no centres."""
    wrong = int(MOST * np.count_nonzero(of.tested))
    return min(max(n - wrong, -(-n // 3), of.enough + 2), n)


def variance(of: ReadingModel, d2: Floats, centre: Bools) -> float:
    """Variance of good readings by the median of the h least squared distances (N,)."""
    others = np.sort(d2[of.tested & ~centre])
    half = (_trusted(of, len(others)) + 1) // 2
    return float(others[half - 1] / chi2.ppf(half / (len(others) + 1), of.m))


def nearest(of: ReadingModel, d2: Floats, centre: Bools) -> tuple[Bools, float]:
    """(N,) the h readings of least squared distance (N,), and centres; and the sum of these."""
    others = np.flatnonzero(of.tested & ~centre)
    h = _trusted(of, len(others))
    chosen = others[np.argpartition(d2[others], h - 1)[:h]] if h else others
    used = centre.copy()
    used[chosen] = True
    return used, float(d2[chosen].sum())


def _trimmed(of: ReadingModel, rng: np.random.Generator) -> tuple[Bools, Floats]:
    """Least trimmed squares: the readings (N,), and δ (K,) from them."""
    rows = _few(of, rng)
    part = of[rows] if len(rows) < len(of) else of
    size = (part.enough + 1) * (2 if len(part.members) else 1)
    starts = np.log(MISSED) / np.log1p(-((1.0 - MOST) ** size))
    tried = []
    for _ in range(int(min(np.ceil(starts), STARTS))):
        near = part.near(_from_few(part, rng))
        tried.append(nearest(part, *near))
    tried.sort(key=lambda each: each[1])
    best = [_concentrated(part, used, LAST) for used, _ in tried[:BEST]]
    _, used, delta = min(best, key=lambda each: each[0])
    if part is not of:
        _, used, delta = _concentrated(of, nearest(of, *of.near(delta))[0], LAST)
    return used, delta


def _concentrated(of: ReadingModel, used: Bools, steps: int) -> tuple[float, Bools, Floats]:
    """Sum, readings (N,), and δ (K,) that led to them."""
    total = np.inf
    for _ in range(steps):
        delta = of.fitted(used)[0]
        used, now = nearest(of, *of.near(delta))
        if now >= total * (1 - 1e-9):
            break
        total = now
    return now, used, delta


def _few(of: ReadingModel, rng: np.random.Generator) -> Ints:
    """Rows of at most about `FEW` readings, whole groups."""
    if not len(of.members):
        return np.sort(rng.permutation(len(of))[:FEW])
    groups = rng.permutation(len(of.members))[: max(FEW // of.members.shape[1], of.enough + 2)]
    rows = of.members[groups]
    return np.sort(rows[rows >= 0])


def _from_few(of: ReadingModel, rng: np.random.Generator) -> Floats:
    """δ (K,) from random readings that just determine it and one more; of groups two of each."""
    count = of.enough + 1
    if not len(of.members):
        rows = rng.permutation(len(of))[:count]
    else:
        groups = of.members[rng.permutation(len(of.members))[:count]]
        rows = np.concatenate([rng.permutation(g[g >= 0])[:2] for g in groups])
    few = of[rows]
    return few.fitted(np.ones(len(few), dtype=np.bool_))[0]
