"""Which effects of a model's background the readings prove, each beside all others.

The test of an effect is the restricted likelihood ratio of the null hypothesis that its standard
deviation is zero; the standard deviations of all others are estimated anew (`mixed.variances`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE, Suspect
from hilcal.diagnosis.minimum_detectable_effect import Strength
from hilcal.identification.fit import Fit, all_left_out
from hilcal.identification.linearisation import HeldOut
from hilcal.identification.mixed_fit import (
    MOST_NOISE_ROWS,
    linearised_problem,
    mixed_fit_at,
    sizes_at,
    with_all_effects,
)
from hilcal.identification.noise.arm_scatter import some_poses
from hilcal.mixed.variances import evidence
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats

FALSE_ALARM = 0.01
"""Chance of naming any absent effect of the background, over all tested effects; a choice: poses
left out have shown already that something is missing."""
LEAST_GAIN = 0.2
"""√n times the share by which the rms error on n poses left out must fall for a background; a
choice. On an arm without other effects that share scatters by 0.025 (15 poses), 0.006 (40)."""
JOINT_LEVEL = 0.05
"""Chance of trying a background where the residual is only noise of another size, or the arm's
scatter; a choice: the error on poses left out has to fall, too."""
POSSIBLE_LEVEL = 0.1
"""p-value below which an effect of the background is named as possibly present; a choice."""
SEED = 0  # of the simulated ratios, so that equal fits give equal p-values


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundEffect:
    """One effect of the background."""

    effect: str
    p_value: float  # of the null hypothesis that the effect is absent
    ratio: float  # the restricted likelihood ratio
    rank: int  # number of its directions that the others do not span
    std: float  # rms of its standard deviations, in ordinary magnitudes
    rms_m: float  # rms displacement of the measured positions by the effect, m
    share: float  # of what the background explains, in whitened squares
    step: Floats  # (q,) its parameters, in ordinary magnitudes


def p_value_of_others(fit: Fit) -> float:
    """Joint p-value of all effects that the model does not name, beside noise of any size.

    They are tested at the fit, by one common multiple of their ordinary sizes, with more than
    `MOST_NOISE_ROWS` elements by poses chosen at random.
    """
    readings = fit.readings[~fit.outlier].as_stated()
    readings = readings[some_poses(readings, MOST_NOISE_ROWS / readings.value.size, SEED)]
    model, theta = all_effects_at(fit, readings)
    problem = linearised_problem(model, readings, fit.mode, theta)
    random = problem.families.random
    unnamed = [k for k, f in enumerate(random) if f.effect not in fit.model.named]
    start = sizes_at(problem, model, theta)
    return evidence(problem, unnamed, np.random.default_rng(SEED), start).p_value


def all_effects_at(fit: Fit, readings: Readings) -> tuple[Model, Floats]:
    """Return the model with all effects that the readings allow, and its parameters at the fit."""
    model = with_all_effects(fit.model, readings.states)
    fitted = {
        (e.name, p.name): value
        for e, columns in zip(fit.model.effects, fit.model.slices(), strict=True)
        for p, value in zip(e.parameters, fit.theta[columns], strict=True)
    }
    theta = [fitted.get((e.name, p.name), 0.0) for e in model.effects for p in e.parameters]
    return model, np.array(theta)


def left_out_squares(first: Fit, second: Fit) -> tuple[Floats, Floats]:
    """Squared errors (poses,) of two fits on poses left out, whitened by the noise of the second.

    Gross errors of both do not count.
    """
    raw, w = all_left_out(second)
    other, scaling = all_left_out(first)
    place = np.empty(len(first.readings), dtype=np.int64)
    place[scaling.reading] = np.arange(len(other))
    counts = ~(second.outlier & first.outlier)[w.reading, None]
    pose = np.unique(second.readings.pose[w.reading], return_inverse=True)[1].reshape(-1)

    def of_poses(error: Floats) -> Floats:
        white = w.whiten(counts * error).reshape(len(w), -1)
        return np.asarray(np.bincount(pose, weights=np.sum(white**2, axis=1)), dtype=float)

    return of_poses(other[place[w.reading]]), of_poses(raw)


def background_is_better(named: Fit, background: Fit) -> bool:
    """Whether a fit with a background is better than one with the named effects alone.

    The rms error on poses left out must fall by `LEAST_GAIN`/√n, n the number of poses.
    """
    before, after = left_out_squares(named, background)
    least = LEAST_GAIN / float(np.sqrt(len(before)))
    return float(np.sum(after)) <= (1 - least) ** 2 * float(np.sum(before))


def explained_share(first: Fit, second: Fit) -> float:
    """Share of the first fit's misfit on poses left out that the second explains."""
    before, after = (float(np.sum(x)) for x in left_out_squares(first, second))
    return (before - after) / max(before - second.whitening.rank, 1.0)


