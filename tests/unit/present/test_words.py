"""Numbers, fits, misfits and diagnoses as people read them, written in one way everywhere."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal import numbers
from hilcal.diagnosis.effect_ranking import FALSE_ALARM
from hilcal.diagnosis.misfit_breakdown import MisfitShare, misfit_breakdown
from hilcal.diagnosis.recorded import ROW_ORDER
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.options import typical_compliances
from hilcal.identification.background import with_background
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.linearisation import linearise
from hilcal.identification.prediction.full_prediction import full_prediction, nominal_error
from hilcal.identification.registration.robot_frames import robot_frames
from hilcal.model.model import Model
from hilcal.present.diagnosis import (
    change_sentence,
    curves,
    diagnosis_report,
    suspects_table,
)
from hilcal.present.fit import (
    before_and_after,
    dependence_sentence,
    errors,
    fit_report,
    gross_error_lines,
    where_table,
    worst_poses,
)
from hilcal.present.registration import base_line
from hilcal.present.story import Chapter, build_story
from hilcal.present.verdict import message
from hilcal.present.viewer import campaign as viewer
from hilcal.robot import se3
from tests.support.campaigns import campaign, cell_of, noiseless, plan, with_noise, world_of
from tests.support.fit_cases import fitted_model
from tests.support.rows import first


def test_loads_of_which_nothing_is_left_are_told_in_one_sentence():
    c = campaign(poses=6)
    r = c.readings
    names = [n for n in r.load_names if n != "none"][:2]
    lost = np.isin(r.load, [r.load_names.index(n) for n in names])
    fitted = fit(baseline(c.cell, r, "absolute"), r, "absolute", outlier=lost)
    lines = list(gross_error_lines(fitted, details=False))
    (sentence,) = [line for line in lines if "force" in line]
    assert sentence == (
        f"All {lost.sum()} readings under the loads {names[0]} and {names[1]} are set aside: "
        "check their forces."
    )


# numbers


@pytest.mark.parametrize(
    ("metres", "words"),
    [
        (0.0, "0 µm"),
        (28.13e-6, "28.1 µm"),
        (999e-6, "999 µm"),
        (1.04e-3, "1.04 mm"),
        (0.327, "327 mm"),
        (2.5, "2.50 m"),
        (4.59e-16, "< 0.001 µm"),
        (-4.59e-16, "< 0.001 µm"),
        (1.04e-9, "0.00104 µm"),
    ],
)
def test_lengths(metres, words):
    assert numbers.length(metres) == words


@given(st.floats(1e-3, 1e6), st.integers(1, 5))
def test_digits_keep_the_value(value, count):
    rel = 0.5 * 10.0 ** (1 - count)
    assert float(numbers.digits(value, count)) == pytest.approx(value, rel=rel)


@given(st.floats(-1e4, 1e4), st.floats(1e-4, 1e2))
def test_a_value_is_written_to_the_digits_of_its_uncertainty(value, std):
    written, spread = numbers.with_std(value, std)
    # from 9.95 on there are no decimals left to drop
    assert abs(float(written) - value) <= (0.5 if std >= 9.95 else 0.06 * std)
    assert float(spread) == pytest.approx(std, rel=0.06, abs=0.5 if std >= 9.95 else 0)
    assert len(written.partition(".")[2]) == len(spread.partition(".")[2])


@given(st.sampled_from(["m", "rad"]), st.floats(-1, 1), st.floats(0, 1))
def test_no_length_nor_angle_has_an_exponent(unit, value, std):
    assert "e" not in "".join(numbers.measured(unit, value, std)[:2])


def test_what_rounding_leaves_is_no_number():
    assert numbers.measured("m", 3e-4, 4.59e-16) == ("300.0000", "< 0.001", "µm")
    assert numbers.measured("m", 2e-2, 4.59e-16) == ("20.0000000", "< 0.000001", "mm")
    assert numbers.measured("rad", 4.59e-16) == ("< 0.001", "", "µrad")
    assert numbers.measured("m", 0.0, 0.0) == ("0", "", "µm")
    assert numbers.sizes([("m", 4.59e-16), ("rad/K", 4e-9)]) == "< 0.001 µm, 0.0040 µrad/K"
    assert numbers.with_std(1.234, math.inf) == ("1.23", "")


@pytest.mark.parametrize(
    ("unit", "values", "expected"),
    [
        ("m", [2e-6, -5e-4], ("µm", 1e6)),
        ("m", [2e-6, -5e-3], ("mm", 1e3)),
        ("rad/(N·m)", [1e-5], ("µrad/(N·m)", 1e6)),
        ("furlong", [1.0], ("furlong", 1.0)),
        ("m", [], ("µm", 1e6)),
        ("rad/(N·m)³", [2.1e-9], ("nrad/(N·m)³", 1e9)),
        ("rad/(N·m)³", [1.2e-7], ("nrad/(N·m)³", 1e9)),
        ("rad/(N·m)³", [9e-10], ("prad/(N·m)³", 1e12)),
        ("m/N³", [1.7e-12], ("fm/N³", 1e15)),
        ("m/N³", [1.7e-15], ("fm/N³", 1e15)),
    ],
)
def test_units_follow_the_largest_value(unit, values, expected):
    assert numbers.unit_for(unit, values) == expected


def test_lists_and_sentences():
    assert numbers.sentence("residuals are noise") == "Residuals are noise."
    assert numbers.names(["a"]) == "a"
    assert numbers.names(["a", "b", "c"]) == "a, b and c"
    assert numbers.few(["a", "b", "c", "d"]) == "a, b and 2 more"
    assert numbers.few(["a", "b"]) == "a and b"


@pytest.mark.parametrize(
    ("p", "written"),
    [(5e-26, "p < 1e-16"), (0.0, "p < 1e-16"), (3.2e-9, "p = 3e-09"), (0.0123, "p = 0.012")],
)
def test_a_small_p_value_is_written_in_one_way(p, written):
    assert numbers.p_equals(p) == written
    assert numbers.chance(p) == written.removeprefix("p = ").removeprefix("p ")


# fits


@cache
def fitted(mode, effect="transmission_error"):
    c = campaign(effect, mode, 1, poses=12, strength=3.0)
    return fitted_model(c.cell, c.readings, c.mode)


@pytest.fixture(scope="module")
def absolute():
    return fitted("absolute")


@pytest.fixture(scope="module")
def judged(absolute):
    return diagnose(absolute)


@pytest.fixture
def shown(printed):
    return lambda *blocks: " ".join(printed(*blocks).split())


def test_before_a_deflection_is_what_was_measured():
    f = fitted("deflection", "base_compliance")
    measured = np.linalg.norm(f.whitening.raw(f.readings.value[:, :3]), axis=1)
    before = nominal_error(f)
    assert before.rms_m == pytest.approx(float(np.sqrt(np.mean(measured**2))), rel=1e-9)
    assert before.max_m == pytest.approx(float(measured.max()), rel=1e-9)
    said = before_and_after(f)
    assert said.startswith(f"Deflections of {numbers.length(before.rms_m)} rms were measured;")
    assert f"the model leaves {numbers.length(f.error.rms_m)} (noise" in said


def test_before_of_positions_is_the_rigid_arm_in_frames_of_its_own(absolute, shown):
    """Compliances alone are put to zero; they sag by about torque times compliance."""
    before, torque = nominal_error(absolute), absolute.solution.prediction.situation.torque
    turned = torque * typical_compliances(absolute.model.cell)
    assert absolute.error.rms_m < 0.2 * before.rms_m
    assert 0.1 * np.abs(turned).max() < before.rms_m < 3.0 * np.abs(turned).sum(axis=1).max()
    report = shown(*fit_report(absolute))
    assert "The rigid nominal arm with fitted frames is off by" in report
    assert f"before: rigid nominal arm {numbers.length(before.rms_m)}" in shown(errors(absolute))
    assert to_json(absolute)["error"]["before"] == before.to_json()


def test_p_values_and_how_many_were_tested_read_the_same_wherever_they_stand(
    absolute, judged, shown
):
    lead, tests = judged.suspects[0], judged.to_dict()["tests"]
    value, equals = (f(lead.score.p_value) for f in (numbers.chance, numbers.p_equals))
    assert equals in message(judged)
    assert re.search(rf"{lead.effect} .*{re.escape(value)}", shown(suspects_table(judged)))
    assert all(s.score.p_value * judged.tested < FALSE_ALARM for s in judged.suspects if s.passes)
    assert tests["count"] == sum(s.score.rank > 0 for s in judged.suspects)
    assert tests["each"] == pytest.approx(FALSE_ALARM / tests["count"])
    report, tested = shown(*diagnosis_report(judged)), f"{tests['count']} effects were tested"
    assert f"{tested}: one counts from p < " in report
    assert "Effects that pass every test stand first; others by evidence" in report
    assert f"which is 0.001 / {tests['count']}" in report
    kinds = [v for v in judged.misfit_breakdown if v.group not in ("pose", "direction")]
    assert f"{len(kinds)} variables were tested" in report
    story = build_story([Chapter(1, None, absolute, judged)])
    revision = story.revisions[0]
    escaped = value.replace("<", "\\<")
    assert f"| {escaped} |" in viewer.verdict(story, revision)
    assert equals in str(revision.panels["verdict"][0])
    details = viewer.details(story, revision)
    assert tested in details
    worst = worst_poses(full_prediction(absolute))[0]
    assert f"Worst: pose {worst['pose']}, load {worst['load']}," in details


# where the model fails

PLACES = (
    MisfitShare("direction vertical", 0.7, 1e-30),
    MisfitShare("pose", 0.95, 1e-9),
    MisfitShare("time", 0.2, 1e-4),
    MisfitShare("joint 4 angle", 0.4, 1e-12),
    MisfitShare("load", 0.02, 1e-3),
    MisfitShare("joint 1 angle", 0.0, 1e-20),
    MisfitShare("air temperature", 0.004, 0.3),
)


def test_variables_stand_in_groups_and_those_without_a_share_are_counted(shown):
    printed_table = shown(*where_table(PLACES))
    order = ["joint 4 angle", "load", "time", "same in all readings of a pose", "points vertical"]
    places = [printed_table.index(name) for name in order]
    assert places == sorted(places)
    assert "joint 1 angle" not in printed_table
    assert not re.search(r"(?<!\d)0 %", printed_table)
    assert "2 more are below 1 %" in printed_table


@pytest.mark.parametrize(
    ("p", "followed"),
    [(0.003, "none of the recorded variables alone"), (1e-5, "joint 2 torque (23 %)")],
)
def test_the_misfit_follows_what_counts_in_the_table(p, followed, shown):
    """Of twenty variables one has such a p-value by chance."""
    others = [MisfitShare(f"joint {k} angle", 0.02, 0.5) for k in range(1, 20)]
    places = [MisfitShare("joint 2 torque", 0.23, p), *others]
    assert "20 variables were tested: one counts from p < 5e-05" in shown(*where_table(places))
    assert f"follows {followed}" in dependence_sentence(places)


def test_a_place_has_no_negative_zero():
    cell, turn = cell_of(), se3.rotation(np.array([-1e-5, 1e-5, -1.5]))
    base = se3.matrix(turn, np.array([-1e-5, 2.0, -1e-5]))
    frames = replace(robot_frames(Model(cell, ()), np.zeros(0)), base=base)
    said = base_line(cell, frames, "deflection")
    assert "at (0.000, 2.000, 0.000) m, turned by the rotation vector (0.00, 0.00, -85.94)" in said


def test_a_curve_is_shown_only_where_it_is_determined_and_carries_something(shown):
    def curve_text(error, share=0.3):
        x, y = np.arange(5.0), 1e-5 * np.arange(-2.0, 3.0)
        of = Dependence("time", "s", share, "joint 2", np.zeros(3), x, y, np.full(5, error), "rad")
        return shown(*curves([of]))

    assert "error of joint 2:" in curve_text(2e-6)
    assert "do not determine its curve" in curve_text(5e-2)
    assert "±" not in curve_text(5e-2)
    assert curve_text(2e-6, share=0.004) == ""


@cache
def drifting(strength):
    """Judge a drift of the tracker where nothing states the time."""
    cell, p = cell_of(registration_known=True), plan(16, 3)
    rng = np.random.default_rng(4)
    r = with_noise(noiseless(world_of(cell, rng), p), rng)
    along = np.linspace(-1, 1, len(r))[:, None] * np.array([0.0, 0.0, strength])
    states = replace(r.states, time=None, load_time=None)
    r = replace(r, value=r.value + along, states=states)
    return diagnose(fitted_model(cell, r, "absolute"))


def test_row_order_stands_for_the_time_where_there_is_none():
    by_name = {v.variable: v for v in drifting(1e-4).misfit_breakdown}
    assert "time" not in by_name
    order = by_name[ROW_ORDER]
    assert order.p_value < 1e-6
    assert order.share > 0.5
    assert order.group == "time and air"
    c = campaign(plan_seed=0)
    timed = fitted_model(c.cell, c.readings, "absolute")
    assert ROW_ORDER not in {v.variable for v in misfit_breakdown(linearise(timed))}


@pytest.mark.parametrize("strength", first(1, [4e-5, 2e-5, 1e-4]))
def test_an_unknown_effect_never_stands_beside_nothing_predicted(strength):
    d = drifting(strength)
    if d.verdict == "unknown_effect":
        assert d.predictable_share >= 0.01
        assert " 0 % of the misfit" not in message(d)


@pytest.mark.long
def test_what_the_pose_alone_predicts_is_said_so(shown):
    """Each pose is off by its own random amount; its repeats are off by the same."""
    cell, p = cell_of(registration_known=True), plan(10, 3, 2)
    rng = np.random.default_rng(4)
    r = with_noise(noiseless(world_of(cell, rng), p), rng)
    kind = r.pose * 10 + r.load  # so that only repeats have the error in common
    off = 1e-4 * rng.standard_normal((int(kind.max()) + 1, 3))[kind]
    r = replace(r, value=r.value + off)
    d = diagnose(fitted_model(cell, r, "absolute"))
    assert d.verdict == "unknown_effect"
    assert d.repeated_share > 0.9
    same = f"{100 * d.repeated_share:.0f} % of the misfit is the same"
    assert f"{same} when a pose is repeated: the pose itself predicts it" in message(d)
    assert "predicts 0 %" not in shown(*diagnosis_report(d))
    # Had an angle predicted a part of it:
    partly = replace(d, predictable_share=0.1, follows=("joint 2 angle",))
    assert f"{same} in them" in message(partly)


def test_a_diagnosis_has_no_two_empty_lines_and_one_before_each_table(judged, printed):
    wrong = replace(judged.suspects[0], needs=(("m", 2.0, 1.0),))
    d = replace(judged, reason="no_suspect", suspects=(wrong, *judged.suspects[1:]))
    for text in (printed(*diagnosis_report(judged)), printed(*diagnosis_report(d))):
        lines = [line.strip() for line in text.split("\n")]
        assert not any(lines[k] == lines[k + 1] == "" for k in range(len(lines) - 2))
        heads = [k for k, line in enumerate(lines) if line.startswith(("where the", "not named"))]
        assert heads
        assert all(lines[k - 1] == "" for k in heads)
    assert "is implausible: it would need" in text


def test_a_curve_of_the_terminal_has_degrees(shown):
    x, y = np.array([-np.pi, 0.5 * np.pi]), np.array([-1e-3, 1e-3])
    of = ("joint 2", np.zeros(3), x, y, np.full(2, 1e-5), "rad")
    text = shown(*curves([Dependence("joint 4 angle", "rad", 0.9, *of)]))
    assert "joint 4 angle [°]" in text
    assert "-180" in text


def test_an_error_falls_by_an_added_effect_only_where_a_diagnosis_says_so():
    """The arm has neither effect; without the comparison with chance both "fell" by 0.2 µm."""
    c = campaign(mode="deflection", seed=1)
    before = fitted_model(c.cell, c.readings, "deflection")
    for effect in ("tool_compliance", "base_compliance"):
        after = add(before, effect)
        assert after.holdout.rms_sigma < before.holdout.rms_sigma
        said = change_sentence(before, after, effect, added=True)
        assert "does not fall by more than it scatters" in said
    missing = fitted("deflection", "base_compliance")
    with_missing = add(missing, "base_compliance")
    assert " falls from " in change_sentence(missing, with_missing, "base_compliance", added=True)


@pytest.mark.long
def test_naming_an_effect_of_the_background_is_no_denial_of_it():
    c = campaign(mode="deflection", seed=1)
    f = fitted_model(c.cell, c.readings, "deflection")
    before = with_background(f, f.model.names)
    # what was added before it and is not proved is in it: the model is listed, not "+ background"
    named = " + ".join(before.model.named)
    assert Chapter(3, "background", before, None).change == f"{named} + background"
    effect = sorted(before.model.background)[0]
    said = change_sentence(before, add(before, effect), effect, added=True)
    assert said.startswith(f"{effect} is named now; predictions included it already")
