"""What `identify` shows before and after, and one way to write a p-value wherever it stands."""

import re

import numpy as np
import pytest
from rich.console import Console

from hilcal import numbers
from hilcal.diagnosis.document import to_json as diagnosis_json
from hilcal.diagnosis.effect_ranking import FALSE_ALARM
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.options import typical_compliances
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.full_prediction import error_before, full_prediction
from hilcal.present.diagnosis import diagnosis_report, suspects_table
from hilcal.present.fit import before_and_after, errors, fit_report, worst_poses
from hilcal.present.story import Chapter, build_story
from hilcal.present.verdict import message
from hilcal.present.viewer import campaign as viewer
from tests.support.campaigns import campaign


def fitted(mode: str, effect: str = "transmission_error") -> Fit:
    c = campaign(effect, mode, 1, poses=12, strength=3.0)
    return fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode)


@pytest.fixture(scope="module")
def absolute() -> Fit:
    return fitted("absolute")


@pytest.fixture(scope="module")
def deflections() -> Fit:
    return fitted("deflection", "base_compliance")


def shown(*parts: object) -> str:
    console = Console(width=200, no_color=True)
    with console.capture() as captured:
        for part in parts:
            console.print(part)
    return " ".join(captured.get().split())


def test_before_a_deflection_is_what_was_measured(deflections):
    r, w = deflections.readings, deflections.whitening
    measured = np.linalg.norm(w.raw(r.value[:, :3]), axis=1)
    before = error_before(deflections)
    assert before.rms_m == pytest.approx(float(np.sqrt(np.mean(measured**2))), rel=1e-9)
    assert before.max_m == pytest.approx(float(measured.max()), rel=1e-9)
    said = before_and_after(deflections)
    assert said.startswith(f"Deflections of {numbers.length(before.rms_m)} rms were measured;")
    assert f"the model leaves {numbers.length(deflections.error.rms_m)} (noise" in said


def test_before_of_positions_is_the_rigid_arm_in_frames_of_its_own(absolute):
    """Compliances alone are put to zero; they sag by about torque times compliance."""
    before = error_before(absolute)
    torque = absolute.solution.prediction.situation.torque
    turned = torque * typical_compliances(absolute.model.cell)
    assert absolute.error.rms_m < 0.2 * before.rms_m
    assert 0.1 * np.abs(turned).max() < before.rms_m < 3.0 * np.abs(turned).sum(axis=1).max()
    assert "The rigid nominal arm, its frames fitted alone, is off by" in shown(
        *fit_report(absolute)
    )


def test_the_table_and_the_document_have_it(absolute):
    before = error_before(absolute)
    table = shown(errors(absolute))
    assert f"before: rigid nominal arm {numbers.length(before.rms_m)}" in table
    assert to_json(absolute)["error"]["before"] == before.to_json()


def test_a_p_value_reads_the_same_wherever_it_stands(absolute):
    d = diagnose(absolute)
    lead = d.suspects[0]
    value = numbers.chance(lead.score.p_value)
    assert numbers.p_equals(lead.score.p_value) in message(d)
    assert re.search(rf"{lead.effect} .*{re.escape(value)}", shown(suspects_table(d)))
    story = build_story([Chapter(1, None, absolute, d)])
    revision = story.revisions[0]
    panel = viewer.verdict(story, revision)
    assert f"| {value.replace('<', chr(92) + '<')} |" in panel
    assert numbers.p_equals(lead.score.p_value) in str(revision.panels["verdict"][0])


@pytest.mark.parametrize(
    ("p", "written"),
    [(5e-26, "p < 1e-16"), (0.0, "p < 1e-16"), (3.2e-9, "p = 3e-09"), (0.0123, "p = 0.012")],
)
def test_a_small_p_value_is_written_in_one_way(p, written):
    assert numbers.p_equals(p) == written
    assert numbers.chance(p) == written.removeprefix("p = ").removeprefix("p ")


def test_how_many_were_tested_stands_where_p_values_do(absolute):
    d = diagnose(absolute)
    tests = diagnosis_json(d)["tests"]
    assert tests["count"] == sum(s.score.rank > 0 for s in d.suspects)
    assert tests["each"] == pytest.approx(FALSE_ALARM / tests["count"])
    report = shown(*diagnosis_report(d))
    assert f"{tests['count']} effects were tested: one counts from p < " in report
    assert f"which is 0.001 / {tests['count']}" in report
    kinds = [v for v in d.misfit_breakdown if v.group not in ("pose", "direction")]
    assert f"{len(kinds)} variables were tested" in report
    story = build_story([Chapter(1, None, absolute, d)])
    details = viewer.details(story, story.revisions[0])
    assert f"{tests['count']} effects were tested" in details


def test_a_suspect_counts_only_below_the_shared_level(absolute):
    d = diagnose(absolute)
    assert all(s.score.p_value * d.tested < FALSE_ALARM for s in d.suspects if s.passes)


def test_terminal_and_viewer_call_the_worst_pose_by_its_name(absolute):
    worst = worst_poses(full_prediction(absolute))[0]
    story = build_story([Chapter(1, None, absolute, None)])
    assert worst.pose in absolute.readings.pose_names
    assert story.pose_name(viewer.worst(story.revisions[0])) == worst.pose
    details = viewer.details(story, story.revisions[0])
    assert f"Worst: pose {worst.pose}, load {worst.load}," in details
