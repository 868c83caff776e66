"""Which effects of a model's background the readings prove, each beside all others.

The test of an effect is the restricted likelihood ratio against its standard deviation being zero,
with those of all others estimated anew (see `mixed.variances`).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE, Suspect
from hilcal.diagnosis.minimum_detectable_effect import Strength
from hilcal.identification.background import UNSURE
from hilcal.identification.fit import Fit, all_left_out
from hilcal.identification.linearisation import HeldOut
from hilcal.identification.mixed_fit import (
    linearised_problem,
    mixed_fit_at,
    sizes_at,
    with_all_effects,
)
from hilcal.mixed.variances import evidence
from hilcal.regression.evidence import FamilyScore
from hilcal.types import Floats

PROVED = 0.01
"""Chance of naming any effect of the background where none is there, over all that are tested; a
choice: that something is there has been shown by poses left out."""
WORTH = 0.05
"""Share by which the rms error on poses left out must fall for a background; a choice: it has
hundreds of parameters, and those that name an effect alone are easier to understand."""
TOGETHER = 0.05
"""Chance of trying a background where nothing but noise of another size, or the arm's scatter, is
there; a choice: the error on poses left out has to fall, too."""
LIKELY = 0.1
"""p-value below which an effect of the background is named as one that may be there; a choice."""
SEED = 0  # of the simulated ratios, so that equal fits give equal p-values


@dataclass(frozen=True, slots=True, eq=False)
class BackgroundEffect:
    """One effect of the background."""

    effect: str  # its name
    p_value: float  # of the test against its absence
    ratio: float  # the restricted likelihood ratio
    rank: int  # number of its directions that the others do not span
    std: float  # root of the mean square of its standard deviations, in ordinary magnitudes
    rms_m: float  # root of the mean square of what it moves the measured positions by, m
    share: float  # of the misfit that the background explains, in whitened squares
    step: Floats  # (q,) its parameters, in ordinary magnitudes


def p_value_of_others(of: Fit) -> float:
    """p-value of all effects that are not named together, beside a noise of any size.

    They are tested at the fit, by one multiple of their ordinary sizes.
    """
    kept = of.readings[~of.outlier].as_stated()
    model = with_all_effects(of.model, kept.states)
    known = {
        (e.name, p.name): value
        for e, mine in zip(of.model.effects, of.model.slices(), strict=True)
        for p, value in zip(e.parameters, of.theta[mine], strict=True)
    }
    theta = np.array(
        [known.get((e.name, p.name), 0.0) for e in model.effects for p in e.parameters]
    )
    problem = linearised_problem(model, kept, of.mode, theta)
    random = problem.families.random
    numbers = [k for k, f in enumerate(random) if f.effect not in of.model.named]
    start = sizes_at(problem, model, theta)
    return evidence(problem, numbers, np.random.default_rng(SEED), start).p_value


def background_is_better(before: Fit, after: Fit) -> bool:
    """Whether a background belongs to the model: `after` has one, `before` the named effects alone.

    The error on poses left out must fall by a share, both weighted by the noise of the latter.
    """
    raw, w = all_left_out(after)
    one, other = (float(np.sum(w.whiten(r) ** 2)) for r in (all_left_out(before)[0], raw))
    return other <= (1 - WORTH) ** 2 * one


def background_evidence(fit: Fit) -> tuple[BackgroundEffect, ...]:
    """Test the effects of a background that the readings show; smallest p-values first."""
    model, theta = fit.model, fit.theta
    if not model.background:
        return ()
    found = mixed_fit_at(model, fit.readings[~fit.outlier].as_stated(), fit.mode, theta)
    problem, log_std = found.equations.problem, found.log_std
    rng, families = np.random.default_rng(SEED), problem.families.random
    moves = fit.whitening.raw(model.jacobian(fit.solution.prediction, theta, 3))  # (D, 3, P)
    most = {e.name: e.most() for e in model.effects}
    tested = []
    numbered = [(k, f) for k, f in enumerate(families) if f.effect in model.background]
    for name, own in groupby(numbered, lambda kf: kf[1].effect):
        numbers, mine = zip(*own, strict=True)
        test = evidence(problem, numbers, rng, log_std, UNSURE * most[name])
        if not test.rank:
            continue
        index = np.concatenate([f.parameters for f in mine])
        std = np.exp(np.repeat(log_std[list(numbers)], [len(f.parameters) for f in mine]))
        moved = np.sum((moves[:, :, index] @ theta[index]) ** 2, axis=1)
        columns = np.flatnonzero(np.isin(problem.family, numbers)) + problem.flat
        white = problem.x[:, columns] @ found.equations.coordinates[columns]
        tested.append(
            BackgroundEffect(
                effect=name,
                p_value=test.p_value,
                ratio=test.ratio,
                rank=test.rank,
                std=float(np.sqrt(np.mean(std**2))),
                rms_m=float(np.sqrt(np.mean(moved))),
                share=float(np.sum(white**2)),
                step=theta[index] / np.concatenate([f.magnitude for f in mine]),
            )
        )
    total = sum(b.share for b in tested) or 1.0
    shares = [replace(b, share=b.share / total) for b in tested]
    return tuple(sorted(shares, key=lambda b: (b.p_value, -b.rms_m)))


def proved(found: tuple[BackgroundEffect, ...]) -> tuple[str, ...]:
    """Names of those that are proved, the strongest evidence first.

    The likelihood must rise beyond 20 : 1 at a plausible size: the p-value alone says nothing of
    an effect that would have to be far larger.
    """
    sure = [b for b in found if b.ratio > 2 * SAME_EVIDENCE]
    return tuple(b.effect for b in sure if b.p_value * len(found) < PROVED)


def as_suspects(found: tuple[BackgroundEffect, ...]) -> Iterator[Suspect]:
    """Yield the effects of a background as suspects: none is proved, each may be there."""
    likely = [b.effect for b in found if b.p_value < LIKELY]
    for b in found:
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
