"""The recording of a plan, read back: charts and words are what is planned."""

import subprocess
from dataclasses import replace

import numpy as np
import pytest
from rerun.chunk import RrdReader

from hilcal.data.plan import UNLOADED, Plan, Step
from hilcal.errors import InputError
from hilcal.plan.story import Promised, Seen
from hilcal.report.viewer import plan_layout, style
from hilcal.report.viewer.plan_charts import HEIGHT, LONG
from hilcal.report.viewer.plan_digest import plan_digest
from hilcal.report.viewer.plan_promises import shown_parameters
from hilcal.report.viewer.plan_stream import record_plan
from hilcal.report.viewer.stream import executable
from tests.support.picture import Shot, pictures, vulkan_available
from tests.support.viewer_plan import (
    BARE,
    PLAN,
    STORY,
    TRACKER,
    Q,
    configured,
    entities,
    recording,
    rgb,
    rows,
    shadowed,
    strict,
)

__all__ = ["recording", "shadowed", "strict"]  # fixtures


def test_the_schedule_has_every_reading_in_time_and_in_its_loads_row(recording):
    dots = np.array(rows(recording, "/schedule/readings", "Points2D:positions")[0])
    assert len(dots) == 10
    assert np.all(np.diff(dots[:, 0]) > 0)
    assert dots[-1, 0] <= LONG
    heights = {s.load: {y} for s, y in zip(PLAN.steps, dots[:, 1], strict=True)}
    for s, y in zip(PLAN.steps, dots[:, 1], strict=True):
        heights[s.load].add(y)
    assert [len(h) for h in heights.values()] == [1, 1, 1]
    now = rows(recording, "/schedule/now", "LineStrips2D:strips")
    np.testing.assert_allclose([now[k][0][0][0] for k in range(1, 11)], dots[:, 0], rtol=1e-6)
    gaps = np.diff(dots[:, 0])
    changes = [a.load != b.load for a, b in zip(PLAN.steps, PLAN.steps[1:], strict=False)]
    assert gaps[changes].min() > gaps[~np.array(changes)].max()  # changing a load takes longest


def test_the_curve_falls_as_the_numbers_and_the_plan_is_marked(recording):
    at = np.array(rows(recording, "/curve/points", "Points2D:positions")[0])
    np.testing.assert_allclose((HEIGHT - at[:, 1]) / (HEIGHT - at[0, 1]), [1, 1 / 2, 1 / 3])
    np.testing.assert_allclose(at[:, 0] / at[0, 0], [1, 1.5, 3], rtol=1e-6)
    colors = [rgb(c) for c in rows(recording, "/curve/points", "Points2D:colors")[0]]
    assert [c == style.MEASURED for c in colors] == [False, True, False]
    assert "3 poses, ± 12.0 µm" in rows(recording, "/curve/plan", "Points2D:labels")[0][0]


def test_parameters_of_no_size_are_in_the_table_but_not_in_the_chart(recording):
    assert [p.name for p in shown_parameters(STORY)] == [
        "joint_compliance.j1",
        "joint_compliance.j2",
    ]
    assert rows(recording, "/parameters/shares", "Points2D:labels")[0] == ["1.0 %", "10 %"]
    at = np.array(rows(recording, "/parameters/points", "Points2D:positions")[0])
    ticks = np.array(rows(recording, "/parameters/ticks", "Points2D:positions")[0])
    words = rows(recording, "/parameters/ticks", "Points2D:labels")[0]
    np.testing.assert_allclose(at[:, 0], [ticks[words.index(w), 0] for w in ("1 %", "10 %")])
    table = rows(recording, "/words/parameters", "TextDocument:text")[0][0].replace("\\", "")
    assert "| base_frame.x | 12 µm |" in table
    assert "| target_offset.x | 22 µm |" in table


def test_criteria_have_bars_in_proportion(recording):
    bars = np.array(rows(recording, "/bought/bars", "LineStrips2D:strips")[0])
    colors = [rgb(c) for c in rows(recording, "/bought/bars", "LineStrips2D:colors")[0]]
    length = bars[:, 1, 0] - bars[:, 0, 0]
    own = [c == style.MEASURED for c in colors]
    assert own == [True, False, True, False, True, True, False, True, False, True, False]
    full = length.max()
    expected = [1, 0.75, 0.8, 1, 1, 1, 0.5, 1, 0.5, 1, 0.5]
    np.testing.assert_allclose(length / full, expected, rtol=1e-5)
    values = rows(recording, "/bought/values", "Points2D:labels")[0]
    assert values[:6] == ["12.0 µm", "9.00 µm", "24.0 µm", "30.0 µm", "3.8 %", "-"]


