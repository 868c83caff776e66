"""What the viewer shows of doubts: unknown effects, rivals, and what could have been seen."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from hilcal.errors import InputError
from hilcal.present.story import Story, StoryLimit, StoryParameter, StoryRival, StorySuspect
from hilcal.present.viewer import flat, layout, save, style, words
from hilcal.present.viewer.residuals import title
from tests.support.picture import Shot, pictures, vulkan_available
from tests.support.viewer_story import ANGLE, LIMITS, LOAD, doubtful, story
from tests.unit.present.test_viewer import FORBIDDEN, column, texts

MISSING, AMBIGUOUS, UNKNOWN, ADEQUATE = range(4)
DOCUMENTS = ("verdict", "details")
POINTS, STRIPS = "Points2D:positions", "LineStrips2D:strips"


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("doubt") / "story.rrd"
    save(doubtful(), path)
    return path


def drawn(path: Path, part: str, component: str) -> dict[int, np.ndarray]:
    found = column(path, f"/regressor/{part}", component, "revision")
    return {k: np.array([np.array(x, dtype=float) for x in v]) for k, v in found.items()}


def labels(path: Path, revision: int) -> list[str]:
    return list(column(path, "/regressor/labels", "Points2D:labels", "revision")[revision])


def verdict(path: Path, revision: int) -> str:
    """Return the verdict and what it rests on."""
    found = [column(path, f"/words/{x}", "TextDocument:text", "revision") for x in DOCUMENTS]
    return "\n".join(str(x[revision][0]) for x in found).replace("\\", "")


def leading(curve) -> Story:
    """Return a story whose last revision has but this curve."""
    told = story(poses=3)
    last = replace(told.revisions[-1], verdict="unknown_effect", curves=(curve,))
    return replace(told, revisions=(last,))


def test_a_curve_is_drawn_to_scale_with_its_uncertainty(recording):
    at = drawn(recording, "points", POINTS)[UNKNOWN]
    ends = drawn(recording, "bars", STRIPS)[UNKNOWN]
    assert len(at) == len(ends) == len(ANGLE.x)
    for k, value in ((0, ANGLE.x), (1, -ANGLE.y)):  # y points down
        slope, start = np.polyfit(value, at[:, k], 1)
        assert slope > 0
        np.testing.assert_allclose(at[:, k], start + slope * value, atol=1e-3)
    np.testing.assert_allclose(ends[:, :, 0], np.stack([at[:, 0]] * 2, 1), atol=1e-4)
    np.testing.assert_allclose(ends.mean(1), at, atol=1e-4)
    np.testing.assert_allclose(
        np.abs(ends[:, 0, 1] - ends[:, 1, 1]), 4 * slope * ANGLE.error, rtol=1e-3
    )
    everything = np.concatenate([at, ends.reshape(-1, 2)])
    assert (everything >= 0).all()
    assert (everything <= (flat.WIDTH, flat.HEIGHT)).all()


def test_a_curve_says_what_it_is_with_units(recording):
    words_ = labels(recording, UNKNOWN)
    assert "Residual against joint 4 angle (unknown effect): mean ±2 σ" in words_
    assert "error of joint 2 [µrad] against joint 4 angle [°]" in words_
    assert {"-90", "0", "90"} <= set(words_)


def test_ticks_stand_at_their_values(recording):
    at = drawn(recording, "points", POINTS)[UNKNOWN]
    slope, start = np.polyfit(ANGLE.x, at[:, 0], 1)
    places = drawn(recording, "labels", POINTS)[UNKNOWN]
    place = dict(zip(labels(recording, UNKNOWN), places, strict=True))
    assert place["90"][0] == pytest.approx(start + slope * 90, abs=1e-3)
    assert place["-90"][0] == pytest.approx(start + slope * -90, abs=1e-3)


def test_loads_stand_by_name_and_are_not_joined(tmp_path):
    path = tmp_path / "load.rrd"
    save(leading(LOAD), path)
    words_ = labels(path, 3)
    assert {"none", "5kg", "10kg", f"{LOAD.y_label} against load"} <= set(words_)
    x = drawn(path, "points", POINTS)[3][:, 0]
    assert np.diff(x)[0] == pytest.approx(np.diff(x)[1])
    assert len(drawn(path, "trend", STRIPS)[3]) == 0


def test_what_a_revision_does_not_have_is_taken_away(recording):
    bars, trend = drawn(recording, "bars", STRIPS), drawn(recording, "trend", STRIPS)
    assert len(bars[MISSING]) == len(bars[AMBIGUOUS]) == 0
    assert len(trend[MISSING]) == 1
    assert len(trend[ADEQUATE]) == 0
    assert len(drawn(recording, "points", POINTS)[ADEQUATE]) == 0


def test_the_verdict_names_what_carries_the_misfit(recording):
    told = verdict(recording, UNKNOWN)
    assert "**joint 4 angle 71 %**, **load 23 %**" in told
    assert "carries" not in verdict(recording, MISSING)


def test_the_verdict_names_the_rivals_and_what_separates_them(recording):
    told = verdict(recording, AMBIGUOUS)
    lead = doubtful().revisions[AMBIGUOUS].suspects[0].effect
    assert f"ambiguous: {lead}, hysteresis or creep?" in told
    assert f"**hysteresis** can imitate 96 % of what **{lead}** does; 4.5 times as many" in told
    assert "**creep** can imitate 100 %" in told
    assert "no number of readings like these" in told
    assert "imitate" not in verdict(recording, MISSING)


def test_rivals_that_should_be_apart_may_both_be_wrong():
    assert "perhaps it is neither" in words.rivals("a", (StoryRival("b", 0.3, 0.2),))


def test_what_could_have_been_seen_is_drawn_and_listed(recording):
    seen = [s for s in LIMITS if np.isfinite(s.displacement_m)]
    bars = drawn(recording, "bars", STRIPS)[ADEQUATE]
    length = np.sort(np.ptp(bars[:, :, 0], axis=1))
    expected = np.array([s.displacement_m for s in seen])
    np.testing.assert_allclose(length / length[0], expected / expected[0], rtol=1e-4)
    words_ = labels(recording, ADEQUATE)
    assert {s.effect for s in seen} <= set(words_)
    assert "creep" not in words_
    assert "rms displacement of the target [µm]" in words_
    told = verdict(recording, ADEQUATE)
    assert "hysteresis from **11.0 µm**" in told
    assert "tracker_scale from **46.0 µm**" in told
    assert "cannot be seen: creep" in told
    table = str(column(recording, "/words/limits", "TextDocument:text", "revision")[ADEQUATE][0])
    assert "| 46.0 µm | 21 ppm |" in table
    assert "would these readings show creep" in table


def test_a_weak_suspect_is_named_in_the_title():
    r = replace(
        doubtful().revisions[UNKNOWN],
        verdict="missing_effect",
        suspects=(StorySuspect("creep", 0.1, 0.03, 1e-9),),
    )
    assert title(r) == "Residual against joint 4 angle (creep explains 3 % of it)"


def test_nothing_to_plot_is_said_in_words(tmp_path):
    told = story(poses=3)
    bare = replace(told.revisions[-1], limits=(StoryLimit("creep", np.inf, ""),))
    path = tmp_path / "bare.rrd"
    save(replace(told, revisions=(bare,)), path)
    assert labels(path, 3) == [title(bare)]
    assert "noise" in title(bare)
    assert "cannot show any effect" in verdict(path, 3)


def test_names_from_outside_keep_their_glyphs_safe(tmp_path):
    path = tmp_path / "names.rrd"
    save(doubtful(f" |{FORBIDDEN}\t*x*"), path)
    found = texts(path)
    assert any("joint 4 angle |" in t for t in found)
    assert [t for t in found if style.safe(t) != t] == []


@pytest.mark.parametrize(
    "bad",
    [
        replace(ANGLE, y=ANGLE.y[:3]),
        replace(ANGLE, error=np.full(5, np.nan)),
        replace(LOAD, names=("none",)),
        replace(ANGLE, x=np.zeros(0), y=np.zeros(0), error=np.zeros(0)),
    ],
)
def test_a_curve_that_does_not_fit_together_is_refused(bad, tmp_path):
    with pytest.raises(InputError, match=r"revision 3: .*the curve of (joint 4 angle|load)"):
        save(leading(bad), tmp_path / "x.rrd")


def test_a_curve_of_one_bin_or_no_height_is_drawn(tmp_path):
    one = replace(ANGLE, x=np.ones(1), y=np.zeros(1), error=np.zeros(1))
    path = tmp_path / "one.rrd"
    save(leading(one), path)
    at = drawn(path, "points", POINTS)[3]
    np.testing.assert_allclose(at, [[flat.WIDTH / 2, flat.HEIGHT / 2]], atol=1e-3)


@pytest.mark.parametrize("size", [1e-9, 0.3, 1.0, 7.0, 1e4])
def test_ticks_are_round_few_and_inside(size):
    for low in (-1.0, 0.0, 0.37):
        t = flat.ticks(low * size, (low + 1) * size, most=7)
        assert 2 <= len(t) <= 8
        assert t.min() >= low * size - 1e-9 * size
        assert t.max() <= (low + 1) * size * (1 + 1e-9)
        assert all(len(w) <= 7 for w in flat.numbers_at(t))
    assert set(flat.ticks(-200, 200, angle=True)) == {-180.0, -90.0, 0.0, 90.0, 180.0}


def test_parameters_are_told_in_units_for_people():
    told = (
        StoryParameter("joint_compliance.j1", 7.69e-6, 4.2e-8, "rad/(N·m)", True),
        StoryParameter("base_frame.x", -1.275e-4, 1.1e-6, "m", True),
        StoryParameter("mine.k", 0.5, None, "kg", True),
    )
    r = replace(story(poses=3).revisions[0], parameters=told)
    lines = words.parameters(r, 40).replace("\\", "").splitlines()
    assert "| joint_compliance.j1 | 7.690 | ± 0.042 | µrad/(N·m) |" in lines
    assert "| base_frame.x | -127.5 | ± 1.1 | µm |" in lines
    assert "| mine.k | 0.500 |   | kg |" in lines


@pytest.mark.vulkan
@pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")
def test_the_pictures_are_drawn_without_a_report(recording, tmp_path):
    shots = [
        Shot(tmp_path / f"{k}.png", "revision", k, name)
        for k, name in ((UNKNOWN, layout.FOLLOWS), (ADEQUATE, layout.FOLLOWS))
    ]
    shots.append(Shot(tmp_path / "limits.png", "revision", ADEQUATE, layout.LIMITS))
    reports = pictures(recording, shots, (960, 540), 480)
    assert [v for v in reports if v.problems] == []
    assert len({shot.png.read_bytes() for shot in shots}) == 3
