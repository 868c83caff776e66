"""Laws of effects against small formulas and limiting cases that share nothing with them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import quad_vec

from drivers.simulated import elastic_tree
from hilcal.effects.link_compliance import long_links
from hilcal.model.model import Model
from hilcal.robot import chain as chains
from hilcal.robot.catalogue import robot_names
from tests.support.arm_cases import arm_of
from tests.support.effect_cases import CELLS, SOFT, make, position, situation, soft, some_states

# --- elastic --------------------------------------------------------------------------------


def cantilever(along, force, moment, bend, twist):
    """Shift and turn of a beam's tip: its curvature and twist rate, integrated from the root."""
    length = np.linalg.norm(along)
    d = along / length

    def rate(x):
        """Turn per length at x, by the moment that is carried there."""
        here = moment + np.cross((length - x) * d, force)
        return bend * (here - d * (d @ here)) + twist * d * (d @ here)

    turn, _ = quad_vec(rate, 0, length)
    shift, _ = quad_vec(lambda x: np.cross(rate(x), (length - x) * d), 0, length)
    return shift, turn


@pytest.mark.parametrize("arm", CELLS)
def test_a_long_link_bends_as_the_integral_of_its_curvature(arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make("link_compliance", cell, s.states)
    beams = long_links(cell.arm)
    theta = np.random.default_rng(0).uniform(1e-6, 1e-5, (len(beams), 2))
    twist = effect.deviation(theta.ravel(), s).twist
    for k, (bend, torsion) in zip(beams, theta, strict=True):
        link = cell.arm.links[k]
        for i in range(len(s.states)):
            axes = s.chain.rotation[k, i]
            along = axes @ link[:3, :3].T @ link[:3, 3]
            force, moment = axes @ s.wrench[i, k, :3], axes @ s.wrench[i, k, 3:]
            shift, turn = cantilever(along, force, moment, bend, torsion)
            np.testing.assert_allclose(axes @ twist[i, k, :3], shift, rtol=0, atol=1e-14)
            np.testing.assert_allclose(axes @ twist[i, k, 3:], turn, rtol=0, atol=1e-14)
        assert np.abs(twist[:, k]).max() > 1e-5
    assert np.all(np.delete(twist, beams, axis=1) == 0)


@pytest.mark.parametrize("name", [*robot_names(), "odd"])
def test_long_links_are_those_of_the_simulated_world(name):
    arm = arm_of(name)
    np.testing.assert_array_equal(long_links(arm), elastic_tree.long_links(arm))


def test_an_arm_without_long_links_has_one_to_the_flange():
    arm = CELLS["ur10e"].arm
    links = arm.links.copy()
    links[1:-1, :3, 3] = 0.0
    assert long_links(replace(arm, links=links)).tolist() == [6]


@pytest.mark.parametrize("arm", CELLS)
def test_a_tool_turns_along_and_tilts_across_the_flange_axis(arm):
    cell = CELLS[arm]
    s = situation(cell)
    twist = make("tool_compliance", cell, s.states).deviation(np.array([2e-6, 5e-6]), s).twist
    flange = s.chain.rotation[-1]
    # The moment about the flange's origin, of load and tool, as a sum of forces at levers.
    lever = np.einsum("nij,j->ni", flange, cell.load_point)
    moment = s.states.wrench[:, 3:] + np.cross(lever, s.states.wrench[:, :3])
    com = np.einsum("nij,j->ni", flange, cell.tool_com)
    moment = moment + np.cross(com, cell.tool_mass * cell.gravity)
    z = flange[:, :, 2]
    along = z * np.sum(z * moment, axis=1, keepdims=True)
    expected = 2e-6 * along + 5e-6 * (moment - along)
    turn = np.einsum("nij,nj->ni", flange, twist[:, -1, 3:])
    np.testing.assert_allclose(turn, expected, rtol=0, atol=1e-17)
    assert np.all(twist[:, :-1] == 0)
    assert np.all(twist[:, :, :3] == 0)


def test_compliance_that_changes_with_the_angle_repeats_as_often_as_it_says():
    cell = CELLS["ur10e"]
    s = situation(cell)
    effect = make("periodic_joint_compliance", cell, s.states, {"orders": [3, 1]})
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
    usual = make("periodic_joint_compliance", cell, s.states)
    assert [p.name for p in usual.parameters[:4]] == ["j1.cos2", "j1.sin2", "j2.cos2", "j2.sin2"]
    half = replace(s, angle=s.angle + np.pi)
    np.testing.assert_allclose(
        usual.deviation(theta[:12], half).dq, usual.deviation(theta[:12], s).dq, rtol=0, atol=1e-12
    )


def test_play_is_taken_up_to_the_side_of_the_torque():
    cell = CELLS["ur10e"]
    s = situation(cell)
    b = 1e-5 * np.arange(1.0, 7.0)
    effect = make("backlash", cell, s.states)

    def at(torque):
        wrench = s.wrench.copy()
        wrench[:, :-1, 5] = torque
        return effect.deviation(b, replace(s, wrench=wrench)).dq

    crossing = 0.01 * cell.arm.torque_max
    np.testing.assert_allclose(at(30 * crossing), np.tile(b, (9, 1)), rtol=1e-14)
    np.testing.assert_allclose(at(-30 * crossing), np.tile(-b, (9, 1)), rtol=1e-14)
    np.testing.assert_array_equal(at(0 * crossing), np.zeros((9, 6)))
    e = np.exp(2.0)
    np.testing.assert_allclose(at(crossing), np.tile(b * (e - 1) / (e + 1), (9, 1)), rtol=1e-13)


@pytest.mark.parametrize("form", ["common", "each"])
def test_joints_creep_by_the_decade_as_they_are_compliant(form):
    cell = CELLS["ur10e"]
    states = replace(some_states(cell), load_time=np.array([0.0, 9, 99, 999, 0, 9, 99, 999, 0]))
    model = soft(cell, states, "creep", {"form": form})
    c = SOFT * np.arange(1.0, 7.0)
    k = np.array([0.03]) if form == "common" else 0.01 * np.arange(1.0, 7.0)
    found = model.predict(states, np.concatenate([c, k]))
    decades = np.array([0.0, 1, 2, 3, 0, 1, 2, 3, 0])[:, None]
    expected = c * found.situation.torque * (1 + k * decades)
    # The torques are those of the last step, which moved the flange by 1e-13 m.
    np.testing.assert_allclose(found.deviation.dq, expected, rtol=0, atol=1e-12)


def test_creep_without_a_compliance_in_the_model_takes_a_typical_one():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    alone = Model(cell, (make("creep", cell, states),)).predict(states, np.array([0.1]))
    typical = 2e-3 / cell.arm.torque_max
    decades = np.log10(1 + states.load_time)[:, None]
    expected = 0.1 * decades * typical * alone.situation.torque
    np.testing.assert_allclose(alone.deviation.dq, expected, rtol=0, atol=1e-12)


# --- temperature, instrument ----------------------------------------------------------------


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("source", ["air", "joints"])
def test_growth_is_the_same_as_longer_links(arm, source):
    cell = CELLS[arm]
    states = some_states(cell)
    options = {"temperature": source, "reference_degC": 18.0}
    model = Model(cell, (make("thermal_growth", cell, states, options),))
    seen = model.predict(states, np.array([23e-6])).situation.chain
    warm = states.air_temperature if source == "air" else states.joint_temperature.mean(axis=1)
    for i in range(len(states)):
        links = cell.arm.links.copy()
        links[:, :3, 3] *= 1 + 23e-6 * (warm[i] - 18.0)
        longer = chains.evaluate(replace(cell.arm, links=links), states.q[i : i + 1])
        np.testing.assert_allclose(
            seen.position[:, i], longer.position[:, 0], rtol=0, atol=1e-14 * cell.arm.reach
        )


def test_links_that_grow_each_by_their_own_grow_together():
    cell = CELLS["odd"]
    states = some_states(cell)
    one = Model(cell, (make("thermal_growth", cell, states),))
    each = Model(cell, (make("thermal_growth", cell, states, {"links": "each"}),))
    a, b = position(one, states, np.array([1e-5])), position(each, states, np.full(8, 1e-5))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-15)
    assert [p.name for p in each.effects[0].parameters] == [f"link{k}" for k in range(8)]


def test_a_tracker_with_a_scale_error_reads_all_ranges_so_much_longer():
    cell = CELLS["odd"]
    states = some_states(cell)
    model = Model(cell, (make("tracker_scale", cell, states),))
    true = model.predict(states, np.zeros(1)).observation
    long = model.predict(states, np.array([3e-3])).observation
    np.testing.assert_allclose(long.position, 1.003 * true.position, rtol=1e-15)
    np.testing.assert_array_equal(long.rotation, true.rotation)
