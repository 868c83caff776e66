"""Every effect: its law, its derivatives, its options; against mechanics of their own."""

from dataclasses import replace

import numpy as np
import pytest
from arm_cases import slope
from campaigns import campaign, plan
from effect_cases import (
    CELLS,
    ELASTIC,
    FIELDS,
    NAMES,
    options_of,
    random_theta,
    situation,
    some_states,
)

from hilcal.data.readings import Readings
from hilcal.effects.catalogue import catalogue, effect_class, make
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation
from hilcal.errors import InputError
from hilcal.identify.fit import fit
from hilcal.model import Model
from hilcal.robot.statics import Load, slot_wrenches

# --- derivatives ----------------------------------------------------------------------------


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("name", NAMES)
def test_columns_are_the_derivative_of_the_deviation(name, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options_of(name, 6))
    theta = random_theta((effect,), np.random.default_rng(0))
    derived = {field: 0.0 for field in FIELDS}
    size = len(effect.parameters)
    count, n = s.angle.shape
    for c in effect.columns(s):
        values = np.broadcast_to(c.values, (count, *c.values.shape[1:]))
        for k, (parameter, element) in enumerate(zip(c.parameter, c.element, strict=True)):
            if c.field in ("dq", "twist"):
                shape = (count, n) if c.field == "dq" else (count, n + 1, 6)
                block = np.zeros((size, *shape))
                block[parameter, :, element] += values[:, k]
            else:
                block = np.zeros((size, *values[:, k].shape))
                block[parameter] += values[:, k]
            derived[c.field] = derived[c.field] + block
    for p in range(size):
        scale = effect.parameters[p].scale

        def moved(h, p=p, scale=scale):
            return effect.deviation(theta + h * scale * np.eye(size)[p], s)

        for field in FIELDS:
            if getattr(moved(0.0), field) is None:
                assert np.ndim(derived[field]) == 0, field
                continue
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), 1.0)
            # The deviation is linear, so only rounding of it is left.
            size_of_it = np.abs(getattr(moved(0.0), field)).max() + np.abs(numeric).max()
            np.testing.assert_allclose(
                derived[field][p] * scale, numeric, rtol=0, atol=1e-14 * size_of_it + 1e-30
            )


