"""The story of a refinement: base axes, the same readings in every revision, a straight suspect."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.prediction.full_prediction import full_prediction, residual_table
from hilcal.present.html.report import left_out_errors
from hilcal.present.story import Chapter, build_story, curve, of_left_out, pose_numbers
from hilcal.robot.chain import evaluate
from tests.support.cli_cases import rehearsal
from tests.support.fit_cases import fitted_model
from tests.support.observer_cases import POINTS, base_cell, observed, stated
from tests.support.refusals import refusal
from tests.support.rows import first
from tests.unit.diagnosis.test_residual_regression import hidden


@cache
def story_of(effect):
    """A rehearsed campaign before and after its hidden effect is added."""
    r = rehearsal(effect)
    first = fitted_model(r.cell, r.readings, r.mode)
    second = add(first, r.hidden)
    return build_story(
        [Chapter(4, None, first, diagnose(first)), Chapter(5, r.hidden, second, diagnose(second))]
    )


@pytest.mark.parametrize("effect", first(1, ["hysteresis", "encoder_offset"]))
def test_a_story_holds_together_and_the_right_suspect_lies_on_the_line_of_slope_one(effect):
    story = story_of(effect)
    first, last = story.revisions
    assert [(r.revision, r.change) for r in (first, last)] == [(4, ""), (5, f"+ {effect}")]
    assert (first.verdict, last.verdict) == ("missing_effect", "adequate")
    assert last.dependence is None
    for r in story.revisions:
        np.testing.assert_allclose(story.measured - r.predicted, r.residual, atol=1e-12)
    norm = np.mean(last.whitened_norm2)
    assert 2.3 < norm < 3.7  # three elements, only noise
    assert np.mean(first.whitened_norm2) > 2 * norm
    floor = np.sqrt(np.trace(story.covariance, axis1=1, axis2=2).mean())
    assert story.noise_floor_m == pytest.approx(floor)
    g = first.dependence
    assert g.title == effect
    assert effect in g.x_label
    assert float(g.x @ g.y / (g.x @ g.x)) == pytest.approx(1.0, abs=0.1)
    assert np.mean((g.y - g.x) ** 2) < 0.25 * np.mean(g.y**2)
    assert g.x.min() < 0 < g.x.max()


def test_vectors_are_in_base_axes():
    r, story = rehearsal("hysteresis"), story_of("hysteresis")
    whitening = full_prediction(fitted_model(r.cell, r.readings, r.mode)).whitening
    expected = whitening.raw(r.readings.value) @ r.world.registration[:3, :3]
    # Deflections leave the base's turning open by what the closed form knows, some mrad.
    off = np.linalg.norm(story.measured - expected, axis=1)
    assert off.max() < 0.01 * np.linalg.norm(expected, axis=1).max()
    weight = np.array(story.load_names) == "10kg"
    assert (story.measured[weight, 2] < 0).all()  # it pulls down


@pytest.mark.parametrize("mode", ["deflection", "absolute"])
def test_a_distance_is_drawn_along_the_line_that_is_measured(mode):
    c = observed(["A"], 2, cell=base_cell(stated("A")), base=True)
    f = fitted_model(c.cell, c.readings, mode)
    story = build_story([Chapter(1, None, f, None)])
    along = story.anchor - POINTS["A"]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    for vectors in (story.revisions[0].residual, story.deviation(story.measured)):
        size = np.sum(vectors * along, axis=1)
        np.testing.assert_allclose(vectors, size[:, None] * along, atol=0.01 * abs(size).max())
    np.testing.assert_allclose(story.revisions[0].size_m, abs(f.raw[:, 0]), atol=1e-12)
    np.testing.assert_allclose(f.residuals("base"), story.revisions[0].residual, atol=1e-12)
    rows, table = np.flatnonzero(~f.outlier)[f.whitening.reading], residual_table(f)
    columns = [np.array(table[f"residual_base_{axis}_m"])[rows] for axis in "xyz"]
    in_table = np.stack(columns, axis=1).astype(float)
    np.testing.assert_allclose(in_table, f.residuals("base"), atol=1e-12)


def test_arrows_start_at_the_nominal_target():
    r, story = rehearsal("encoder_offset"), story_of("encoder_offset")
    nominal = evaluate(r.cell.arm, story.q).point(r.cell.target[:3, 3])
    np.testing.assert_allclose(story.anchor, nominal, atol=1e-12)
    assert np.linalg.norm(story.measured - story.anchor, axis=1).max() < 0.01


@cache
def unknown():
    c = hidden("dq2 = sin 3 q4", "absolute", 0, 1.5)
    return diagnose(fitted_model(c.cell, c.readings, c.mode))


@pytest.mark.long
def test_an_unknown_effect_has_a_curve_in_units_for_people():
    d = unknown()
    r = build_story([Chapter(1, None, d.fit, d)]).revisions[0]
    lead, of = r.dependence, d.dependences[0]
    assert r.verdict == "unknown_effect"
    assert (lead.title, lead.x_label) == ("joint 4 angle", "joint 4 angle [°]")
    assert lead.y_label == "error of joint 2 [µrad]"
    np.testing.assert_allclose(np.deg2rad(lead.x), of.x)
    np.testing.assert_allclose(1e-6 * np.array([lead.y, lead.error]), [of.y, of.error])
    assert of.share > 0.9
    assert lead.description.startswith(f"{100 * of.share:.0f} % of the misfit")


@pytest.mark.parametrize(
    ("unit", "end", "label", "factor"),
    [
        ("s", 90.0, "time [s]", 1.0),
        ("s", 1800.0, "time [min]", 1 / 60),
        ("s", 36000.0, "time [h]", 1 / 3600),
        ("rad", 3.0, "time [°]", 180 / np.pi),
        ("°C", 40.0, "time [°C]", 1.0),
        ("", 2.0, "time", 1.0),
    ],
)
def test_units_of_a_variable_are_those_of_people(unit, end, label, factor):
    x, y, up = np.array([0.0, end]), np.array([-2e-3, 2e-3]), np.array([0.0, 0.0, 1.0])
    line = curve(Dependence("time", unit, 0.5, "target", up, x, y, np.full(2, 1e-4), "m"))
    assert line.x_label == label
    np.testing.assert_allclose(line.x, factor * x)
    assert line.y_label == "error of the target along base z [mm]"
    np.testing.assert_allclose(line.y, [-2.0, 2.0])
    aslant = Dependence("load", "", 0.5, "target", np.array([0.6, 0.0, 0.8]), x, y, y, "m")
    assert "the target along (0.60, 0.00, 0.80) in base axes" in curve(aslant).y_label


def test_gross_errors_are_shown_as_well():
    r = rehearsal("nothing")
    value = r.readings.value.copy()
    value[17] += 0.004
    fitted = fitted_model(r.cell, replace(r.readings, value=value), "absolute")
    assert fitted.outlier.any()
    story = build_story([Chapter(1, None, fitted, None)])
    assert len(story) == len(value)
    assert int(np.argmax(story.revisions[0].whitened_norm2)) == 17
    apart = of_left_out(story.revisions[0], fitted)
    np.testing.assert_allclose(story.measured - apart.predicted, apart.residual, atol=1e-12)
    assert apart.whitened_norm2.sum() > story.revisions[0].whitened_norm2.sum()
    left = apart.size_m
    assert int(np.argmax(left)) == 17
    kept = left_out_errors(fitted)
    np.testing.assert_allclose(np.sort(left[~fitted.outlier]), np.sort(kept), rtol=1e-9)
    assert kept.max() == pytest.approx(fitted.holdout.max_m)
    assert np.sqrt(np.mean(kept**2)) == pytest.approx(fitted.holdout.rms_m, rel=1e-9)


def test_other_readings_do_not_make_one_story():
    r = rehearsal("nothing")
    modes = ("absolute", "deflection")
    chapters = [Chapter(1, None, fitted_model(r.cell, r.readings, mode), None) for mode in modes]
    refusal("other readings", build_story, chapters)
    refusal("identify", build_story, [])


@pytest.mark.parametrize(
    ("names", "numbers"),
    [
        (("p3", "p12"), [3, 12]),
        (("row 534", "row 7"), [534, 7]),
        (("reference", "p1", "home", "p2"), [0, 1, 3, 2]),
        (("a", "b"), [1, 2]),
        (("a1", "b1"), [1, 2]),
        (("p" + "9" * 30, "p1"), [1, 2]),
    ],
)
def test_poses_keep_the_numbers_of_their_names(names, numbers):
    assert pose_numbers(names).tolist() == numbers
