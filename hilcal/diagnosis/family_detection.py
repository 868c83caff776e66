"""Minimum detectable size of a large family, as it may really be.

The F-test alone says little of a family of many parameters: it rejects its absence where no pose
predicts another yet, and a family that the poses limit, as a transmission error with more waves
than they resolve, is scored by a part of its parameters. So whole campaigns are simulated by
algebra, at the linearisation of the fit: parameters β ~ N(0, t² 1) of the family, noise of the size
found, and every test that a suspect must pass, poses left out included. The size stated is the
smallest of a grid at which nine draws in ten pass; that of the family at its finest is stated
beside it.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np

from hilcal.diagnosis.minimum_detectable_effect import POWER, Strength
from hilcal.identification.effect_columns import EffectColumns, effect_columns
from hilcal.identification.linearisation import Linearisation, by_pose
from hilcal.regression.evidence import LARGE_FAMILY, FamilyScore, score_family
from hilcal.regression.leave_out import FamilyFolds
from hilcal.regression.paired_test import improves
from hilcal.regression.spectrum import Spectrum
from hilcal.types import Floats

DRAWS = 16
"""Campaigns at each size; a choice, for time."""
GRID = np.logspace(0.0, 1.5, 7)
"""Sizes, in units of that which the F-test would reveal; a choice."""
_SEED = 20240612


def large(s: Spectrum, dof: float) -> bool:
    """Whether a family is large against the degrees of freedom, which hides what it predicts."""
    return s.rank > LARGE_FAMILY * dof


def least_of_family(
    p: Linearisation,
    of: EffectColumns,
    s: Spectrum,
    start: Strength,
    level: float,
    least_share: float,
    largest: float,
) -> Strength:
    """Return the smallest strength of a large family that all tests would reveal.

    Args:
        p: linearisation of the fit.
        of: the family, as it is scored.
        s: spectrum of its information.
        start: what the F-test alone would reveal.
        level: of the test, between 0 and 1.
        least_share: share of the misfit on poses left out that must be explained.
        largest: largest plausible strength.
    """
    if not start.visible:
        return start
    fine = of.effect.fine(p.fit.readings[~p.fit.outlier].states)
    tests = SuspectTests(p, of, s, level, least_share, largest)
    least = _least(tests, of, start)
    if fine is None:
        return least
    finest = _least(tests, effect_columns(p.fit, fine), start)
    return replace(least, finest_m=finest.displacement_m)


def _least(tests: "SuspectTests", full: EffectColumns, start: Strength) -> Strength:
    """`least_of_family` where the parameters of `full` are there and those of a family scored."""
    p = tests.p
    rng = np.random.default_rng(_SEED)
    beta = rng.standard_normal((len(full.scale), DRAWS))
    signal = full.white @ beta
    noise = max(p.fit.variance_factor, 1.0)
    error = np.sqrt(noise) * rng.standard_normal(signal.shape)
    moved = np.sqrt(np.mean(np.sum(np.einsum("dip,pk->dik", full.motion, beta) ** 2, axis=1)))
    for displacement in GRID * start.displacement_m:
        t = float(displacement / moved)
        if np.mean(tests.found(t * signal + error, POWER)) >= POWER:
            own = tuple(
                (unit, t * float(np.sqrt(np.mean(full.scale[_of_unit(full, unit)] ** 2))))
                for unit, _ in start.parameters
            )
            return Strength(float(displacement), own, t)
    return Strength(np.inf, tuple((u, np.inf) for u, _ in start.parameters))


def _of_unit(of: EffectColumns, unit: str) -> list[int]:
    return [k for k, q in enumerate(of.effect.parameters) if q.unit == unit]


class SuspectTests:
    """The tests that a suspect must pass, of simulated residuals."""

    def __init__(
        self,
        p: Linearisation,
        of: EffectColumns,
        s: Spectrum,
        level: float,
        least_share: float,
        largest: float,
    ) -> None:
        """Take what `least_of_family` takes."""
        self.p, self._x, self._s = p, of.white, s
        self._level, self._least_share, self._largest = level, least_share, largest

    @cached_property
    def _folds(self) -> tuple[FamilyFolds, FamilyFolds]:
        """The model without each fold, without the family and with it."""
        p = self.p
        return FamilyFolds(p.folds, p.projection), FamilyFolds(p.folds, p.projection, self._x)

    def found(self, y: Floats, enough: float = 0.0) -> list[bool]:
        """Whether each of K simulated residuals y (R, K) would reveal the family.

        Once a share of `enough` is out of reach, the remaining ones are not looked at and count as
        not revealing it.
        """
        p = self.p
        r = p.project_out(y)
        g, rss = self._x.T @ r, np.sum(r * y, axis=0)
        scores: list[FamilyScore] = []
        able = [False] * y.shape[1]
        for k in range(len(able)):
            c = score_family(self._s, g[:, k], float(rss[k]), p.fit.dof, most=self._largest)
            scores.append(c)
            able[k] = c.p_value < self._level and c.log_evidence > 0
            failed = len(scores) - sum(able)
            if 1.0 - failed / len(able) < enough:
                return able
        if np.mean(able) < POWER:
            return able
        ridge = float(np.median([c.ridge for c in scores]))
        before, after = (of.left_out(y, ridge) for of in self._folds)
        rank = p.fit.whitening.rank
        out = []
        for k, fit_able in enumerate(able):
            a, b = by_pose(p.fit, before[:, k]), by_pose(p.fit, after[:, k])
            share = float(a.sum() - b.sum()) / max(float(a.sum()) - rank, 1.0)
            out.append(fit_able and share >= self._least_share and improves(a, b))
        return out