def background_evidence(fit: Fit) -> tuple[BackgroundEffect, ...]:
    """Test the effects of a background that the readings show; smallest p-values first."""
    model, theta = fit.model, fit.theta
    if not model.background:
        return ()
    mixed = mixed_fit_at(model, fit.readings[~fit.outlier], fit.mode, theta)
    problem, log_std = mixed.equations.problem, mixed.log_std
    rng, random = np.random.default_rng(SEED), problem.families.random
    moves = fit.whitening.raw(model.jacobian(fit.solution.prediction, theta, 3))  # (D, 3, P)
    tested = []
    numbered = [(k, f) for k, f in enumerate(random) if f.effect in model.background]
    for name, group in groupby(numbered, lambda kf: kf[1].effect):
        numbers, families = zip(*group, strict=True)
        test = evidence(problem, numbers, rng, log_std, families[0].largest)
        if not test.rank:
            continue
        index = np.concatenate([f.parameters for f in families])
        std = np.exp(np.repeat(log_std[list(numbers)], [len(f.parameters) for f in families]))
        moved = np.sum((moves[:, :, index] @ theta[index]) ** 2, axis=1)
        columns = np.flatnonzero(np.isin(problem.family, numbers)) + problem.flat
        white = problem.x[:, columns] @ mixed.equations.coordinates[columns]
        tested.append(
            BackgroundEffect(
                effect=name,
                p_value=test.p_value,
                ratio=test.ratio,
                rank=test.rank,
                std=float(np.sqrt(np.mean(std**2))),
                rms_m=float(np.sqrt(np.mean(moved))),
                share=float(np.sum(white**2)),
                step=theta[index] / np.concatenate([f.magnitude for f in families]),
            )
        )
    total = sum(b.share for b in tested) or 1.0
    shares = [replace(b, share=b.share / total) for b in tested]
    return tuple(sorted(shares, key=lambda b: (b.p_value, -b.rms_m)))


def proved(tested: tuple[BackgroundEffect, ...]) -> tuple[str, ...]:
    """Names of the proved effects, the strongest evidence first.

    The likelihood must rise beyond 20 : 1 at a plausible size, since a small p-value alone may need
    an implausibly large effect.
    """
    sure = [b for b in tested if b.ratio > 2 * SAME_EVIDENCE]
    return tuple(b.effect for b in sure if b.p_value * len(tested) < FALSE_ALARM)


def as_suspects(tested: tuple[BackgroundEffect, ...]) -> Iterator[Suspect]:
    """Yield the effects of a background as suspects: none is proved, each may be present."""
    likely = [b.effect for b in tested if b.p_value < POSSIBLE_LEVEL]
    for b in tested:
        score = FamilyScore(
            p_value=b.p_value,
            log_evidence=0.5 * b.ratio,
            strength=b.std,
            ridge=np.inf if b.std == 0 else b.std**-2.0,
            rank=b.rank,
            effective=float(b.rank),
            gain=b.share,
            delta_bic=-b.ratio,
            step=b.step,
            spectrum=None,
            noise=1.0,
        )
        yield Suspect(
            effect=b.effect,
            score=score,
            share=b.share,
            left_out=lambda: HeldOut(0.0, False),
            explains=False,
            detection=lambda: Strength(np.inf, ()),
            same_as=tuple(n for n in likely if n != b.effect) if b.effect in likely else (),
        )
