"""What a live viewer draws of a campaign while it is measured, and of revisions as they come."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr

from hilcal.measuring.progress import ArmPosition, LiveResidual, ReadingStored, Remark
from hilcal.present.viewer import live, style
from hilcal.present.viewer.live import (
    BALL,
    GROUPS,
    LIMIT,
    MANY,
    MAX_SINGLE_RESIDUALS,
    LiveTally,
    judgement_of,
)
from tests.support.live_story import READINGS_BEFORE_MODEL, events, measuring, plan, residual
from tests.support.picture import Shot, contrast, needs_vulkan, pictures
from tests.support.recordings import chunks, values
from tests.support.viewer_story import story

pytestmark = pytest.mark.usefixtures("strict")


def recorded(path, timed_events, end=True):
    """Draw events or stories, each at its time, into a file."""
    rec = rr.RecordingStream("hilcal", recording_id="test", send_properties=False)
    rec.set_sinks(rr.FileSink(str(path)))
    scene = live.LiveScene(rec, batches=True)
    for wall, what in timed_events:
        scene.draw(wall, what)
    if end:
        scene.end(to_open=True)
    rec.disconnect()
    return path


def revisions():
    example_story = story()
    for k, r in enumerate(example_story.revisions):
        yield float(k), replace(example_story, revisions=(r,))


def stored(start, wrong=6.0):
    return [e for _, e in events(start, wrong) if isinstance(e, ReadingStored)]


def of_levels(path):
    """The residuals in time, σ, of each level."""
    return [np.ravel(values(path, f"/live/1/{n}", "Scalars:scalars")) for n in style.LEVEL_NAMES]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("live") / "run.rrd", events(measuring()))


@pytest.fixture(scope="module")
def refined(tmp_path_factory):
    return recorded(tmp_path_factory.mktemp("live") / "refined.rrd", revisions())


def test_each_reading_has_its_arrow_and_leaves_its_ball_where_the_model_is_wrong(measured):
    judgements = [judgement_of(e.step, e.live) for e in stored(measuring())[READINGS_BEFORE_MODEL:]]
    levels = np.array([j.level for j in judgements])
    arrows = np.array(values(measured, "/world/live/1/arrows", "Arrows3D:vectors"))[:, 0]
    assert (
        len(values(measured, "/world/live/1/dots", "Points3D:positions")) == READINGS_BEFORE_MODEL
    )
    outside = np.linalg.norm(arrows, axis=1) > BALL
    assert outside.tolist() == (levels > 0).tolist()
    assert 5 < outside.sum() < len(judgements) / 2
    red = (style.LEVEL_COLORS[2].astype(int) * [1 << 24, 1 << 16, 1 << 8]).sum() + 255
    colors = np.array(values(measured, "/world/live/1/arrows", "Arrows3D:colors"))[:, 0]
    assert ((colors == red) == (levels == 2)).all()
    assert of_levels(measured)[2] == pytest.approx([j.sigma for j in judgements if j.level == 2])


def test_of_many_readings_only_those_outside_are_drawn_in_space(tmp_path):
    start = measuring(plan(200))
    path = recorded(tmp_path / "many.rrd", events(start))
    outside = [
        judgement_of(e.step, e.live).level > 0 for e in stored(start)[READINGS_BEFORE_MODEL:]
    ]
    arrows = values(path, "/world/live/1/arrows", "Arrows3D:vectors")
    assert len(arrows) == MANY + sum(outside[MANY:]) < len(outside)
    assert sum(map(len, of_levels(path))) == len(outside)


@pytest.mark.long
def test_of_a_thousand_readings_and_more_the_worst_of_each_group_stay(tmp_path):
    start = measuring(plan(MAX_SINGLE_RESIDUALS // 2 + 100))
    path = recorded(tmp_path / "thousands.rrd", events(start, wrong=2.0))
    sigma = np.array(
        [judgement_of(e.step, e.live).sigma for e in stored(start, 2.0)[READINGS_BEFORE_MODEL:]]
    )
    group = -(-len(start.plan.steps) // GROUPS)
    shown = np.sort(np.concatenate(of_levels(path)))
    assert LiveTally(start).group == group == 8
    assert len(shown) < 0.45 * len(sigma)
    worst = [sigma[k : k + group].max() for k in range(0, len(sigma), group)]
    assert all(np.abs(shown - w).min() < 1e-9 for w in worst)
    last = values(path, "/world/live/1/now/arrow", "Arrows3D:vectors")
    assert len(last) == len(sigma)  # each reading is drawn while it is the last
    kept = values(path, "/world/live/1/arrows", "Arrows3D:vectors")
    assert len(kept) <= len(shown)
    outside = [w for w in worst if w > LIMIT]
    assert sum(np.linalg.norm(v[0]) > BALL for v in kept) >= len(outside) > 20


def test_every_target_of_an_arrival_is_drawn_where_it_is(tmp_path):
    one = measuring()
    targets = np.vstack([one.targets, [[-0.1, 0.05, 0.02]]])
    start = replace(one, targets=targets, names=("left", "right"))
    shown, rng, d = [], np.random.default_rng(2), LiveTally(start)
    for wall, e in events(start, wrong=0.0):
        if isinstance(e, ReadingStored):
            right = residual(rng, 9.0) if e.stored > READINGS_BEFORE_MODEL else LiveResidual()
            e = replace(e, other_targets=((1, right),))
            d.add(e)
        shown.append((wall, e))
    path = recorded(tmp_path / "two.rrd", shown)
    starts = values(path, "/world/live/1/arrows", "Arrows3D:origins")
    both = [d.target_position(d.last.step, k) for k in (0, 1)]
    assert np.allclose(starts[-1], both, atol=1e-6)
    apart = np.linalg.norm(targets[1] - targets[0])
    assert np.linalg.norm(both[1] - both[0]) == pytest.approx(apart)
    assert "right" in values(path, "/world/live/1/last", "Points3D:labels")[-1][0]
    assert d.judged == 2 * (len(start.plan.steps) - READINGS_BEFORE_MODEL)
    assert {j.target for j in d.worst} == {"right"}
    assert " right |" in style.markdown(d.report())


def test_a_long_campaign_is_a_small_file(tmp_path):
    path = tmp_path / "long.rrd"
    outlet = live._Outlet("long", print, file=path)
    for wall, what in events(measuring(plan(250))):
        outlet.draw(wall, what)
    outlet.end()
    assert path.stat().st_size < 2.5e6  # 5.5 MB, when each reading was handed on by itself
    assert sum(map(len, of_levels(path))) == 500 - READINGS_BEFORE_MODEL


def test_the_arm_moves_through_every_place_that_is_told(measured):
    positions = [e for _, e in events(measuring()) if isinstance(e, ArmPosition)]
    places = np.array(values(measured, "/world/live/1/arm", "Capsules3D:translations"))
    assert len(places) == len(positions) + 1  # and where it begins
    assert np.abs(np.diff(places, axis=0)).max() > 0.05


def test_words_say_whether_the_model_fails_and_under_which_load():
    def status(wrong):
        d = LiveTally(measuring())
        assert "no judgement yet" in style.markdown(d.report())
        for _, e in events(measuring(), wrong):
            if isinstance(e, ReadingStored):
                d.add(e)
            elif isinstance(e, Remark):
                d.remarks.append(e.text)
        return style.markdown(d.report())

    bad, good = status(6.0), status(0.0)
    for words in (
        "✗ The simple model fails",
        "12 of 40 (30 %)",
        "| none | 16 | 0 |",
        "| 10kg | 24 | 12 |",
        "note: the reference pose has drifted",
    ):
        assert words in bad
    assert "✓ So far noise explains the readings" in good
    assert style.storable(bad) == bad


def test_what_earlier_sessions_stored_is_there_at_its_own_time(tmp_path):
    made = plan(6)
    start = measuring(made, tuple((1000.0 + k, step) for k, step in enumerate(made.steps[:4])))
    path = recorded(tmp_path / "resumed.rrd", [(2000.0, start)])
    assert len(values(path, "/world/live/1/dots", "Points3D:positions")) == 4
    dots = chunks(path, "/world/live/1/dots")
    times = [t for c in dots for t in c.to_record_batch()["time"].to_pylist()]
    assert [t.timestamp() for t in times] == [1000.0, 1001.0, 1002.0, 1003.0]


def test_the_errors_of_revisions_grow_one_by_one_and_end_as_the_whole_story(refined, tmp_path):
    growing = recorded(tmp_path / "growing.rrd", revisions(), end=False)
    assert len(values(growing, "/errors/fit", "BarChart:values")) == 4
    said = [row[0] for row in values(growing, "/words/verdict", "TextDocument:text")]
    assert all(" of " not in text.splitlines()[0] for text in said)  # nobody knows the last yet
    said = [row[0] for row in values(refined, "/words/verdict", "TextDocument:text")]
    assert any(text.startswith("### Revision 0 (1 of 4)") for text in said)
    arrows = values(growing, "/world/residual/arrows", "Arrows3D:vectors")
    norms = [np.linalg.norm(np.array(row), axis=1).max() for row in arrows]
    assert norms[-1] < 0.5 * norms[0]


def test_other_readings_begin_another_story(tmp_path):
    other = story(poses=12)
    timed_stories = [*revisions(), (9.0, replace(other, revisions=(other.revisions[-1],)))]
    path = recorded(tmp_path / "two.rrd", timed_stories, end=False)
    assert len(values(path, "/errors/fit", "BarChart:values")) == 5
    tables = [row[0] for row in values(path, "/words/revisions", "TextDocument:text")]
    assert tables[-1].count("\n|") < tables[-2].count("\n|")


def test_words_in_pictures_are_legible_in_both_themes(refined):
    boxes = (36, 38, 43), (123, 124, 126)  # of the viewer, measured in pictures of both themes
    assert min(contrast(style.LABEL, box) for box in boxes) > 4.0
    for row in values(refined, "/world/residual/worst", "Points3D:colors"):
        assert set(row) == {0xFFFFFFFF}


@pytest.mark.vulkan
@pytest.mark.slow
@needs_vulkan
def test_pictures_of_both_acts_are_drawn_without_a_report(measured, refined, tmp_path):
    for path in (measured, refined):
        reports = pictures(path, [Shot(tmp_path / "x.png")], (960, 540), 480)
        assert [v for v in reports if v.problems] == []
        assert len(reports) >= 4
        assert (tmp_path / "x.png").stat().st_size > 20_000
