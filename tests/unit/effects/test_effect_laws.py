"""The laws of the effects, against the simulated world, which shares no code with them."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.model.model import Model
from tests.support.campaigns import distal_factors, true_parameters
from tests.support.effect_cases import (
    ALL_NAMES,
    CELLS,
    NAMES,
    UR10E,
    make,
    options_of,
    situation,
    some_states,
)


@dataclass(frozen=True, slots=True, eq=False)
class Both:
    """A world and a model of the same cell that hold the same parameters."""

    world: World
    model: Model
    theta: np.ndarray


def truth_of(name, cell, rng, scale):
    """Random parameters, shaped as in the world."""
    zero = getattr(Truth.rigid(cell.arm, 3), name)
    effect = make(name, cell, some_states(cell), options_of(name))
    ordinary = np.array([p.scale for p in effect.parameters])
    drawn = rng.normal(size=len(ordinary))
    if name == "joint_compliance":  # an arm that gives way, also where it stiffens
        drawn = 1 + np.abs(drawn)
    if name == "joint_coupling":
        zero.reshape(-1)[distal_factors(cell.arm)] = scale * ordinary * drawn
        return zero
    return (scale * ordinary * drawn).reshape(zero.shape)


def both(names, cell, states, scale):
    rng = np.random.default_rng(11)
    truth = Truth.rigid(cell.arm)
    for name in names:
        # Apart, so that the others are drawn as without it: a gear may not stiffen too much.
        own = np.random.default_rng(13) if name == "joint_coupling" else rng
        truth = truth.with_effect(name, truth_of(name, cell, own, scale))
    world = World(cell, truth, cell.registration, np.eye(4), SimulatedNoise(), np.zeros(cell.arm.n))
    model = Model(cell, tuple(make(n, cell, states, options_of(n)) for n in names))
    theta = np.concatenate([true_parameters(world, n) for n in names])
    return Both(world, model, theta)


def apart(b, states):
    """Largest distance, m, and angle, rad, of the model's readings from the world's."""
    seen, told = b.model.predict(states, b.theta).observation, b.world.ideal_readings(states)
    turn = np.abs(seen.rotation - told.rotation).max()
    return float(np.linalg.norm(seen.position - told.position, axis=1).max()), float(turn)


def order_of_turns(b, states):
    """Sum of the tilts times the sum of all small rotations, rad²: what their order can make out.

    A tilt is one small rotation about the moment's axis in the program and two successive
    rotations about x and y in the world; the tip of a beam likewise. A link that grows does so
    before its twists in the world and along with them in the program.
    """
    p = b.model.predict(states, b.theta)
    tilt = total = grown = 0.0
    for effect, rows in zip(b.model.effects, b.model.slices(), strict=True):
        d = effect.deviation(b.theta[rows], p.situation)
        if d.twist is not None:
            turn = np.linalg.norm(d.twist[:, :, 3:], axis=2).sum(axis=1).max()
            total += turn
            shift = np.linalg.norm(d.twist[:, :, :3], axis=2).sum(axis=1).max()
            grown += shift / b.model.cell.arm.reach if effect.name == "thermal_growth" else 0.0
            tilt += turn if effect.name in TILTING else 0.0
        if d.dq is not None:
            total += np.abs(d.dq).sum(axis=1).max()
    return float((tilt + grown) * total)


TILTING = (
    *("guide_error", "joint_tilt_compliance"),
    *("base_compliance", "link_compliance", "tool_compliance"),
)
SENSOR = ("wrench_bias", "wrench_gain", "sensor_misalignment")
ON_COMPLIANCE = ("joint_stiffening", "creep", "link_mass", "load_point", *SENSOR)
ALONE = tuple((n,) for n in ALL_NAMES if n not in ON_COMPLIANCE)
TOGETHER = tuple(("joint_compliance", n) for n in ON_COMPLIANCE)
EVERYTHING = tuple(tuple(n for n in NAMES if n not in SENSOR or n == one) for one in SENSOR)
"""All effects, but one error of the force sensor at a time: their products are left out."""


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("names", [*ALONE, *TOGETHER, *EVERYTHING], ids="+".join)
def test_prediction_is_what_the_world_shows(names, arm):
    cell = CELLS[arm]
    if names == ("guide_error",) and not cell.arm.slides.any():
        pytest.skip("of arms with slides")
    states = some_states(cell, 6)
    for scale in (1.0, 1e-2):
        b = both(names, cell, states, 0.3 * scale)
        rigid = replace(b.world, physics=Truth.rigid(cell.arm))
        change = b.world.ideal_readings(states).position - rigid.ideal_readings(states).position
        moved = np.linalg.norm(change, axis=1).max()
        distance, turn = apart(b, states)
        reach = cell.arm.reach + np.linalg.norm(cell.registration[:3, 3])
        limit = order_of_turns(b, states) * reach
        # Equilibria to 1e-12 rad in the world and 1e-13 m here, of an arm of a metre or two.
        assert distance <= limit + 1e-11
        assert turn <= limit / reach + 1e-11
        assert limit < 0.05 * moved
        assert moved > 1e-9  # a hundred times the tolerance


def test_drift_starts_at_its_reference_time():
    states = situation(UR10E).states
    rate = 1e-8 * np.arange(1.0, 7.0)
    for reference, start in ((None, states.time.min()), (100.0, 100.0)):
        given = {} if reference is None else {"reference_s": reference}
        effect = make("tracker_drift", UR10E, states, given)
        station = effect.deviation(rate, situation(UR10E)).station
        np.testing.assert_allclose(station, (states.time - start)[:, None] * rate, rtol=1e-13)