@pytest.mark.parametrize("arm", CELLS)
@pytest.mark.parametrize("name", ELASTIC)
def test_response_is_the_derivative_by_the_slot_wrenches(name, arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make(name, cell, s.states, options_of(name))
    rng = np.random.default_rng(3)
    theta = random_theta((effect,), rng)
    change = rng.normal(size=(len(s.states), 4, *s.wrench.shape[1:]))
    response = effect.response(theta, s, change)
    for p in range(4):

        def moved(h, p=p):
            return effect.deviation(theta, replace(s, wrench=s.wrench + h * change[:, p]))

        for field in ("dq", "twist"):
            derived = getattr(response, field)
            if getattr(moved(0.0), field) is None:
                assert derived is None
                continue
            numeric = slope(lambda h, f=field, g=moved: getattr(g(h), f), 1.0)
            size = np.abs(getattr(moved(0.0), field)).max()
            # Laws are polynomials of degree 3, so a difference of fourth order is exact.
            np.testing.assert_allclose(derived[:, p], numeric, rtol=0, atol=1e-13 * size)


@pytest.mark.parametrize("arm", CELLS)
def test_wrench_columns_of_load_point_are_the_derivative_of_the_slot_wrenches(arm):
    cell = CELLS[arm]
    s = situation(cell)
    effect = make("load_point", cell, s.states)
    derived = effect.wrench_columns(s)
    for p in range(3):

        def wrench(h, p=p):
            point = cell.load_point + effect.load_change(h * np.eye(3)[p]).point
            load = Load(s.states.wrench, point, cell.tool_mass, cell.tool_com, cell.gravity)
            return slot_wrenches(cell.arm, s.chain, load)

        numeric = slope(wrench, 1e-2)
        size = np.abs(wrench(0.0)).max() / 1e-2
        np.testing.assert_allclose(derived[:, p], numeric, rtol=0, atol=1e-13 * size)


def numeric_jacobian(model, states, theta, scale, m):
    """Central differences of the readings; rotations as small rotations."""
    base = model.predict(states, theta).observation.rotation
    out = np.empty((len(states), m, len(theta)))
    for p in range(len(theta)):

        def moved(h, p=p):
            o = model.predict(states, theta + h * scale[p] * np.eye(len(theta))[p]).observation
            turn = o.rotation @ np.swapaxes(base, 1, 2)
            skew = 0.5 * (turn - np.swapaxes(turn, 1, 2))
            w = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
            return np.concatenate([o.position, w], axis=1)[:, :m]

        out[:, :, p] = (moved(1.0) - moved(-1.0)) / 2
    return out


def give(model: Model, prediction, theta) -> float:
    """By how much more a unit motion of the arm deflects it: Σ compliance · (f·reach + m).

    What an analytic derivative at fixed wrenches leaves out is a motion's own change of the
    wrenches, so it is this share of the motion, at most.
    """
    s = prediction.situation
    reach = model.cell.arm.reach + np.linalg.norm(model.cell.load_point)
    force = np.linalg.norm(s.wrench[:, :, :3], axis=2).max()
    moment = np.linalg.norm(s.wrench[:, :, 3:], axis=2).max()
    total = 0.0
    for effect, rows in zip(model.effects, model.slices(), strict=True):
        slope = 3 * s.torque.max(axis=0) ** 2 if effect.name == "joint_stiffening" else 1.0
        total += float(np.abs(slope * theta[rows]).sum()) if effect.elastic else 0.0
    return total * (force * reach + moment)


@pytest.mark.parametrize(
    ("arm", "m", "elastic"), [("ur10e", 6, 1.0), ("ur10e", 6, 1e-3), ("odd", 3, 1e-3)]
)
def test_model_jacobian_is_the_derivative_of_the_prediction(arm, m, elastic):
    """All effects at once; what the derivative leaves out is of the order of the deflection."""
    cell = CELLS[arm]
    states = some_states(cell, 4)
    short = {"transmission_error": {"harmonics": 1}}
    model = Model(cell, tuple(make(n, cell, states, short.get(n, options_of(n, m))) for n in NAMES))
    scale = np.array([p.scale for e in model.effects for p in e.parameters])
    theta = random_theta(model.effects, np.random.default_rng(4), elastic)
    prediction = model.predict(states, theta)
    derived = model.jacobian(prediction, theta, m) * scale
    numeric = numeric_jacobian(model, states, theta, scale, m)
    size = np.abs(numeric).max(axis=(0, 1))
    off = np.abs(derived - numeric).max(axis=(0, 1))
    # Beside it the equilibrium's own tolerance, the rounding of readings of some metres, and
    # what a central difference over a milliradian leaves out (h²/6 of the motion).
    slack = 2e-12 + 1e-6 * size
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    limit = give(model, prediction, theta) * size + slack
    assert {n: (o, b) for n, o, b in zip(names, off, limit, strict=True) if o > b} == {}


def test_jacobian_of_an_effect_that_is_not_in_the_model_is_that_at_zero():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = Model(cell, (make("joint_compliance", cell, states),))
    theta = random_theta(model.effects, np.random.default_rng(0))
    prediction = model.predict(states, theta)
    for name in NAMES[1:]:
        if name in model.names:
            continue
        effect = make(name, cell, states, options_of(name))
        outside = model.jacobian_of((effect,), prediction, theta, 3)
        larger = model + effect
        full = np.concatenate([theta, np.zeros(len(effect.parameters))])
        inside = larger.jacobian(larger.predict(states, full), full, 3)[:, :, len(theta) :]
        # The two equilibria may differ by their tolerance of 1e-13 m.
        np.testing.assert_allclose(outside, inside, rtol=1e-11, atol=1e-11, err_msg=name)


# --- what is refused ------------------------------------------------------------------------


def test_an_unknown_effect_is_refused_with_the_valid_names():
    with pytest.raises(InputError, match="unknown effect 'joint_complience'") as caught:
        effect_class("joint_complience")
    assert all(name in str(caught.value) for name in NAMES)
    assert "joint_compliance" in str(caught.value).split("valid")[0]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_option_is_refused_with_the_valid_ones(name):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=f"{name}: unknown option 'colour'") as caught:
        make(name, cell, some_states(cell), {"colour": 1})
    valid = effect_class(name).option_names or ("none",)
    assert all(option in str(caught.value) for option in valid)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("transmission_error", {"harmonics": 0}, "harmonics = 0; valid: 1 to 1000"),
        ("transmission_error", {"harmonics": 2.5}, "harmonics = 2.5"),
        ("transmission_error", {"harmonics": True}, "harmonics = True"),
        ("target_offset", {"rotation": "yes"}, "rotation = 'yes'; valid: true, false"),
        ("tracker_drift", {"reference_s": "noon"}, "reference_s = 'noon'; valid: a finite number"),
        ("tracker_drift", {"reference_s": float("nan")}, "reference_s = nan"),
        ("tracker_drift", {"span_s": 0.0}, "span_s"),
        ("base_frame", {"prior_m": 1.0}, "prior_m alone"),
        ("base_frame", {"prior_m": 1.0, "prior_rad": -1.0}, "must be positive"),
        ("base_frame", {"prior_m": "wide", "prior_rad": 1.0}, "prior_m = 'wide'"),
    ],
)
def test_an_impossible_option_is_refused(name, options, message):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=message):
        make(name, cell, some_states(cell), options).prior_std()


