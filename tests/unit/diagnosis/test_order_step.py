"""A step in the order of the readings is named with its row, and nothing else is taken for one."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis import verdict
from hilcal.diagnosis.order_step import OrderStep, step_in_order
from hilcal.diagnosis.verdict import diagnose, with_order_step
from hilcal.identification.baseline import baseline
from hilcal.present.verdict import headline, message
from hilcal.refinement import refine
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration
from tests.support.fit_cases import fitted_model
from tests.support.rows import first

C = campaign(mode="absolute", plan_seed=0, poses=12)
FIRST = 17


def moved(what, size):
    """Readings of which those from `FIRST` on are shifted in the sensor's or the target's axes."""
    r, shift = C.readings, np.array([size, 0.0, 0.0])
    if what == "target":
        model = baseline(C.cell, r, "absolute")
        axes = model.predict(r.states, np.zeros(model.size)).observation.rotation
        shift = (axes @ shift)[FIRST:]
    value = r.value.copy()
    value[FIRST:, :3] += shift
    return replace(r, value=value)


@pytest.mark.parametrize("what", ["sensor", "target"])
@pytest.mark.parametrize("size", first(1, [3e-4, 5e-3]))
def test_what_moved_in_the_middle_is_named_with_its_row(what, size):
    step = step_in_order(fitted_model(C.cell, moved(what, size), "absolute"))
    assert step.previous < FIRST <= step.first  # some between them may be set aside
    assert step.moved[0] == what
    assert step.shift_m == pytest.approx(size, rel=0.3)


@pytest.mark.long
@pytest.mark.parametrize("what", ["sensor", "target"])
def test_the_verdict_names_the_step(what):
    readings = moved(what, 5e-3)
    start = baseline(C.cell, readings, "absolute")
    d = refine(start, readings, "absolute", background=False).diagnosis
    assert d.verdict == "unknown_effect"
    assert headline(d) == "unknown effect: a step in the order of the readings"
    assert d.to_dict()["step"]["moved"][0] == what
    assert "was moved" in message(d)


def test_a_diagnosis_alone_names_the_step_where_a_drift_passes():
    d = diagnose(fitted_model(C.cell, moved("sensor", 3e-4), "absolute"))
    assert d.verdict == "unknown_effect"
    assert d.step.moved[0] == "sensor"
    assert d.step.previous < FIRST <= d.step.first


@pytest.mark.long
@pytest.mark.parametrize("joint", [2, 3])
def test_a_joint_that_slipped_is_named_with_its_row(joint):
    r, model = C.readings, baseline(C.cell, C.readings, "absolute")
    q = r.states.q.copy()
    q[FIRST:, joint - 1] += 3e-4
    at = np.zeros(model.size)
    truth, stated = (model.predict(s, at).observation.position for s in (with_q(q), r.states))
    value = r.value.copy()
    value[:, :3] += truth - stated
    start = fitted_model(C.cell, replace(r, value=value), "absolute")
    d = with_order_step(replace(diagnose(start), reason="no_suspect", suspects=(), step=None))
    assert d.step.moved == (f"joint {joint}",)
    assert d.step.previous < FIRST <= d.step.first
    assert f"joint {joint} slipped or lost its zero" in message(d)
    assert "two campaigns" in message(d)


def with_q(q):
    return replace(C.readings.states, q=q)


def test_readings_without_a_step_show_none():
    assert step_in_order(fitted_model(C.cell, C.readings, "absolute")) is None


@pytest.mark.parametrize("settling", first(1, [None, 0.3, 0.12]))
def test_a_drift_is_no_step(settling):
    value = C.readings.value.copy()
    time = np.linspace(0.0, 1.0, len(value))
    value[:, 0] += 1e-3 * (time if settling is None else 1.0 - np.exp(-time / settling))
    drifting = replace(C.readings, value=value)
    assert step_in_order(fitted_model(C.cell, drifting, "absolute")) is None


@pytest.mark.long
def test_a_step_that_explains_less_than_the_state_is_not_named(monkeypatch):
    """A few readings at the beginning may be shifted by chance, where a law is missing."""
    c = campaign(plan_seed=0, poses=30, registration_known=True)
    r, value = c.readings, c.readings.value.copy()
    value[:, 1] += 3e-4 * np.maximum(np.sin(r.states.q[:, 1]), 0.0)
    d = replace(diagnose(fitted_model(c.cell, replace(r, value=value), "absolute")), step=None)
    assert d.reason == "no_suspect"
    for share, named in ((0.1, False), (1.0, True)):
        step = OrderStep(("sensor",), FIRST, FIRST - 1, 1e-5, 1e-3, share)
        monkeypatch.setattr(verdict, "step_in_order", lambda fit, step=step: step)
        assert (with_order_step(d).step is not None) == named


@pytest.mark.long
def test_few_readings_of_an_arm_with_gears_show_no_step():
    """It took up what few readings attribute to effects."""
    hidden = ("link_geometry", "transmission_error")
    c = study_case(configuration(), "ur10e", "absolute", hidden, 15.0, 10, n_poses=12)
    readings = c.readings[np.isin(c.readings.load, (0, 2))]
    d = refine(baseline(c.cell, readings, "absolute"), readings, "absolute").diagnosis
    assert d.step is None
    assert d.reason == "background"
