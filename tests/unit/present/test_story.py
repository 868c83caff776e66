"""The story of a refinement: base axes, the same readings in every revision, a straight suspect."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.diagnosis import Diagnosis
from hilcal.diagnosis.effect_ranking import Later as LeftOut
from hilcal.diagnosis.residual_regression import Dependence
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.rehearsal import Rehearsal
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.full_prediction import full_prediction
from hilcal.identification.linearisation import HeldOut
from hilcal.present.html.certificate import left_out_errors
from hilcal.present.story import (
    Chapter,
    Story,
    StoryRevision,
    build_story,
    curve,
    of_left_out,
    pose_numbers,
)
from hilcal.refinement import add
from hilcal.robot.chain import evaluate
from tests.support.campaigns import Campaign
from tests.support.cli_cases import rehearsal
from tests.unit.diagnosis.test_residual_regression import hidden


def chapters_of(r: Rehearsal) -> list[Chapter]:
    first = fit(baseline(r.cell, r.readings, r.mode), r.readings, r.mode)
    second = add(first, r.hidden)
    return [
        Chapter(4, None, first, diagnose(first)),
        Chapter(5, r.hidden, second, diagnose(second)),
    ]


@pytest.fixture(scope="module")
def deflections() -> tuple[Rehearsal, Story]:
    r = rehearsal("hysteresis")
    return r, build_story(chapters_of(r))


@pytest.fixture(scope="module")
def positions() -> tuple[Rehearsal, Story]:
    r = rehearsal("encoder_offset")
    return r, build_story(chapters_of(r))


def test_a_story_holds_together(
    deflections: tuple[Rehearsal, Story], positions: tuple[Rehearsal, Story]
) -> None:
    for r, story in (deflections, positions):
        first, last = story.revisions
        assert (first.revision, last.revision) == (4, 5)
        assert (first.change, last.change) == ("", f"+ {r.hidden}")
        assert first.verdict == "missing_effect"
        assert last.verdict == "adequate"
        assert first.follows is not None
        assert first.follows.title == r.hidden
        assert last.follows is None
        for revision in story.revisions:
            np.testing.assert_allclose(
                story.measured - revision.predicted, revision.residual, atol=1e-12
            )
        norm = np.mean(last.whitened_norm2)
        assert 2.3 < norm < 3.7  # three elements, only noise
        assert np.mean(first.whitened_norm2) > 2 * norm
        assert story.noise_floor_m == pytest.approx(
            np.sqrt(np.trace(story.covariance, axis1=1, axis2=2).mean())
        )


def test_vectors_are_in_base_axes(deflections: tuple[Rehearsal, Story]) -> None:
    r, story = deflections
    turned = np.swapaxes(r.world.registration[:3, :3], 0, 1)
    e = full_prediction(chapters_of(r)[-1].fit)
    expected = e.whitening.raw(r.readings.value) @ turned.T
    # Deflections leave the base's turning open by what the closed form knows, some mrad.
    off = np.linalg.norm(story.measured - expected, axis=1)
    assert off.max() < 0.01 * np.linalg.norm(expected, axis=1).max()
    loads = np.array(story.load_names)
    down = story.measured[loads == "10kg", 2]
    assert (down < 0).all()  # a weight pulls down


def test_arrows_start_at_the_nominal_target(positions: tuple[Rehearsal, Story]) -> None:
    r, story = positions
    chain = evaluate(r.cell.arm, story.q)
    nominal = chain.point(r.cell.target[:3, 3])
    np.testing.assert_allclose(story.anchor, nominal, atol=1e-12)
    assert np.linalg.norm(story.measured - story.anchor, axis=1).max() < 0.01


def test_the_right_suspect_lies_on_the_line_of_slope_one(
    deflections: tuple[Rehearsal, Story], positions: tuple[Rehearsal, Story]
) -> None:
    for r, story in (deflections, positions):
        g = story.revisions[0].follows
        assert g is not None
        assert r.hidden in g.x_label
        slope = float(g.x @ g.y / (g.x @ g.x))
        assert slope == pytest.approx(1.0, abs=0.1)
        left = g.y - g.x
        assert np.mean(left**2) < 0.25 * np.mean(g.y**2)
        assert (g.x > 0).any()
        assert (g.x < 0).any()


def judged(c: Campaign) -> tuple[Diagnosis, StoryRevision]:
    found = fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)
    d = diagnose(found)
    story = build_story([Chapter(1, None, found, d)])
    return d, story.revisions[0]


def test_an_unknown_effect_has_a_curve_in_units_for_people() -> None:
    d, r = judged(hidden("dq2 = sin 3 q4", "absolute", 0, 1.5))
    assert r.verdict == "unknown_effect"
    lead = r.follows
    assert lead is not None
    assert (lead.title, lead.x_label) == ("joint 4 angle", "joint 4 angle [°]")
    assert lead.y_label == "error of joint 2 [µrad]"
    np.testing.assert_allclose(np.deg2rad(lead.x), d.dependences[0].x)
    np.testing.assert_allclose(lead.y * 1e-6, d.dependences[0].y)
    np.testing.assert_allclose(lead.error * 1e-6, d.dependences[0].error)
    assert d.dependences[0].share > 0.9
    assert lead.says.startswith(f"{100 * d.dependences[0].share:.0f} % of the misfit")


@pytest.mark.parametrize(("explains", "curves"), [(0.03, 1), (0.6, 0)])
def test_a_suspect_that_explains_little_leaves_the_picture_to_the_variable(
    explains: float, curves: int
) -> None:
    d, _ = judged(hidden("dq2 = sin 3 q4", "absolute", 0, 1.5))
    left_out = LeftOut(lambda: HeldOut(explains, True))
    lead = replace(d.suspects[1], left_out=left_out, explains=True)
    named = replace(d, reason="one_suspect", suspects=(lead, d.suspects[0]))
    r = build_story([Chapter(1, None, d.fit, named)]).revisions[0]
    assert r.follows is not None
    assert r.follows.title == ("joint 4 angle" if curves else lead.effect)


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
def test_units_of_a_variable_are_those_of_people(
    unit: str, end: float, label: str, factor: float
) -> None:
    x, up = np.array([0.0, end]), np.array([0.0, 0.0, 1.0])
    y, error = np.array([-2e-3, 2e-3]), np.array([1e-4, 1e-4])
    told = curve(Dependence("time", unit, 0.5, "target", up, x, y, error, "m"))
    assert told.x_label == label
    np.testing.assert_allclose(told.x, factor * x)
    assert told.y_label == "error of the target along base z [mm]"
    np.testing.assert_allclose(told.y, [-2.0, 2.0])


def test_a_direction_between_axes_is_told_by_its_components() -> None:
    one = np.ones(1)
    told = curve(
        Dependence("load", "", 0.5, "target", np.array([0.6, 0.0, 0.8]), one, one, one, "m")
    )
    assert told.y_label == "error of the target along (0.60, 0.00, 0.80) in base axes [mm]"


def test_gross_errors_are_shown_as_well() -> None:
    r = rehearsal("nothing")
    value = r.readings.value.copy()
    value[17] += 0.004
    readings = replace(r.readings, value=value)
    found = fit(baseline(r.cell, readings, "absolute"), readings, "absolute")
    assert found.outlier.any()
    story = build_story([Chapter(1, None, found, None)])
    assert len(story) == len(readings)
    assert int(np.argmax(story.revisions[0].whitened_norm2)) == 17
    left = np.linalg.norm(of_left_out(story.revisions[0], found).residual, axis=1)
    assert int(np.argmax(left)) == 17
    kept = left_out_errors(found)
    np.testing.assert_allclose(np.sort(left[~found.outlier]), np.sort(kept), rtol=1e-9)
    assert kept.max() == pytest.approx(found.holdout.max_m)


def test_other_readings_do_not_make_one_story() -> None:
    r = rehearsal("nothing")
    model = baseline(r.cell, r.readings, "absolute")
    one = fit(model, r.readings, "absolute")
    two = fit(baseline(r.cell, r.readings, "deflection"), r.readings, "deflection")
    with pytest.raises(InputError, match="other readings"):
        build_story([Chapter(1, None, one, None), Chapter(2, None, two, None)])
    with pytest.raises(InputError, match="identify"):
        build_story([])


def test_poses_keep_the_numbers_of_their_names() -> None:
    assert pose_numbers(("p3", "p12")).tolist() == [3, 12]
    assert pose_numbers(("row 534", "row 7")).tolist() == [534, 7]
    assert pose_numbers(("reference", "p1", "home", "p2")).tolist() == [0, 1, 3, 2]
    assert pose_numbers(("a", "b")).tolist() == [1, 2]
    assert pose_numbers(("a1", "b1")).tolist() == [1, 2]
    assert pose_numbers(("p" + "9" * 30, "p1")).tolist() == [1, 2]