@pytest.mark.parametrize(
    ("name", "column"), [("hysteresis", "approach"), ("tracker_drift", "time")]
)
def test_a_missing_column_is_named(name, column):
    cell = CELLS["ur10e"]
    states = replace(some_states(cell), **{column: None})
    assert not effect_class(name).computable(states)
    with pytest.raises(InputError, match=f"{name} needs {column}"):
        make(name, cell, states)


def test_the_same_effect_twice_is_refused():
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = Model(cell, (make("hysteresis", cell, states),))
    with pytest.raises(InputError, match="hysteresis is in the model already"):
        model + make("hysteresis", cell, states)


def test_the_catalogue_has_all_effects_of_the_vocabulary():
    assert set(NAMES) <= set(catalogue())
    for name, kind in catalogue().items():
        assert kind.name == name
        assert kind.summary


# --- a user's own ---------------------------------------------------------------------------


class ForearmGrowth(Effect):
    """The forearm grows along its own axis in time: a twist of slot 2 along x, m/s."""

    name = "forearm_growth"
    summary = "the forearm grows in time"
    needs = ("time",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return (Parameter("rate", "m/s", 1e-8),)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        values = s.states.time[:, None, None] * np.eye(6)[:1]
        return (Columns("twist", np.array([0]), np.array([2]), values),)


def test_a_users_effect_takes_part_unchanged():
    c = campaign(plan_seed=0, registration_known=True)
    p = plan()
    grown = make("joint_compliance", c.cell, p.states), ForearmGrowth(c.cell, p.states)
    model = Model(c.cell, grown)
    truth = np.append(c.world.physics.joint_compliance, 4e-7)
    prediction = model.predict(p.states, truth)
    numeric = numeric_jacobian(model, p.states, truth, np.array([1e-5] * 6 + [1e-7]), 3)[:, :, 6]
    derived = 1e-7 * model.jacobian(prediction, truth, 3)[:, :, 6]
    size = np.abs(numeric).max()
    np.testing.assert_allclose(
        derived, numeric, rtol=0, atol=give(model, prediction, truth) * size + 1e-12
    )
    clean: Readings = replace(c.readings, value=prediction.observation.position)
    found = fit(model, clean, "absolute")
    np.testing.assert_allclose(found.theta, truth, rtol=1e-8)
