"""A misfit that is the same under every load of a pose, which effects do that, and how many poses.

With few poses a fine transmission error is no pattern: every pose errs by itself, and no pose
predicts another. But all readings of a pose err alike, whatever hangs on the arm. That alone says
much: what is missing depends on the pose, and on nothing else that changed within it.

The residual is split by constants of each pose, three displacements of the target. Where they leave
noise and take nearly all of the misfit, the effects are listed whose own columns are such constants
to nearly all of their square. The parameters of a family can be told apart once the poses measure
about as many elements as the family has parameters. The number of further poses that is proposed is
the smallest of the numbers tried at which the first of these effects, as large as the misfit, would
pass every test of a suspect with a probability of `SURE`. For that campaigns are simulated by
algebra, at the linearisation of the fit: the readings so far, and unloaded ones at further poses
within the range of the joints so far; parameters drawn with the size found; noise; all tests.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, most, unloaded_readings
from hilcal.diagnosis.minimum_detectable_effect import SuspectTests
from hilcal.diagnosis.misfit_breakdown import pose_constants
from hilcal.diagnosis.noise import MISFIT_ALARM
from hilcal.diagnosis.stepwise import add
from hilcal.effects.protocol import Effect
from hilcal.errors import HilcalError
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.readings.readings import Readings
from hilcal.regression.evidence import spectrum
from hilcal.robot import se3

LEAST = 0.9
"""Share of the misfit that pose constants must take; a choice, they take 0.99 of a transmission
error of 2 σ."""
ALIKE = 0.98
"""Share of the square of an effect's columns that pose constants take where it depends on the pose
alone; a choice."""
DRAWS = 24  # simulated campaigns of a number of poses; a choice: 0.9 is known to 0.06
SURE = 0.9  # chance from which on poses are enough; a choice
SHARES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Numbers of poses that are tried, in units of those that would measure as many elements as the
family has parameters. A choice."""
_SEED = 20240613


@dataclass(frozen=True, slots=True)
class PoseAlone:
    """A misfit that depends on the pose alone."""

    share: float  # of the misfit that constants of each pose take, less what chance would
    effects: tuple[str, ...]  # those that depend on the pose alone, most parameters first
    poses: int  # number of poses that were measured
    more: int  # how many more poses, read unloaded, tell of the first of them
    # that they do, where it is as large as the misfit; None where the model holds a coarser one
    chance: float | None


class PosePower(NamedTuple):
    """Chance that an effect passes every test of a suspect beside a rival that is fitted."""

    effect: str  # which is there with the size that explains the misfit
    rival: str  # the one that the model holds
    now: float  # with the readings so far
    then: float  # with further poses as well


def pose_alone(
    p: Linearisation,
    effects: Sequence[Effect],  # that are not in the model
    level: float,  # of the test of a suspect, between 0 and 1
) -> PoseAlone | None:
    """Return a misfit that depends on the pose alone; None where it does not, or no effect does."""
    found = pose_constants(p)
    if found is None:
        return None
    fit, rank = p.fit, found.rank
    rest = p.rss - found.gain
    share = p.share(found.gain - rank * rest / (fit.dof - rank))
    if share < LEAST or float(chi2.sf(rest, fit.dof - rank)) < MISFIT_ALARM:
        return None
    able, states = [], fit.readings[~fit.outlier].states
    for e in (*(e for e in fit.model.effects if e.fine(states)), *effects):
        full = e.fine(states) or e
        x = p.project_out(effect_columns(fit, full).white)
        square = float(np.sum(x**2))
        if square > 0 and found.square(x) >= ALIKE * square:
            able.append((len(full.parameters), e))
    able.sort(key=lambda pair: -pair[0])
    poses = int(fit.pose.max()) + 1
    about = int(np.ceil(able[0][0] / fit.whitening.m)) - poses if able else 0
    if about <= 0:
        return None
    names, first = tuple(e.name for _, e in able), able[0][1]
    if first.name in fit.model.names:
        return PoseAlone(share, names, poses, about, None)
    more, sure = about, 0.0
    for part in SHARES:
        more = max(int(np.ceil(part * about)), 1)
        sure = chance(p, first, more, level)
        if sure >= SURE:
            break
    return PoseAlone(share, names, poses, more, sure)


def pose_powers(
    before: Fit,  # of a model without the effects
    effects: Sequence[str],  # two or more that depend on the pose alone
    more: int,  # further poses, read unloaded
) -> Iterator[PosePower]:
    """Yield how well the first of some effects is told from each of the others."""
    states, model = before.readings[~before.outlier].states, before.model
    first, *rivals = effects
    made = model.catalogue.make(first, model.cell, states, m=before.readings.m)
    possible = [kind for kind in model.catalogue.effects if kind.applies(made.cell)]
    level = FALSE_ALARM / max(len(possible) - len(model.effects), 1)
    strength = strength_of(linearise(before), made)
    for rival in rivals:
        try:
            p = linearise(add(before, rival))
        except HilcalError:
            continue
        now, then = (chance(p, made, n, level, strength) for n in (0, more))
        yield PosePower(first, rival, now, then)


def strength_of(p: Linearisation, effect: Effect) -> float:
    """Return the strength with which an effect, as fine as it may be, explains the misfit."""
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    square = float(np.sum(p.project_out(effect_columns(p.fit, full).white) ** 2))
    return min(float(np.sqrt(p.misfit() / square)), full.most()) if square > 0.0 else 0.0


def chance(
    p: Linearisation,  # of the fit so far
    effect: Effect,
    more: int,  # further poses, read unloaded
    level: float,  # of the test of a suspect, between 0 and 1
    strength: float | None = None,  # of its parameters; that which explains the misfit unless given
) -> float:
    """Return the chance that a family passes every test with so many more poses."""
    rng = np.random.default_rng(_SEED)
    t = strength_of(p, effect) if strength is None else strength
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    try:
        then = _with(p.fit, more, rng) if more else p.fit
    except HilcalError:
        return 0.0
    q, states = linearise(then), then.readings[~then.outlier].states
    scored = effect_columns(then, type(effect)(effect.cell, states).for_scoring(states))
    there = effect_columns(then, full.with_options(states)).white
    signal = t * there @ rng.standard_normal((there.shape[1], DRAWS))
    y = signal + rng.standard_normal(signal.shape)
    s = spectrum(q.information(scored.white))
    largest = most(scored, unloaded_readings(then))
    return float(np.mean(SuspectTests(q, scored, s, level, largest).found(y)))


def _with(before: Fit, more: int, rng: np.random.Generator) -> Fit:
    """Return the fit with unloaded readings at further poses, which the model predicts exactly."""
    now = before.readings[~before.outlier]
    rows = np.flatnonzero(now.unloaded) if now.unloaded.any() else np.arange(len(now))
    chosen = now[rng.choice(rows, more)]
    low, high = now.states.q.min(axis=0), now.states.q.max(axis=0)
    q = before.model.cell.arm.complete(rng.uniform(low, high, (more, len(low))))
    actual = None if chosen.states.q_actual is None else q.copy()
    names = (*now.pose_names, *(f"further {k + 1}" for k in range(more)))
    further = replace(
        chosen,
        states=replace(chosen.states, q=q, q_actual=actual),
        pose=len(now.pose_names) + np.arange(more),
        pose_names=names,
    )
    joined = Readings.joined([replace(now, pose_names=names), further])
    seen = before.model.predict(joined.states, before.theta).observation
    value = seen.position
    if now.m == 6:
        value = np.hstack([value, se3.rotation_vector(seen.rotation)])
    return fit(before.model, replace(joined, value=value), before.mode)
