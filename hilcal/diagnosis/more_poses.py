"""How many more poses tell a cause that depends on the pose alone: the chance that a test decides.

A family finer than the poses resolve passes no test on poses left out, however strong it is. With
more poses it does, and by how many follows from its size: that which the misfit is explained with.
Campaigns are simulated by algebra, at the linearisation of the fit: the readings so far, and
unloaded ones at further poses within the range of the joints so far; parameters drawn with the size
found; noise; every test that a suspect must pass.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, LEAST_SHARE
from hilcal.diagnosis.family_detection import SuspectTests
from hilcal.diagnosis.plausible_size import most, unloaded_readings
from hilcal.diagnosis.stepwise import add
from hilcal.effects.protocol import Effect
from hilcal.errors import HilcalError
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import Linearisation, linearise
from hilcal.readings.readings import Readings
from hilcal.regression.spectrum import spectrum
from hilcal.robot import se3

DRAWS = 24
"""Simulated campaigns of a number of poses; a choice: a chance of 0.9 is known to 0.06."""
SURE = 0.9
"""Chance from which on poses are enough; a choice."""
SHARES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Numbers of poses that are tried, in units of those that would measure as many elements as the
family has parameters. A choice."""
_SEED = 20240613


@dataclass(frozen=True, slots=True)
class Poses:
    """A number of further poses, and what they tell.

    Attributes:
        more: how many.
        chance: that every test of a suspect is passed.
    """

    more: int
    chance: float


class PosePower(NamedTuple):
    """Chance that an effect passes every test of a suspect beside a rival that is fitted.

    Attributes:
        effect: the effect, which is there with the size that explains the misfit.
        rival: the one that the model holds.
        now: with the readings so far.
        then: with further poses as well.
    """

    effect: str
    rival: str
    now: float
    then: float


def enough(p: Linearisation, effect: Effect, about: int, level: float, least: float) -> Poses:
    """Return the least number of further poses that tell, or the most that were tried.

    Args:
        p: linearisation of the fit.
        effect: the family that would explain the misfit.
        about: number of poses that would measure as many elements as it has parameters.
        level: of the test of a suspect, between 0 and 1.
        least: share of the misfit on poses left out that must be explained.
    """
    tried = Poses(about, 0.0)
    for share in SHARES:
        more = max(int(np.ceil(share * about)), 1)
        tried = Poses(more, chance(p, effect, more, level, least))
        if tried.chance >= SURE:
            break
    return tried


def chance(
    p: Linearisation,
    effect: Effect,
    more: int,
    level: float,
    least: float,
    strength: float | None = None,
) -> float:
    """Return the chance that a family passes every test with so many more poses.

    Args:
        p: linearisation of the fit so far.
        effect: the family, with the size that explains the misfit.
        more: further poses, read unloaded.
        level: of the test of a suspect, between 0 and 1.
        least: share of the misfit on poses left out that must be explained.
        strength: standard deviation of its parameters in ordinary magnitudes, where it is not that
            which explains the misfit of this fit.
    """
    rng = np.random.default_rng(_SEED)
    t = strength_of(p, effect) if strength is None else strength
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    try:
        then = _with(p.fit, more, rng) if more else p.fit
    except HilcalError:
        return 0.0
    q = linearise(then)
    states = then.readings[~then.outlier].states
    scored = effect_columns(then, type(effect)(effect.cell, states).for_scoring(states))
    there = effect_columns(then, full.with_options(states)).white
    signal = t * there @ rng.standard_normal((there.shape[1], DRAWS))
    y = signal + rng.standard_normal(signal.shape)
    s = spectrum(q.information(scored.white))
    largest = most(scored, unloaded_readings(then))
    return float(np.mean(SuspectTests(q, scored, s, level, least, largest).found(y)))


def pose_powers(before: Fit, effects: Sequence[str], more: int) -> Iterator[PosePower]:
    """Yield how well the first of some effects is told from each of the others.

    Args:
        before: a fit of a model without them.
        effects: two effects or more that depend on the pose alone.
        more: further poses, read unloaded.
    """
    states = before.readings[~before.outlier].states
    first, *rivals = effects
    made = before.model.catalogue.make(first, before.model.cell, states, m=before.readings.m)
    possible = [kind for kind in before.model.catalogue.effects if kind.applies(made.cell)]
    count = len(possible) - len(before.model.effects)
    level = FALSE_ALARM / max(count, 1)
    strength = strength_of(linearise(before), made)
    for rival in rivals:
        try:
            p = linearise(add(before, rival))
        except HilcalError:
            continue
        now, then = (chance(p, made, n, level, LEAST_SHARE, strength) for n in (0, more))
        yield PosePower(first, rival, now, then)


def strength_of(p: Linearisation, effect: Effect) -> float:
    """Return the strength with which an effect, as fine as it may be, explains the misfit."""
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    square = float(np.sum(p.project_out(effect_columns(p.fit, full).white) ** 2))
    return min(float(np.sqrt(p.misfit() / square)), full.most()) if square > 0.0 else 0.0


def _with(before: Fit, more: int, rng: np.random.Generator) -> Fit:
    """Return the fit with unloaded readings at further poses, which the model predicts exactly."""
    now = before.readings[~before.outlier]
    rows = np.flatnonzero(now.unloaded) if now.unloaded.any() else np.arange(len(now))
    rows = rng.choice(rows, more)
    low, high = now.states.q.min(axis=0), now.states.q.max(axis=0)
    q = before.model.cell.arm.complete(rng.uniform(low, high, (more, len(low))))
    chosen = now[rows]
    states = replace(
        chosen.states, q=q, q_actual=None if chosen.states.q_actual is None else q.copy()
    )
    names = tuple(f"further {k + 1}" for k in range(more))
    every = replace(now, pose_names=(*now.pose_names, *names))
    further = replace(chosen, states=states, pose=len(now.pose_names) + np.arange(more))
    joined = Readings.joined([every, replace(further, pose_names=every.pose_names)])
    seen = before.model.predict(joined.states, before.theta).observation
    value = seen.position
    if now.m == 6:
        value = np.hstack([value, se3.rotation_vector(seen.rotation)])
    return fit(before.model, replace(joined, value=value), before.mode)
