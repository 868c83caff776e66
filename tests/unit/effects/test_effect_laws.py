"""The laws of the effects: against the simulated world, and small formulas and limiting cases."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.config.sections import Conventions, Coupling
from hilcal.drivers.simulated import truth
from hilcal.drivers.simulated.truth import Truth
from hilcal.drivers.simulated.world import SimulatedNoise, World
from hilcal.effects.link_compliance import long_links
from hilcal.errors import CannotAnswerError, InputError
from hilcal.model.model import Model
from hilcal.robot.arm import with_controller_conventions
from hilcal.robot.catalogue import robot_names
from hilcal.robot.chain import evaluate
from tests.support.arm_cases import arm_of
from tests.support.campaigns import distal_factors, true_parameters
from tests.support.effect_cases import (
    ALL_NAMES,
    CELLS,
    NAMES,
    TURN,
    UR10E,
    joints,
    make,
    options_of,
    position,
    situation,
    soft,
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
        draws = np.random.default_rng(13) if name == "joint_coupling" else rng
        truth = truth.with_effect(name, truth_of(name, cell, draws, scale))
    world = World(cell, truth, cell.registration, np.eye(4), SimulatedNoise(), np.zeros(cell.arm.n))
    model = Model(cell, tuple(make(n, cell, states, options_of(n)) for n in names))
    theta = np.concatenate([true_parameters(world, n) for n in names])
    return Both(world, model, theta)


def apart(b, states):
    """Largest distance, m, and angle, rad, of the model's readings from the world's."""
    model, world = b.model.predict(states, b.theta).observation, b.world.ideal_readings(states)
    turn = np.abs(model.rotation - world.rotation).max()
    return float(np.linalg.norm(model.position - world.position, axis=1).max()), float(turn)


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
# What is unknown has no mechanics in the world.
ALONE = tuple((n,) for n in ALL_NAMES if n not in (*ON_COMPLIANCE, "remainder"))
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


def test_a_remainder_moves_joints_and_the_whole_arm_by_waves_of_other_angles():
    states = some_states(UR10E, 6)
    effect = make("remainder", UR10E, states, {"laws": "2:4/base:1"})
    names = [p.name for p in effect.parameters]
    values = {"j2.q4.sin3": 2e-3, "j2.q4.cos1": -1e-3, "base.y.q1.cos2": 3e-4}
    theta = np.array([values.get(name, 0.0) for name in names])
    assert sum(name in values for name in names) == len(values)
    moved = Model(UR10E, (effect,)).predict(states, theta).observation.position
    turned = states.q.copy()
    turned[:, 1] += 2e-3 * np.sin(3 * states.q[:, 3]) - 1e-3 * np.cos(states.q[:, 3])
    base = Model(UR10E, (make("base_frame", UR10E, states),))
    for k, shift in enumerate(3e-4 * np.cos(2 * states.q[:, 0])):
        one = replace(states, q=turned, q_actual=None)[np.array([k])]
        expected = base.predict(one, np.array([0, shift, 0, 0, 0, 0])).observation.position
        np.testing.assert_allclose(moved[k], expected[0], atol=1e-12)


def test_a_remainder_follows_gravity_place_and_two_angles():
    states = some_states(UR10E, 6)
    laws = "3:4*5/target:gravity_x/tilt:reach"
    effect = make("remainder", UR10E, states, {"laws": laws})
    names = [p.name for p in effect.parameters]
    values = {"j3.q4.sin1q5.cos1": 2e-3, "target.z.gravity_x.power2": 3e-4}
    theta = np.array([values.get(name, 0.0) for name in names])
    assert sum(name in values for name in names) == len(values)
    moved = Model(UR10E, (effect,)).predict(states, theta).observation
    turned = states.q.copy()
    turned[:, 2] += 2e-3 * np.sin(states.q[:, 3]) * np.cos(states.q[:, 4])
    still = Model(UR10E, ()).predict(replace(states, q=turned, q_actual=None), np.zeros(0))
    flange = still.situation.chain.rotation[-1]
    shift = 3e-4 * flange[:, 2, 0] ** 2  # gravity along flange x is −z of the base along it
    z = still.observation.axes @ flange[:, :, 2, None]
    expected = still.observation.position + shift[:, None] * z[:, :, 0]
    np.testing.assert_allclose(moved.position, expected, atol=1e-6)  # the turn times the shift
    theta = np.array([1e-6 * (name == "tilt.x.reach.power1") for name in names])
    tilted = Model(UR10E, (effect,)).predict(states, theta).observation.position
    at = Model(UR10E, ()).predict(states, np.zeros(0)).observation
    reach = np.hypot(*at.base_position[:, :2].T) / UR10E.arm.reach
    turn = at.axes @ np.cross([1.0, 0.0, 0.0], at.base_position)[:, :, None]
    expected = at.position + 1e-6 * reach[:, None] * turn[:, :, 0]
    np.testing.assert_allclose(tilted, expected, atol=1e-11)


@pytest.mark.parametrize("laws", ["", "2:7", "3:4*7", "target:time", "0:1", "2:4/2:4", "tool:1", 3])
def test_a_remainder_refuses_other_laws(laws):
    with pytest.raises(InputError, match=r"remainder: laws = .* valid: pairs of what errs"):
        make("remainder", UR10E, some_states(UR10E, 6), {"laws": laws})


def test_drift_starts_at_its_reference_time():
    states = situation(UR10E).states
    rate = 1e-8 * np.arange(1.0, 7.0)
    for reference, start in ((None, states.time.min()), (100.0, 100.0)):
        given = {} if reference is None else {"reference_s": reference}
        effect = make("tracker_drift", UR10E, states, given)
        station = effect.deviation(rate, situation(UR10E)).station
        np.testing.assert_allclose(station, (states.time - start)[:, None] * rate, rtol=1e-13)
    until = float(np.median(states.time))
    effect = make("tracker_drift", UR10E, states, {"until_s": until})
    station = effect.deviation(rate, situation(UR10E)).station
    later = states.time >= until
    np.testing.assert_allclose(
        station[later], np.outer(later, rate)[later] * (until - states.time.min())
    )


@pytest.mark.parametrize("name", [*robot_names(), "odd"])
def test_long_links_are_those_of_the_simulated_world(name):
    arm = arm_of(name)
    np.testing.assert_array_equal(long_links(arm), truth.long_links(arm))


def test_an_arm_without_long_links_has_one_to_the_flange():
    arm = CELLS["ur10e"].arm
    links = arm.links.copy()
    links[1:-1, :3, 3] = 0.0
    assert long_links(replace(arm, links=links)).tolist() == [6]


def test_compliance_that_changes_with_the_angle_repeats_as_often_as_it_says():
    s = situation(UR10E)
    effect = make("periodic_joint_compliance", UR10E, s.states, {"orders": [3, 1]})
    theta = np.random.default_rng(0).normal(size=24)
    named = {p.name: t for p, t in zip(effect.parameters, theta, strict=True)}
    dq = effect.deviation(theta, s).dq
    for j in range(6):
        q = s.angle[:, j]
        wave = sum(
            named[f"j{j + 1}.cos{k}"] * np.cos(k * q) + named[f"j{j + 1}.sin{k}"] * np.sin(k * q)
            for k in (1, 3)
        )
        np.testing.assert_allclose(dq[:, j], s.torque[:, j] * wave, rtol=1e-12)


def test_creep_without_a_compliance_in_the_model_takes_a_typical_one():
    states = some_states(UR10E)
    alone = Model(UR10E, (make("creep", UR10E, states),)).predict(states, np.array([0.1]))
    typical = 2e-3 / UR10E.arm.torque_max
    decades = np.log10(1 + states.load_time)[:, None]
    expected = 0.1 * decades * typical * alone.situation.torque
    np.testing.assert_allclose(alone.deviation.dq, expected, rtol=0, atol=1e-12)


def test_links_that_grow_each_by_their_own_grow_together():
    cell = CELLS["odd"]
    states = some_states(cell)
    one = Model(cell, (make("thermal_growth", cell, states),))
    each = Model(cell, (make("thermal_growth", cell, states, {"links": "each"}),))
    a, b = position(one, states, np.array([1e-5])), position(each, states, np.full(8, 1e-5))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    assert [p.name for p in each.effects[0].parameters] == [f"link{k}" for k in range(8)]


ODD = CELLS["odd"]


def coupled(arm, **factors):
    """An arm whose joints follow others: j3q2=-1.0 is joint 3 by joint 2."""
    entries = tuple(
        Coupling(joint=int(name[1]), follows=int(name[3]), factor=k) for name, k in factors.items()
    )
    return with_controller_conventions(arm, Conventions(joint_coupling=entries))


@pytest.mark.parametrize("given", [{}, {"j3q2": -1.0, "j7q6": 0.5}])
def test_it_is_what_the_factors_of_the_description_are_off_by(given):
    """An arm described with other factors stands where the effect says, whatever it is coupled by.

    The factors are those of the controller's values, also where these turn other joints too.
    """
    believed = coupled(ODD.arm, **given)
    k = {"j2q1": 3e-3, "j3q2": -2e-3, "j7q5": 1e-3, "j7q6": -1e-3}
    true = coupled(ODD.arm, **{p: given.get(p, 0.0) + k.get(p, 0.0) for p in {*k, *given}})
    cell = replace(ODD, arm=believed)
    states = some_states(cell)
    effect = make("joint_coupling", cell, states)
    theta = np.array([k.get(p.name.replace(".", ""), 0.0) for p in effect.parameters])
    assert np.count_nonzero(theta) == len(k)
    chain = Model(cell, (effect,)).predict(states, theta).situation.chain
    expected = evaluate(true, states.q)
    np.testing.assert_allclose(chain.position[-1], expected.position[-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(chain.rotation[-1], expected.rotation[-1], rtol=0, atol=1e-14)


def test_the_lowest_waves_have_a_size_each_and_those_of_an_octave_share_one():
    effect = make("transmission_error", ODD, some_states(ODD), {"harmonics": 16})
    pools = effect.pools().reshape(ODD.arm.n, -1, 2)
    expected = [0, 1, 2, *[3] * 4, *[4] * 8, 5]
    np.testing.assert_array_equal(pools, np.broadcast_to(np.array(expected)[:, None], pools.shape))
    ordinary = np.exp([effect.expected_log_std(k)[0] for k in (0, 1, 2, 3, 4, 5)])
    halves = np.log2(ordinary[0] / ordinary)
    np.testing.assert_allclose(halves, [0, 1, 1, 2, 3, 4], atol=0.05)


def test_couplings_are_expected_a_tenth_as_large_where_the_description_has_none():
    means = []
    for arm in (coupled(ODD.arm, j3q2=-1.0), ODD.arm):
        cell = replace(ODD, arm=arm)
        means.append(make("joint_coupling", cell, some_states(cell)).expected_log_std(0)[0])
    assert np.exp(means[0] - means[1]) == pytest.approx(10.0)


def test_pairs_are_those_of_arms_with_couplings_or_those_that_are_named():
    states = some_states(ODD)
    usual = set(make("joint_coupling", ODD, states).options["pairs"].split("/"))
    diagonal = {f"{j}:{j}" for j in range(1, 8)}
    assert usual == {"2:1", "3:2", "4:3", "5:4", "6:5", "7:5", "7:6"} | diagonal
    some = make("joint_coupling", ODD, states, {"pairs": "4:4/ 3:2"})
    assert some.options == {"pairs": "3:2/4:4"}
    assert [p.name for p in some.parameters] == ["j3.q2", "j4.q4"]
    assert some.parameters[1].meaning == "own ratio of joint 4"
    s = Model(ODD, ()).predict(states, np.zeros(0)).situation
    twist = some.deviation(np.array([0.1, 0.01]), s).twist
    expected = np.zeros_like(twist)
    expected[:, 2, 5], expected[:, 3, 5] = 0.1 * states.q[:, 1], 0.01 * states.q[:, 3]
    np.testing.assert_allclose(twist, expected, rtol=1e-15)


@pytest.mark.parametrize("given", ["", "3", "3:2/3:2", "8:1", "0:1", "3-2", 3.2, None, ["3:2"]])
def test_other_pairs_are_refused_with_what_would_be_valid(given):
    with pytest.raises(InputError, match=r"pairs = .*; valid: pairs of joints 1 to 7") as caught:
        make("joint_coupling", ODD, some_states(ODD), {"pairs": given})
    assert "\n" not in str(caught.value)


def acting(wrench, flange, name, theta, turn):
    """What acts where a sensor says `wrench`, state by state: said = error(true) in its axes."""
    out = np.zeros_like(wrench)
    for i, w in enumerate(wrench):
        if not np.any(w):
            continue
        r = flange[i] @ Rotation.from_rotvec(turn).as_matrix()
        said = np.concatenate([r.T @ w[:3], r.T @ w[3:]])
        if name == "wrench_bias":
            true = said - theta
        elif name == "wrench_gain":
            true = said / (1 + theta)
        else:
            mounted = Rotation.from_rotvec(theta).as_matrix()
            true = np.concatenate([mounted @ said[:3], mounted @ said[3:]])
        out[i] = np.concatenate([r @ true[:3], r @ true[3:]])
    return out


ERRORS = {
    "wrench_bias": np.array([2.0, -1.0, 3.0, 0.3, -0.2, 0.1]),
    "wrench_gain": np.array([0.03, -0.02, 0.01, 0.02, -0.04, 0.01]),
    "sensor_misalignment": np.array([0.03, -0.02, 0.04]),
}


@pytest.mark.parametrize("options", [{}, {"rotvec_rad": TURN}], ids=["flange", "turned"])
@pytest.mark.parametrize("name", ERRORS)
def test_a_sensor_that_misreads_is_the_same_as_another_load(name, options):
    cell = CELLS["odd"]
    states = some_states(cell)
    model = soft(cell, states, name, options)
    theta = ERRORS[name]
    prediction = model.predict(states, np.concatenate([joints(cell), theta]))
    turn = np.array(options.get("rotvec_rad", [0.0, 0.0, 0.0]))
    other = acting(states.wrench, prediction.situation.chain.rotation[-1], name, theta, turn)
    plain = Model(cell, model.effects[:1])
    expected = plain.predict(replace(states, wrench=other), joints(cell))
    np.testing.assert_allclose(
        prediction.observation.position, expected.observation.position, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(prediction.situation.load.wrench, other, rtol=0, atol=1e-10)
    believed = plain.predict(states, joints(cell)).observation.position
    away = np.linalg.norm(prediction.observation.position - believed, axis=1)
    loaded = np.any(states.wrench != 0, axis=1)
    assert away[loaded].min() > 1e-6
    assert away[~loaded].max() == 0.0


def test_a_load_that_only_turns_is_a_load_too():
    """A state counts as unloaded only where force and moment are exactly zero."""
    cell = CELLS["odd"]
    states = some_states(cell)
    states = replace(states, wrench=np.tile([0.0, 0, 0, 0, 0, 1e-9], (len(states), 1)))
    model = soft(cell, states, "wrench_bias")
    bias = np.array([5.0, 0, 0, 0, 0, 0])
    moved = position(model, states, joints(cell), bias) - position(
        model, states, joints(cell), 0 * bias
    )
    assert np.linalg.norm(moved, axis=1).min() > 1e-6


def test_a_gain_that_no_sensor_has_is_said_in_words():
    states = some_states(UR10E)
    model = soft(UR10E, states, "wrench_gain")
    with pytest.raises(CannotAnswerError, match=r"wrench_gain: a gain error of -120 %") as caught:
        position(model, states, joints(UR10E), np.array([0, 0, -1.2, 0, 0, 0]))
    assert "\n" not in str(caught.value)
