"""Effects that act through the load, against models of the load that they make."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.errors import CannotAnswerError
from hilcal.model.model import Model
from hilcal.types import Floats
from tests.support.effect_cases import CELLS, TURN, joints, make, position, soft, some_states


def acting(wrench: Floats, flange: Floats, name: str, theta: Floats, turn: Floats) -> Floats:
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
    found = model.predict(states, np.concatenate([joints(cell), theta]))
    turn = np.array(options.get("rotvec_rad", [0.0, 0.0, 0.0]))
    other = acting(states.wrench, found.situation.chain.rotation[-1], name, theta, turn)
    plain = Model(cell, model.effects[:1])
    expected = plain.predict(replace(states, wrench=other), joints(cell))
    np.testing.assert_allclose(
        found.observation.position, expected.observation.position, rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(found.situation.load.wrench, other, rtol=0, atol=1e-10)
    believed = plain.predict(states, joints(cell)).observation.position
    away = np.linalg.norm(found.observation.position - believed, axis=1)
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
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = soft(cell, states, "wrench_gain")
    with pytest.raises(CannotAnswerError, match=r"wrench_gain: a gain error of -120 %") as caught:
        position(model, states, joints(cell), np.array([0, 0, -1.2, 0, 0, 0]))
    assert "\n" not in str(caught.value)


def test_changes_of_the_load_add():
    """Load point, weights and sensor together are the load that they make together."""
    cell = CELLS["odd"]
    states = some_states(cell)
    names = ("joint_compliance", "load_point", "link_mass", "wrench_bias", "wrench_gain")
    model = Model(cell, tuple(make(n, cell, states) for n in names))
    rng = np.random.default_rng(3)
    shift, moments = rng.normal(size=3) * 0.02, rng.normal(size=(7, 3)) * 0.05
    bias, gain = ERRORS["wrench_bias"], ERRORS["wrench_gain"]
    theta = np.concatenate([joints(cell), shift, moments.ravel(), bias, gain])
    found = model.predict(states, theta)
    flange = found.situation.chain.rotation[-1]
    no_turn = np.zeros(3)
    parts = [
        acting(states.wrench, flange, name, ERRORS[name], no_turn) - states.wrench
        for name in names[3:]
    ]
    other = replace(
        cell,
        load_point=cell.load_point + shift,
        arm=replace(cell.arm, coms=cell.arm.coms + moments / cell.arm.masses[:, None]),
    )
    plain = Model(other, (make("joint_compliance", other, states),))
    expected = position(plain, replace(states, wrench=states.wrench + sum(parts)), joints(cell))
    np.testing.assert_allclose(found.observation.position, expected, rtol=0, atol=1e-12)
