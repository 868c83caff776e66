"""The recording of a plan, read back: charts and words are what is planned."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.design.summary import DetectableEffect, PredictedParameter
from hilcal.errors import InputError
from hilcal.present.viewer import plan, style
from hilcal.present.viewer.plan import PlanView, record_plan
from hilcal.store.plan import UNLOADED, Plan, Step
from tests.support.picture import Shot, pictures, vulkan_available
from tests.support.recordings import rows, same, texts
from tests.support.viewer_plan import (
    BARE,
    PLAN,
    SUMMARY,
    TRACKER,
    Q,
    configured,
    recording,
    rgb,
    shadowed,
    strict,
)

__all__ = ["recording", "shadowed", "strict"]  # fixtures


def test_the_schedule_has_every_reading_at_its_minute_in_its_loads_series(shadowed, recording):
    d = PlanView(*shadowed, PLAN, SUMMARY)
    minutes, colors = d.time / 60.0, d.colors
    drawn = {}
    for k, load in enumerate(PLAN.loads):
        at = rows(recording, f"/schedule/load{k}", "Scalars:scalars")
        steps = [i for i, s in enumerate(PLAN.steps, start=1) if s.load == load]
        assert sorted(at) == steps
        drawn |= at
        name = "unloaded" if load == UNLOADED else load
        label = rows(recording, f"/schedule/load{k}", "SeriesPoints:names")[0]
        assert label == [f"{name}: {len(steps)}"]
        color = rows(recording, f"/schedule/load{k}", "SeriesPoints:colors")[0][0]
        assert rgb(color) == tuple(colors[k])
    times = [drawn[k][0] for k in range(1, 11)]
    np.testing.assert_allclose(times, minutes)
    gaps = np.diff(times)
    changes = [a.load != b.load for a, b in zip(PLAN.steps, PLAN.steps[1:], strict=False)]
    assert gaps[changes].min() > gaps[~np.array(changes)].max()  # changing a load takes longest


def test_details_are_what_the_terminal_prints(recording):
    details = rows(recording, "/words/details", "TextDocument:text")[0][0].replace("\\", "")
    for row in (
        "| joint_compliance.j1 | 0.040 | 4.00 | µrad/(N·m) | 1.0 % |",
        "| target_offset.x | 22 | 0 | µm |   |",
        "| D (this) | 12.0 µm | 24.0 µm | 3.8 % | 132 | 0.020 | 4.00 | 98.7 % |",
        "| 2 | 24.0 µm |   |",
        "| 3 | 12.0 µm | this plan |",
        "| hysteresis | 6.00 µm |",
        "cannot detect tracker_drift",
        "3 load changes by hand 3 min",
        "note: only 3 candidates are left of load 10kg.",
    ):
        assert row in details
    assert "?" not in details


def test_the_overview_has_cost_and_predicted_precision(recording):
    text = rows(recording, "/words/plan", "TextDocument:text")[0][0].replace("\\", "")
    assert "⚠" not in text  # remarks are no warnings
    for told in (
        "Plan: 3 poses, 10 readings",
        "**efficiency** of the plan: at least 98.7 % (certified lower bound); not accuracy",
        "unloaded 6, 10kg 2, pull x 2",
        "± 12.0 µm",
        "does not see the target in 3 of 10 readings",
    ):
        assert told in text
    cards = rows(recording, "/words/step", "TextDocument:text")
    assert "Step 6 of 10: p1, under 10kg" in cards[6][0]
    assert "10kg is hung, by hand" in cards[6][0]
    assert "by hand" not in cards[7][0]
    assert "everything is taken off" in cards[10][0]


def test_what_a_summary_lacks_is_not_said(tmp_path):
    cell, config = configured()
    record_plan(cell, config, PLAN, BARE, tmp_path / "x.rrd")
    text = rows(tmp_path / "x.rrd", "/words/plan", "TextDocument:text")[0][0]
    for word in ("efficiency", "±", "None", "nan", "drift"):
        assert word not in text


def test_equal_plans_give_equal_recordings(shadowed, recording, tmp_path):
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_plan(*shadowed, PLAN, SUMMARY, again)
    record_plan(*shadowed, replace(PLAN, steps=PLAN.steps[:-1]), SUMMARY, other)
    assert same(recording, again)
    assert not same(recording, other)


def test_no_character_without_a_glyph_reaches_the_viewer(tmp_path):
    bad = "█ |漢⟂ *x*"
    cell, config = configured(
        loads=[{"name": bad, "mass_kg": 2.0}],
        obstacles=[{"name": bad, "center_m": [2.0, 2.0, 0.0], "size_m": [0.1, 0.1, 0.1]}],
        sight={"tracker_m": TRACKER.tolist()},
    )
    plan = Plan((bad,), Q[:1], (Step(bad, UNLOADED), Step(bad, bad)))
    summary = replace(
        SUMMARY,
        criterion=bad,
        loads={bad: 1},
        parameters=(PredictedParameter(bad, 1.0, 2.0, bad),),
        detectable=(DetectableEffect(bad, 1e-6), DetectableEffect(bad, None)),
        remarks=(bad,),
        criteria=(replace(SUMMARY.criteria[0], criterion=bad),),
    )
    path = tmp_path / "x.rrd"
    record_plan(cell, config, plan, summary, path)
    found = texts(path)
    assert len(found) > 10
    assert [t for t in found if style.safe(t) != t] == []


def test_what_does_not_fit_is_refused(shadowed, tmp_path):
    with pytest.raises(InputError, match="5 joint angles per pose; ur10e has 6"):
        record_plan(*shadowed, replace(PLAN, q=Q[:, :5]), SUMMARY, tmp_path / "x.rrd")
    with pytest.raises(InputError, match="no folder"):
        record_plan(*shadowed, PLAN, SUMMARY, tmp_path / "none" / "x.rrd")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.vulkan
@pytest.mark.slow
@pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")
def test_every_view_is_drawn_without_a_report(recording, tmp_path):
    names = [plan.STEPS, plan.SCHEDULE, "Plan", "This step", "How to read this", "Details"]
    shots = [Shot(tmp_path / f"{i}.png", "step", 6, name) for i, name in enumerate(names)]
    reports = pictures(recording, shots, (960, 540), 480)
    assert set(names) <= {v.name for v in reports}
    assert any(v.name.startswith(plan.TRACKER) for v in reports)
    assert [v for v in reports if v.problems] == []
    assert all(shot.png.stat().st_size > 1000 for shot in shots)
