"""Laws of effects against small formulas and limiting cases that share nothing with them."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.drivers.simulated import truth
from hilcal.effects.link_compliance import long_links
from hilcal.model.model import Model
from hilcal.robot import chain as chains
from hilcal.robot.catalogue import robot_names
from tests.support.arm_cases import arm_of
from tests.support.effect_cases import CELLS, SOFT, make, position, situation, soft, some_states

# --- elastic --------------------------------------------------------------------------------


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
