"""The model's Jacobian with every effect, alone and all together, against differences."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.effects.joint_compliance import JointCompliance
from hilcal.effects.protocol import Effect, Response
from hilcal.model.model import Model
from tests.support.effect_cases import (
    ALL_NAMES,
    CELLS,
    NAMES,
    UR10E,
    VARIANTS,
    effect_class,
    make,
    numeric_slopes,
    options_of,
    random_theta,
    some_states,
)

SHORT = {"transmission_error": {"harmonics": 1}}
STEP = 0.05
DIRECTIONS = 6


def assert_slope(model, states, theta, m, directions=None):
    """The Jacobian is the slope of the prediction: within 1e-6 of its largest element.

    Along each parameter, or along the rows of directions, both in units of the parameters' scales.
    """
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    if directions is None:
        directions = np.eye(model.size)
    else:
        names = [str(row) for row in range(len(directions))]
    prediction = model.predict(states, theta)
    derived = model.jacobian(prediction, theta, m) @ (scale * directions).T
    # Backlash bends within a fraction of a N·m: differences of two steps, without their h² term.
    near, far = (
        numeric_slopes(model, states, theta, h * scale * directions, m) / h
        for h in (STEP, 2 * STEP)
    )
    numeric = (4 * near - far) / 3
    size = np.abs(numeric).max(axis=(0, 1))
    off = np.abs(derived - numeric).max(axis=(0, 1))
    # Beside it the equilibrium's own tolerance and the rounding of readings of some metres.
    limit = 1e-6 * size + 2e-12 / STEP
    assert {n: (o, b) for n, o, b in zip(names, off, limit, strict=True) if o > b} == {}


@pytest.mark.parametrize(
    ("arm", "m", "elastic"),
    [("ur10e", 6, 1.0), ("ur10e", 3, 5.0), ("odd", 3, 1.0), ("rails", 6, 1.0)],
)
def test_model_jacobian_is_the_derivative_of_the_prediction(arm, m, elastic):
    """All effects at once, also where joints are five times as soft as usual.

    Along directions in which every parameter moves what is read by as much as any other: an error
    of one column stands out in all of them. Each effect has its own test, parameter by parameter.
    """
    cell = CELLS[arm]
    states = some_states(cell, 4)
    names = ALL_NAMES if arm == "rails" else NAMES
    model = Model(cell, tuple(make(n, cell, states, SHORT.get(n, options_of(n, m))) for n in names))
    rng = np.random.default_rng(4)
    theta = random_theta(model.effects, rng, elastic)
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    jacobian = model.jacobian(model.predict(states, theta), theta, m)
    size = np.abs(jacobian * scale).max(axis=(0, 1))
    even = np.divide(size.max(initial=0), size, out=np.ones_like(size), where=size > 0)
    even = np.minimum(even, 10.0)  # the curvature of a parameter must not show
    signs = rng.choice([-1.0, 1.0], (DIRECTIONS, model.size))
    assert_slope(model, states, theta, m, signs * even / np.sqrt(model.size))


USUAL = tuple((name, SHORT.get(name, options_of(name))) for name in ALL_NAMES)


@pytest.mark.parametrize(("name", "options"), USUAL + VARIANTS)
@pytest.mark.parametrize("arm", ["odd", pytest.param("rails", marks=pytest.mark.long)])
def test_each_effect_with_compliant_joints(name, options, arm):
    cell = CELLS[arm]
    if not effect_class(name).applies(cell):
        pytest.skip("of arms with slides")
    states = some_states(cell, 4)
    joints = () if name == "joint_compliance" else (make("joint_compliance", cell, states),)
    model = Model(cell, (*joints, make(name, cell, states, options)))
    theta = random_theta(model.effects, np.random.default_rng(6), 3.0)
    effect = model.effects[-1]
    directions = np.eye(model.size)[-len(effect.parameters) :]
    yields = type(effect).response is not Effect.response  # and so moves what the joints do
    assert_slope(model, states, theta, 3, None if yields else directions)


class Coupled(JointCompliance):
    """dq_j = c_j τ_{j+1}: each joint yields to the torque of the next; the first to the last's."""

    name = "coupled"
    local_response = False

    def columns(self, s):
        return (self.joint_columns("dq", np.roll(s.torque, -1, axis=1)),)

    def response(self, theta, s, change):
        assert change.shape[0] == len(s.states)
        return Response(dq=np.roll(change[:, :, :-1, 5], -1, axis=2) * theta)


