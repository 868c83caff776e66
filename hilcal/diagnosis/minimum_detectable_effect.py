"""Minimum detectable effect: the smallest strength of an effect that a campaign would reveal.

A family with the parameters t β in ordinary magnitudes adds the non-centrality t² βᵀ S β to its
F-test (see `regression.evidence`). The stated strength is the t at which the test, at the level of
naming an effect, has the power `POWER` for a direction β, and the stated displacement of the
measured target (rms) is that from which on nine of ten random directions have it: of equal
displacement some are hidden by the model.

The F-test alone is no measure, least of all for a family of many parameters: it rejects the null
hypothesis before any pose predicts another. So campaigns are simulated by algebra, at the
linearisation of the fit: random directions of one displacement, noise of the size found, and every
test that a suspect must pass, poses left out included. The stated size is the smallest on a grid at
which nine draws in ten pass. If the poses resolve only a part of the family, as of the waves of a
transmission error, the size for the family at its finest is stated as well.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from hilcal.identification.linearisation import (
    EffectColumns,
    Linearisation,
    by_pose,
    effect_columns,
)
from hilcal.regression.evidence import Spectrum, family_tests, noncentrality_of_power
from hilcal.regression.leave_out import FamilyFolds, LeftOutResidual, improves
from hilcal.types import Bools, Floats

POWER = 0.9
LEAST_SHARE = 0.01
"""An effect that explains less of the misfit on poses left out is not worth adding; a guess."""
DIRECTIONS = 64
DRAWS = 16  # campaigns at each size; a choice, for time
GRID = np.logspace(0.0, 1.5, 13)  # sizes, in units of the size that the F-test reveals; a choice
SEED, SEED_OF_FAMILY = 20240611, 20240612


@dataclass(frozen=True, slots=True)
class Strength:
    """The smallest strength of an effect that would have been revealed.

    `finest_m` is the least displacement that would reveal the effect if it were finer than the
    poses resolve (see `Effect.fine`): infinite if none would, None if the poses resolve the effect.
    """

    displacement_m: float  # rms displacement or deflection of the target, m; infinite for never
    parameters: tuple[tuple[str, float], ...]  # (unit, rms of the parameters), SI
    ordinary: float = np.inf  # rms of the parameters, in the effect's ordinary magnitudes
    finest_m: float | None = None

    @property
    def visible(self) -> bool:
        """Whether any strength would be revealed."""
        return bool(np.isfinite(self.displacement_m))

    def to_dict(self) -> dict[str, object] | None:
        """Return it as JSON, SI; None where no strength would be revealed."""
        if not self.visible:
            return None
        finer = None
        if self.finest_m is not None:
            visible = bool(np.isfinite(self.finest_m))
            finer = {"visible": visible, "displacement_m": self.finest_m if visible else None}
        return {
            "displacement_m": self.displacement_m,
            "parameters": [{"unit": unit, "rms": rms} for unit, rms in self.parameters],
            "finer_than_poses": finer,
        }


def least_strength(
    s: Floats,  # (P, P) information Xᵀ M X of the family in ordinary magnitudes
    motion: Floats,  # (D, 3, P) of each measured position by ordinary magnitudes, m
    scale: Floats,  # (P,) ordinary magnitudes, SI
    units: tuple[str, ...],  # (P,) physical units
    dof: float,  # degrees of freedom of the fit
    variance: float,  # variance factor of the fit, at least 1
    level: float,  # of the test, between 0 and 1
    rank: int,  # number of directions that can be tested
) -> Strength:
    """Return the smallest strength of a family that the F-test would reveal."""
    beta = np.random.default_rng(SEED).standard_normal((DIRECTIONS, len(s)))
    gain = np.sum(beta @ s * beta, axis=1)
    if rank == 0 or dof - rank < 1 or float(np.median(gain)) <= 0.0:
        return _never(units)
    noncentrality = noncentrality_of_power(rank, dof - rank, level, POWER)
    t = np.sqrt(noncentrality * variance / np.maximum(gain, 1e-300))
    flat = motion.reshape(-1, motion.shape[2])
    gram = flat.T @ flat / len(motion)
    motion_rms = np.sqrt(np.sum(beta @ gram * beta, axis=1))
    moved = float(np.quantile(t * motion_rms, POWER))
    return _strength(moved, moved / float(np.median(motion_rms)), scale, units)


def _never(units: tuple[str, ...]) -> Strength:
    return Strength(np.inf, tuple((u, np.inf) for u in dict.fromkeys(units)))


def _strength(moved: float, t: float, scale: Floats, units: tuple[str, ...]) -> Strength:
    """Return the strength of t ordinary magnitudes, which displace the target by `moved`."""
    names = np.array(units)
    rms = {u: float(np.sqrt(np.mean(scale[names == u] ** 2))) for u in dict.fromkeys(units)}
    return Strength(moved, tuple((u, t * size) for u, size in rms.items()), t)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedCampaigns:
    """Whitened residuals of K simulated campaigns, with the model fitted to each of them."""

    fitted: Floats  # (R, K) with the model fitted to all rows
    left_out: LeftOutResidual  # ... and without each fold; its y (R, K) are the simulated ones

    @classmethod
    def of(cls, p: Linearisation, y: Floats) -> Self:
        """Fit the model to residuals (R, K)."""
        return cls(p.project_out(y), p.folds.left_out(y))

    @classmethod
    def noise(cls, p: Linearisation) -> Self:
        """Return noise of the size found in a fit, of `DRAWS` campaigns."""
        shape = (len(p.residual), DRAWS)
        draws = np.random.default_rng(SEED).standard_normal(shape)
        return cls.of(p, np.sqrt(max(p.fit.variance_factor, 1.0)) * draws)

    def plus(self, other: "SimulatedCampaigns", factor: float) -> "SimulatedCampaigns":
        """Add `factor` times other residuals."""
        fitted = self.fitted + factor * other.fitted
        return SimulatedCampaigns(fitted, self.left_out.plus(other.left_out, factor))


def least_of_family(
    p: Linearisation,  # of the fit
    family: EffectColumns,  # as it is scored
    s: Spectrum,  # of the family's information
    start: Strength,  # that the F-test alone would reveal, where the grid begins
    level: float,  # of the test, between 0 and 1
    largest: float,  # largest plausible strength
    noise: Callable[[], SimulatedCampaigns],  # campaigns with the noise of the fit alone
) -> Strength:
    """Return the smallest strength that all tests would reveal."""
    if not start.visible:
        return start
    fine = family.effect.fine(p.fit.readings[~p.fit.outlier].states)
    tests = SuspectTests(p, family, s, level, largest)
    least = _least(tests, family, start.displacement_m, noise())
    if fine is None:
        return least
    finest = _least(tests, effect_columns(p.fit, fine), start.displacement_m, noise())
    return replace(least, finest_m=finest.displacement_m)


def _least(
    tests: "SuspectTests", full: EffectColumns, start: float, noise: SimulatedCampaigns
) -> Strength:
    """`least_of_family` where the arm has the effect `full` and the tests score their family."""
    rng = np.random.default_rng(SEED_OF_FAMILY)
    beta = rng.standard_normal((len(full.scale), DRAWS))
    motion = np.einsum("dip,pk->dik", full.motion, beta)
    moved = np.sqrt(np.mean(np.sum(motion**2, axis=1), axis=0))
    signal = SimulatedCampaigns.of(tests.p, full.white @ (beta / moved))  # of a displacement of 1 m
    units = tuple(q.unit for q in full.effect.parameters)
    for displacement in (GRID * start).tolist():
        if np.mean(tests.passed(noise.plus(signal, displacement), POWER)) >= POWER:
            typical = float(np.median(moved))
            return _strength(displacement, displacement / typical, full.scale, units)
    return _never(units)


@dataclass(frozen=True, eq=False)
class SuspectTests:
    """The tests that a suspect must pass, applied to simulated residuals; see `least_of_family`."""

    p: Linearisation
    family: EffectColumns
    s: Spectrum
    level: float
    largest: float

    @cached_property
    def _family_folds(self) -> FamilyFolds:
        """The model with the family, fitted without each fold."""
        return FamilyFolds(self.p.folds, self.family.white)

    def passed(self, campaigns: SimulatedCampaigns, enough: float = 0.0) -> Bools:
        """(K,) whether each of K simulated campaigns would reveal the family.

        Poses are not left out where fewer than `enough` pass the test of the fitted readings.
        """
        p, by_model = self.p, campaigns.left_out
        r = campaigns.fitted
        if self.s.rank == 0 or p.fit.dof <= 1:
            return np.zeros(r.shape[1], dtype=np.bool_)
        tests = family_tests(
            self.s, self.family.white.T @ r, np.sum(r * by_model.y, axis=0), p.fit.dof,
            largest=self.largest,
        )  # fmt: skip
        revealed = np.asarray((tests.p_value < self.level) & (tests.log_evidence > 0))
        if np.mean(revealed) < max(enough, POWER):
            return revealed
        ridge = float(np.median(tests.ridge))
        with_family = self._family_folds.left_out(by_model, ridge)
        for k in np.flatnonzero(revealed):
            a, b = by_pose(p.fit, by_model.residual[:, k]), by_pose(p.fit, with_family[:, k])
            share = float(a.sum() - b.sum()) / max(float(a.sum()) - p.fit.whitening.rank, 1.0)
            revealed[k] = share >= LEAST_SHARE and improves(a, b)
        return revealed
