"""A misfit that depends on the pose alone, its possible effects, and the poses to identify them.

With few poses a fine transmission error shows no pattern: no pose predicts another. But all
readings of a pose have the same error under every load: the missing effect depends on the pose.

The residual is split by constants of each pose, three displacements of the target. If they explain
nearly all of the misfit and leave noise, those effects are listed whose columns are such constants
to nearly all of their square. The parameters of a family can be separated once the poses measure
about as many elements as the family has parameters. The proposed number of further poses is the
smallest of `TRIED_SHARES` at which the first of these effects, as large as the misfit, would pass
every test of a suspect with the probability `ENOUGH_POWER`, in campaigns simulated by algebra at
the linearisation of the fit: with further unloaded readings within the range of the joints so far.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy

from hilcal.diagnosis.effect_ranking import FALSE_ALARM, largest_plausible, unloaded_readings
from hilcal.diagnosis.minimum_detectable_effect import SimulatedCampaigns, SuspectTests
from hilcal.diagnosis.misfit_breakdown import pose_constants
from hilcal.diagnosis.noise import MISFIT_ALARM
from hilcal.diagnosis.stepwise import add
from hilcal.effects.protocol import Effect
from hilcal.errors import HilcalError
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import Linearisation, effect_columns, linearise
from hilcal.readings.readings import Readings
from hilcal.regression.evidence import spectrum
from hilcal.robot import se3

LEAST_SHARE = 0.9
"""Share of the misfit that pose constants must explain; a choice: they explain 0.99 of a
transmission error of 2 σ."""
SPANNED_SHARE = 0.98
"""Share of the square of an effect's columns that pose constants must explain for the effect to
depend on the pose alone; a choice."""
DRAWS = 24  # simulated campaigns per number of poses; a choice: 0.9 is known to 0.06
ENOUGH_POWER = 0.9  # probability at which poses are enough; a choice
TRIED_SHARES = (0.25, 0.5, 0.75, 1.0, 1.5, 2.0)
"""Tried numbers of further poses, in units of the number that would measure as many elements as the
family has parameters. A choice."""
_SEED = 20240613


@dataclass(frozen=True, slots=True)
class PoseAlone:
    """A misfit that depends on the pose alone."""

    share: float  # of the misfit that constants of each pose explain beyond chance
    effects: tuple[str, ...]  # those that depend on the pose alone, most parameters first
    poses: int  # number of poses that were measured
    more: int  # further poses, read unloaded, that would reveal the first effect
    # probability that they reveal one as large as the misfit; None if the model has a coarser form
    chance: float | None


class PosePower(NamedTuple):
    """Chance that an effect passes every test of a suspect beside a rival in the model."""

    effect: str  # present with the size that explains the misfit
    rival: str  # in the model
    power_now: float  # with the readings so far
    power_then: float  # with further poses as well


def pose_alone(
    p: Linearisation,
    effects: Sequence[Effect],  # that are not in the model
    level: float,  # of the test of a suspect, between 0 and 1
) -> PoseAlone | None:
    """Return a misfit that depends on the pose alone, and its effects; None without either."""
    constants = pose_constants(p)
    if constants is None:
        return None
    fit, rank = p.fit, constants.rank
    remainder = p.rss - constants.gain
    share = p.share(constants.gain - rank * remainder / (fit.dof - rank))
    if share < LEAST_SHARE or float(scipy.stats.chi2.sf(remainder, fit.dof - rank)) < MISFIT_ALARM:
        return None
    pose_effects, states = [], fit.readings[~fit.outlier].states
    for e in (*(e for e in fit.model.effects if e.fine(states)), *effects):
        full = e.fine(states) or e
        x = p.project_out(effect_columns(fit, full).white)
        square = float(np.sum(x**2))
        if square > 0 and constants.square(x) >= SPANNED_SHARE * square:
            pose_effects.append((len(full.parameters), e))
    pose_effects.sort(key=lambda pair: -pair[0])
    poses = int(fit.pose.max()) + 1
    missing = int(np.ceil(pose_effects[0][0] / fit.whitening.m)) - poses if pose_effects else 0
    if missing <= 0:
        return None
    names, first = tuple(e.name for _, e in pose_effects), pose_effects[0][1]
    if first.name in fit.model.names:
        return PoseAlone(share, names, poses, missing, None)
    further, power = missing, 0.0
    for part in TRIED_SHARES:
        further = max(int(np.ceil(part * missing)), 1)
        power = detection_power(p, first, further, level)
        if power >= ENOUGH_POWER:
            break
    return PoseAlone(share, names, poses, further, power)


def pose_powers(
    fit: Fit,  # of a model without the effects
    effects: Sequence[str],  # two or more that depend on the pose alone
    further: int,  # poses, read unloaded
) -> Iterator[PosePower]:
    """Yield how well the first of some effects is separated from each of the others."""
    states, model = fit.readings[~fit.outlier].states, fit.model
    first, *rivals = effects
    effect = model.catalogue.make(first, model.cell, states, m=fit.readings.m)
    possible = [kind for kind in model.catalogue.effects if kind.applies(effect.cell)]
    level = FALSE_ALARM / max(len(possible) - len(model.effects), 1)
    strength = strength_of(linearise(fit), effect)
    for rival in rivals:
        try:
            p = linearise(add(fit, rival))
        except HilcalError:
            continue
        now, then = (detection_power(p, effect, n, level, strength) for n in (0, further))
        yield PosePower(first, rival, now, then)


def strength_of(p: Linearisation, effect: Effect) -> float:
    """Return the strength with which an effect in its finest form explains the misfit."""
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    square = float(np.sum(p.project_out(effect_columns(p.fit, full).white) ** 2))
    return min(float(np.sqrt(p.misfit() / square)), full.most()) if square > 0.0 else 0.0


def detection_power(
    p: Linearisation,  # of the fit so far
    effect: Effect,
    further: int,  # poses, read unloaded
    level: float,  # of the test of a suspect, between 0 and 1
    strength: float | None = None,  # of its parameters; by default as large as the misfit
) -> float:
    """Return the chance that a family passes every test with a number of further poses."""
    rng = np.random.default_rng(_SEED)
    t = strength_of(p, effect) if strength is None else strength
    full = effect.fine(p.fit.readings[~p.fit.outlier].states) or effect
    try:
        extended = _with_poses(p.fit, further, rng) if further else p.fit
    except HilcalError:
        return 0.0
    q, states = linearise(extended), extended.readings[~extended.outlier].states
    scored = effect_columns(extended, type(effect)(effect.cell, states).for_scoring(states))
    x = effect_columns(extended, full.with_options(states)).white
    signal = t * x @ rng.standard_normal((x.shape[1], DRAWS))
    y = signal + rng.standard_normal(signal.shape)
    s = spectrum(q.information(scored.white))
    largest = largest_plausible(scored, unloaded_readings(extended))
    return float(
        np.mean(SuspectTests(q, scored, s, level, largest).passed(SimulatedCampaigns.of(q, y)))
    )


def _with_poses(first: Fit, count: int, rng: np.random.Generator) -> Fit:
    """Return the fit with unloaded readings at further poses, which the model predicts exactly."""
    readings = first.readings[~first.outlier]
    rows = np.flatnonzero(readings.unloaded | ~readings.unloaded.any())
    chosen = readings[rng.choice(rows, count)]
    low, high = readings.states.q.min(axis=0), readings.states.q.max(axis=0)
    q = first.model.cell.arm.complete(rng.uniform(low, high, (count, len(low))))
    actual = None if chosen.states.q_actual is None else q.copy()
    names = (*readings.pose_names, *(f"further {k + 1}" for k in range(count)))
    further = replace(
        chosen,
        states=replace(chosen.states, q=q, q_actual=actual),
        pose=len(readings.pose_names) + np.arange(count),
        pose_names=names,
    )
    joined = Readings.joined([replace(readings, pose_names=names), further])
    predicted = first.model.predict(joined.states, first.theta).observation
    value = predicted.position
    if readings.m == 6:
        value = np.hstack([value, se3.rotation_vector(predicted.rotation)])
    return fit(first.model, replace(joined, value=value), first.mode)