def test_a_law_that_joins_the_wrench_of_one_slot_to_the_deviation_of_another():
    cell = CELLS["odd"]
    states = some_states(cell, 4)
    tilt = make("joint_tilt_compliance", cell, states)
    model = Model(cell, (Coupled(cell, states), tilt, make("encoder_offset", cell, states)))
    theta = random_theta(model.effects, np.random.default_rng(5), 3.0)
    assert_slope(model, states, theta, 3)


def test_a_state_that_yields_much_among_many_that_do_not():
    """The terms of the series are counted for all states of a chunk together."""
    states = some_states(UR10E, 40)
    wrench = 1e-3 * states.wrench
    wrench[7] = [200.0, -150.0, 180.0, 20.0, 10.0, -15.0]
    states = replace(states, wrench=wrench)
    model = Model(UR10E, tuple(make(n, UR10E, states) for n in ("joint_compliance", "link_mass")))
    assert_slope(model, states, random_theta(model.effects, np.random.default_rng(3), 2.0), 3)


def test_jacobian_of_some_parameters_is_a_part_of_that_of_all():
    cell = CELLS["odd"]
    states = some_states(cell, 4)
    model = Model(cell, tuple(make(n, cell, states, SHORT.get(n, options_of(n))) for n in NAMES))
    theta = random_theta(model.effects, np.random.default_rng(9))
    prediction = model.predict(states, theta)
    whole = model.jacobian(prediction, theta, 6)
    live = np.sort(np.random.default_rng(9).permutation(model.size)[: model.size // 2])
    np.testing.assert_array_equal(model.jacobian(prediction, theta, 6, live), whole[:, :, live])


def test_an_effect_of_many_parameters_moves_the_readings_as_one_of_few():
    """80 amplitudes of a joint are written at once, those of few harmonics one by one."""
    cell = CELLS["odd"]
    states = some_states(cell, 4)
    many, few = (make("transmission_error", cell, states, {"harmonics": k}) for k in (40, 3))
    model = Model(cell, (make("joint_compliance", cell, states),))
    theta = random_theta(model.effects, np.random.default_rng(2))
    at = model.predict(states, theta)
    names = [p.name for p in many.parameters]
    kept = [names.index(p.name) for p in few.parameters]
    scale = np.random.default_rng(3).uniform(0.5, 2.0, len(names))
    jacobian = model.jacobian_of((many,), at, theta, 6, scale=scale)
    expected = model.jacobian_of((few,), at, theta, 6) * scale[kept]
    np.testing.assert_allclose(jacobian[:, :, kept], expected, rtol=1e-12, atol=1e-14)
    some = np.arange(30, len(names) - 7)
    part = model.jacobian_of((many,), at, theta, 6, some, scale)
    np.testing.assert_allclose(part, jacobian[:, :, some], rtol=1e-12, atol=1e-14)


def test_jacobian_of_an_effect_that_is_not_in_the_model_is_that_at_zero():
    states = some_states(UR10E)
    model = Model(UR10E, (make("joint_compliance", UR10E, states),))
    theta = random_theta(model.effects, np.random.default_rng(0))
    prediction = model.predict(states, theta)
    for name in NAMES[1:]:
        if name in model.names:
            continue
        effect = make(name, UR10E, states, options_of(name))
        outside = model.jacobian_of((effect,), prediction, theta, 3)
        larger = model + effect
        full = np.concatenate([theta, np.zeros(len(effect.parameters))])
        inside = larger.jacobian(larger.predict(states, full), full, 3)[:, :, len(theta) :]
        # The two equilibria may differ by their tolerance of 1e-13 m.
        np.testing.assert_allclose(outside, inside, rtol=1e-11, atol=1e-11, err_msg=name)
