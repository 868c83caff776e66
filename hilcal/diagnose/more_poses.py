"""How many more poses tell a cause that depends on the pose alone: the chance that a test decides.

A family finer than the poses resolve passes no test on poses left out, however strong it is. With
more poses it does, and by how many follows from its size: that which the misfit is explained with.
Campaigns are simulated by algebra, at the linearisation of the fit: the readings so far, and
unloaded ones at further poses within the range of the joints so far; parameters drawn with the size
found; noise; every test that a suspect must pass.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.data.readings import Readings
from hilcal.diagnose.family_detection import found
from hilcal.diagnose.plausible_size import most, unloaded_readings
from hilcal.effects.protocol import Effect
from hilcal.errors import HilcalError
from hilcal.identify.fit import Fit, fit
from hilcal.identify.linearisation import Linearisation, effect_columns, linearise
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


def chance(p: Linearisation, effect: Effect, more: int, level: float, least: float) -> float:
    """Return the chance that a family passes every test with so many more poses.

    Args:
        p: linearisation of the fit so far.
        effect: the family, with the size that explains the misfit.
        more: further poses, read unloaded.
        level: of the test of a suspect, between 0 and 1.
        least: share of the misfit on poses left out that must be explained.
    """
    rng = np.random.default_rng(_SEED)
    now = p.fit.readings[~p.fit.outlier]
    full = effect.fine(now.states) or effect
    x = effect_columns(p.fit, full).white
    size = float(np.sum(p.project_out(x) ** 2))
    if size <= 0.0:
        return 0.0
    t = min(float(np.sqrt(p.misfit() / size)), full.most())
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
    s = q.information(scored.white)
    largest = most(scored, unloaded_readings(then))
    return float(np.mean(found(q, scored, s, y, level, least, largest)))


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