def test_the_summary_tells_what_the_plan_costs_and_promises(recording):
    text = rows(recording, "/words/plan", "TextDocument:text")[0][0].replace("\\", "")
    for told in (
        "Plan: 3 poses, 10 readings",
        "At least 98.7 % of the best possible",
        "unloaded 6, 10kg 2, pull x 2",
        "3 load changes by hand 3 min",
        "± 12.0 µm",
        "does not see the target in 3 of 10 readings",
        "hysteresis from 6.00 µm",
        "cannot show tracker_drift",
        "only 3 candidates are left of load 10kg.",
    ):
        assert told in text
    cards = rows(recording, "/words/step", "TextDocument:text")
    assert "Step 6 of 10: p1, under 10kg" in cards[6][0]
    assert "10kg is hung, by hand" in cards[6][0]
    assert "by hand" not in cards[7][0]
    assert "everything is taken off" in cards[10][0]


def test_what_a_story_lacks_has_no_view(tmp_path):
    cell, config = configured()
    record_plan(cell, config, PLAN, BARE, tmp_path / "x.rrd")
    assert not {"/curve/line", "/parameters/points", "/bought/bars"} & entities(tmp_path / "x.rrd")
    text = rows(tmp_path / "x.rrd", "/words/plan", "TextDocument:text")[0][0]
    for word in ("best possible", "±", "None", "nan", "drift"):
        assert word not in text


def test_equal_plans_give_equal_recordings(shadowed, recording, tmp_path):
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    record_plan(*shadowed, PLAN, STORY, again)
    record_plan(*shadowed, replace(PLAN, steps=PLAN.steps[:-1]), STORY, other)
    compared = [
        subprocess.run(
            [executable(), "rrd", "compare", str(recording), str(path)],
            capture_output=True,
            check=False,
        ).returncode
        for path in (again, other)
    ]
    assert compared[0] == 0
    assert compared[1] != 0


def test_no_character_without_a_glyph_reaches_the_viewer(tmp_path):
    bad = "█ |漢⟂ *x*"
    cell, config = configured(
        loads=[{"name": bad, "mass_kg": 2.0}],
        obstacles=[{"name": bad, "center_m": [2.0, 2.0, 0.0], "size_m": [0.1, 0.1, 0.1]}],
        sight={"tracker_m": TRACKER.tolist()},
    )
    plan = Plan((bad,), Q[:1], (Step(bad, UNLOADED), Step(bad, bad)))
    story = replace(
        STORY,
        criterion=bad,
        loads={bad: 1},
        predicted=(Promised(bad, 1.0, 2.0, bad),),
        seen=(Seen(bad, 1e-6), Seen(bad, None)),
        remarks=(bad,),
        bought=(replace(STORY.bought[0], criterion=bad),),
    )
    path = tmp_path / "x.rrd"
    record_plan(cell, config, plan, story, path)
    found = []
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            if name.endswith((":text", ":labels", ":names", ":name")):
                found += [t for row in batch.column(name).to_pylist() for t in row or []]
    assert len(found) > 20
    assert [t for t in found if style.safe(t) != t] == []


def test_what_does_not_fit_is_refused(shadowed, tmp_path):
    with pytest.raises(InputError, match="5 joint angles per pose; ur10e has 6"):
        record_plan(*shadowed, replace(PLAN, q=Q[:, :5]), STORY, tmp_path / "x.rrd")
    with pytest.raises(InputError, match="no folder"):
        record_plan(*shadowed, PLAN, STORY, tmp_path / "none" / "x.rrd")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.vulkan
@pytest.mark.slow
@pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")
def test_every_view_is_drawn_without_a_report(recording, shadowed, tmp_path):
    names = [plan_layout.STEPS, plan_layout.SCHEDULE, plan_layout.CURVE, plan_layout.BOUGHT]
    names += [plan_layout.parameters_title(plan_digest(*shadowed, PLAN, STORY))]
    names += ["Plan", "This step", "How to read this", "Parameters", "Criteria"]
    shots = [Shot(tmp_path / f"{i}.png", "step", 6, name) for i, name in enumerate(names)]
    reports = pictures(recording, shots, (960, 540), 480)
    assert set(names) <= {v.name for v in reports}
    assert any(v.name.startswith(plan_layout.TRACKER) for v in reports)
    assert [v for v in reports if v.problems] == []
    assert all(shot.png.stat().st_size > 1000 for shot in shots)
