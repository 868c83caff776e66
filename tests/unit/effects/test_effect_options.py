"""What is refused of effects and their options, in one line; and what options choose."""

import re
from dataclasses import replace

import numpy as np
import pytest

from hilcal.errors import InputError
from hilcal.model.model import Model
from tests.support.effect_cases import (
    CELLS,
    NAMES,
    effect_class,
    make,
    options_of,
    random_theta,
    situation,
    some_states,
)


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_option_is_refused_with_the_valid_ones(name):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=f"{name}: unknown option 'colour'") as caught:
        make(name, cell, some_states(cell), {"colour": 1})
    valid = effect_class(name).option_help or ("none",)
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
        ("periodic_joint_compliance", {"orders": 2}, "orders = 2; valid: a list of different"),
        ("periodic_joint_compliance", {"orders": []}, "orders = []"),
        ("periodic_joint_compliance", {"orders": [2, 2]}, "orders = [2, 2]"),
        ("periodic_joint_compliance", {"orders": [0]}, "orders = [0]"),
        ("periodic_joint_compliance", {"orders": [True]}, "orders = [True]"),
        ("backlash", {"crossing": 0}, "crossing = 0; valid: more than 0"),
        ("creep", {"form": "joint"}, "form = 'joint'; valid: common, each"),
        ("creep", {"joints": "joint"}, "joints = 'joint', 'joint' is no joint and no range; valid"),
        ("hysteresis", {"joints": "5-7"}, "joints = '5-7', there is no joint 7; valid: each"),
        ("transmission_error", {"joints": 2.5}, "joints = 2.5; valid: each, common, or joints 1"),
        ("thermal_growth", {"links": 3}, "links = 3; valid: common, each"),
        ("thermal_growth", {"temperature": "oil"}, "temperature = 'oil'; valid: air, joints"),
        ("thermal_growth", {"reference_degC": None}, "reference_degC = None"),
        ("thermal_joint_drift", {"reference_degC": [20.0]}, "has 1 values; valid: 1 or 6"),
        ("thermal_joint_drift", {"reference_degC": ["a"] * 6}, "reference_degC = 'a'"),
        ("wrench_bias", {"rotvec_rad": [0.0, 1.0]}, "rotvec_rad has 2 values; valid: 1 or 3"),
        ("wrench_gain", {"rotvec_rad": "z"}, "rotvec_rad = 'z'; valid: a finite number"),
        ("sensor_misalignment", {"rotvec_rad": [0, 0, 1e999]}, "rotvec_rad = inf"),
    ],
)
def test_an_impossible_option_is_refused(name, options, message):
    cell = CELLS["ur10e"]
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        make(name, cell, some_states(cell), options).prior_std()
    assert f"effect {name}: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "column"),
    [
        ("hysteresis", "approach"),
        ("tracker_drift", "time"),
        ("creep", "load_time"),
        ("thermal_joint_drift", "joint_temperature"),
    ],
)
def test_a_missing_column_is_named(name, column):
    cell = CELLS["ur10e"]
    states = replace(some_states(cell), **{column: None})
    assert not effect_class(name).computable(states)
    with pytest.raises(InputError, match=f"{name} needs {column}"):
        make(name, cell, states)


# --- temperatures ---------------------------------------------------------------------------


def test_growth_needs_one_of_two_temperatures():
    cell, kind = CELLS["ur10e"], effect_class("thermal_growth")
    both = some_states(cell)
    air, joints = replace(both, joint_temperature=None), replace(both, air_temperature=None)
    neither = replace(air, air_temperature=None)
    assert [kind.computable(s) for s in (both, air, joints, neither)] == [True, True, True, False]
    chosen = [make("thermal_growth", cell, s).options["temperature"] for s in (both, air, joints)]
    assert chosen == ["air", "air", "joints"]
    with pytest.raises(InputError, match="needs air_temperature or joint_temperature, which the"):
        make("thermal_growth", cell, neither)
    with pytest.raises(InputError, match="'air', which the readings do not have; valid: joints"):
        make("thermal_growth", cell, joints, {"temperature": "air"})
    with pytest.raises(InputError, match="'joints', which the readings do not have; valid: air"):
        make("thermal_growth", cell, air, {"temperature": "joints"})


def test_a_thermometer_once_chosen_is_kept():
    """What a fit read from the air is not compared with joints when it predicts others."""
    cell = CELLS["ur10e"]
    both = some_states(cell)
    fitted = make("thermal_growth", cell, both)
    again = make("thermal_growth", cell, both[:3], fitted.options)
    assert again.options == fitted.options == {
        "reference_degC": 20.0, "temperature": "air", "links": "common",
    }  # fmt: skip
    with pytest.raises(InputError, match="temperature = 'air', which the readings do not have"):
        Model(cell, (fitted,)).predict(replace(both, air_temperature=None), np.zeros(1))
    with pytest.raises(InputError, match="temperature = 'air'"):
        make("thermal_growth", cell, replace(both, air_temperature=None), fitted.options)


def test_joints_drift_from_where_they_were_at_first():
    cell = CELLS["ur10e"]
    s = situation(cell)
    order = np.random.default_rng(0).permutation(len(s.states))
    shuffled = s.states[order]
    first = s.states.joint_temperature[np.argmin(s.states.time)]
    kappa = 1e-6 * np.arange(1.0, 7.0)
    for options, reference in (({}, first), ({"reference_degC": 25}, np.full(6, 25.0))):
        effect = make("thermal_joint_drift", cell, shuffled, options)
        found = effect.deviation(kappa, replace(s, states=shuffled)).dq
        expected = kappa * (shuffled.joint_temperature - reference)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-18)
        kept = make("thermal_joint_drift", cell, s.states[5:], effect.options)
        np.testing.assert_allclose(kept.reference, reference, rtol=0, atol=0)
    untimed = replace(shuffled, time=None)
    effect = make("thermal_joint_drift", cell, untimed)
    np.testing.assert_array_equal(effect.reference, shuffled.joint_temperature[0])


@pytest.mark.parametrize("name", NAMES)
def test_an_effect_is_made_again_from_its_options(name):
    """As a revision keeps them: a fit and its copy have the same parameters and predictions."""
    cell = CELLS["ur10e"]
    states = some_states(cell)
    model = Model(cell, (make(name, cell, states, options_of(name)),))
    again = Model(cell, (make(name, cell, states[2:7], model.effects[0].options),))
    assert again.effects[0].parameters == model.effects[0].parameters
    theta = random_theta(model.effects, np.random.default_rng(0))
    a, b = model.predict(states[2:7], theta), again.predict(states[2:7], theta)
    np.testing.assert_array_equal(a.observation.position, b.observation.position)
