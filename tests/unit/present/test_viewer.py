"""The recording, read back: what the story says is what the viewer gets."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation

from hilcal.present.document import table
from hilcal.present.story import levels, worst_and_even
from hilcal.present.viewer import campaign, save, style
from hilcal.robot.body import body_poses, capsules
from tests.support.recordings import rows, same, texts
from tests.support.viewer_story import ANGLE, LOAD, doubtful, story, ur10e

FORBIDDEN = "█▏░─│⟂∥∈∝ᵀ✘漢"
READINGS = 90


@pytest.fixture(autouse=True)
def _strict():
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture(scope="module")
def told():
    return story()


@pytest.fixture(scope="module")
def recording(told, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("viewer") / "story.rrd"
    save(told, path)
    return path


def test_every_revision_has_its_errors_in_micrometres(told, recording):
    expected = {
        "fit": [r.error.rms_m for r in told.revisions],
        "holdout": [r.holdout.rms_m for r in told.revisions],
        "largest": [r.error.max_m for r in told.revisions],
        "noise": [told.noise_floor_m] * len(told.revisions),
    }
    numbers = [r.revision for r in told.revisions]
    for name, sizes in expected.items():
        for shown in numbers:
            left, right, height = bars(recording, f"/errors/{name}", shown)
            np.testing.assert_allclose(height, 1e6 * np.array(sizes))
            assert ((np.array(numbers) - 0.5 < left) & (right < np.array(numbers) + 0.5)).all()


def bars(path: Path, entity: str, revision: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return left and right edges and heights of the bars of a revision."""
    left, width, height = (
        np.array(rows(path, entity, f"BarChart:{name}", "revision")[revision][0]["buffer"])
        if name != "widths"
        else np.array(rows(path, entity, f"BarChart:{name}", "revision")[revision])
        for name in ("abscissa", "widths", "values")
    )
    return left, left + width, height


def test_a_curve_is_drawn_by_bars_about_its_values(tmp_path):
    told, path = doubtful(), tmp_path / "doubt.rrd"
    save(told, path)
    left, right, height = bars(path, "/follows/mean", 2)
    np.testing.assert_allclose(height, ANGLE.y)
    assert ((left < ANGLE.x) & (ANGLE.x < right)).all()
    np.testing.assert_allclose(left[1:], right[:-1], rtol=1e-5)  # side by side
    assert 3 not in rows(path, "/follows/mean", "BarChart:values", "revision")  # nothing follows


def test_loads_stand_beside_each_other_in_their_order(tmp_path):
    told, path = doubtful(), tmp_path / "load.rrd"
    third = replace(told.revisions[2], follows=LOAD)
    save(replace(told, revisions=(third,)), path)
    left, right, height = bars(path, "/follows/mean", 2)
    np.testing.assert_allclose(height, LOAD.y)
    np.testing.assert_allclose(right - left, 1.0)


def test_readings_over_a_suspect_are_drawn_by_their_mean(told, recording):
    left, _, height = bars(recording, "/follows/mean", 0)
    assert 4 <= len(left) <= 12
    assert np.all(np.diff(left) > 0)
    follows = told.revisions[0].follows
    assert follows.y.min() <= height.min() <= height.max() <= follows.y.max()


def test_a_curve_of_one_bin_or_no_height_is_drawn(tmp_path):
    one = replace(ANGLE, x=np.ones(1), y=np.zeros(1), error=np.zeros(1))
    told = doubtful()
    save(replace(told, revisions=(replace(told.revisions[2], follows=one),)), tmp_path / "one.rrd")
    assert bars(tmp_path / "one.rrd", "/follows/mean", 2)[2].tolist() == [0.0]


def test_it_opens_at_the_first_revision_and_the_end_says_that_it_is_the_end(told, recording):
    read = rows(recording, "/words/verdict", "TextDocument:text", "revision")
    heads = [read[k][0].splitlines()[0] for k in range(4)]
    assert [("the last" in head) for head in heads] == [False, False, False, True]
    assert [f"({k + 1} of 4)" in head for k, head in enumerate(heads)] == [True] * 4
    reader = RrdReader(recording)
    (blueprint,) = reader.blueprints()
    panel: dict[str, object] = {}
    for chunk in reader.stream(store=blueprint).filter(content="/time_panel").to_chunks():
        panel |= chunk.to_record_batch().to_pydict()
    assert panel["TimePanelBlueprint:timeline"] == [["revision"]]
    assert panel["TimePanelBlueprint:play_state"] == [[1]]  # paused: else it opens at the end


def test_the_leader_of_the_worst_reading_is_no_arrow(told, recording):
    strips = rows(recording, "/world/residual/leader", "LineStrips3D:strips", "revision")
    balls, _ = campaign.noise_balls(told, np.arange(len(told)))
    for r in told.revisions:
        worst = int(np.argmax(r.whitened_norm2))
        dots = np.array([np.array(s) for s in strips[r.revision]]) - told.anchor[worst]
        assert len(dots) >= 5  # dotted
        np.testing.assert_allclose(dots[:, :, :2], 0.0, atol=1e-6)
        assert dots[:, :, 2].min() > min(balls[worst].max(), 0.25)  # begins outside of the ball
        lengths = np.ptp(dots[:, :, 2], axis=1)
        gaps = dots[1:, 0, 2] - dots[:-1, 1, 2]
        assert (gaps > lengths[:-1]).all()
    assert tuple(style.LEADER) not in {tuple(c) for c in style.LEVEL_COLORS.tolist()}


def test_the_tallest_bar_is_the_worst_reading_of_the_label(told, recording):
    labels = rows(recording, "/world/residual/worst", "Points3D:labels", "revision")
    for r in told.revisions:
        bars = [
            rows(recording, f"/bars/{name}", "BarChart:values", "revision")[r.revision][0]
            for name in style.LEVEL_NAMES
        ]
        tallest = max(max(b["buffer"]) for b in bars)
        assert f"({tallest:.1f} σ)" in labels[r.revision][0]


def test_a_pose_has_its_own_name_in_every_label_and_text(told, tmp_path):
    named = replace(told, pose_names=tuple(f"p{k + 40}a" for k in told.pose))
    path = tmp_path / "named.rrd"
    save(named, path)
    name = f"p{told.pose[np.argmax(told.revisions[-1].whitened_norm2)] + 40}a"
    worst = rows(path, "/world/residual/worst", "Points3D:labels", "revision")
    assert f"pose {name}," in worst[3][0]
    details = rows(path, "/words/details", "TextDocument:text", "revision")
    assert f"pose {name}," in details[3][0]
    cards = rows(path, "/words/verdict", "TextDocument:text", "pose")
    assert cards[7][0].startswith("### Pose p47a:")


def test_timelines_are_revision_and_pose(recording):
    names = {
        name for chunk in RrdReader(recording).stream().to_chunks() for name in chunk.timeline_names
    }
    assert names == {"revision", "pose"}


def test_every_reading_has_its_arrow(told, recording):
    drawn = rows(recording, "/world/residual/arrows", "Arrows3D:vectors", "revision")
    scale = campaign.residual_scale(told)
    for r in told.revisions:
        vectors = np.array(drawn[r.revision])
        assert vectors.shape == (READINGS, 3)
        length = np.linalg.norm(r.residual, axis=1) * scale
        np.testing.assert_allclose(
            np.linalg.norm(vectors, axis=1),
            np.minimum(length, campaign.ARROW_CAP),
            rtol=1e-5,
        )


def test_one_ball_per_pose_and_arm_moves_through_poses(told, recording):
    balls = rows(recording, "/world/residual/noise", "Ellipsoids3D:half_sizes", "revision")
    assert {len(b) for b in balls.values()} == {30}
    moves = rows(recording, "/world/arm/body6", "Transform3D:translation", "pose")
    bodies = body_poses(told.arm, told.q[::3])
    assert sorted(moves) == list(range(30))
    read = np.array([moves[k][0] for k in range(30)])
    np.testing.assert_allclose(read, bodies[:, 6, :3, 3], atol=1e-6)


def test_arm_stands_in_the_worst_pose(told, recording):
    stands = rows(recording, "/world/arm/body7", "Transform3D:translation", "revision")
    for r in told.revisions:
        i = int(np.argmax(r.whitened_norm2))
        expected = body_poses(told.arm, told.q[i : i + 1])[0, -1, :3, 3]
        np.testing.assert_allclose(stands[r.revision][0], expected, atol=1e-6)


def test_bars_hold_every_pose_once_under_its_level(told, recording):
    for r in told.revisions:
        total = 0
        for name in style.LEVEL_NAMES:
            bars = rows(recording, f"/bars/{name}", "BarChart:values", "revision")
            values = np.array(bars[r.revision][0]["buffer"], dtype=float)
            total += int((values > 0).sum())
        assert total == 30


def test_verdict_names_suspects_with_their_figures(told, recording):
    read = rows(recording, "/words/verdict", "TextDocument:text", "revision")
    first = read[0][0]
    assert "base_compliance" in first.replace("\\", "")
    assert "86 %" in first
    assert "84 %" in first
    assert "adequate" in read[3][0]
    assert "86 %" not in read[3][0]


def test_saving_twice_gives_equal_recordings(told, recording, tmp_path):
    again, other = tmp_path / "again.rrd", tmp_path / "other.rrd"
    save(told, again)
    save(story(seed=2), other)
    assert same(recording, again)
    assert not same(recording, other)


def test_no_character_without_a_glyph_reaches_the_viewer(tmp_path):
    path = tmp_path / "names.rrd"
    save(story(poses=4, names=f" |{FORBIDDEN}\U0001f916\t*x*"), path)
    found = texts(path)
    assert any("joint_tilt_compliance" in t.replace("\\", "") for t in found)
    assert [c for t in found for c in t if c in FORBIDDEN or ord(c) > 0x2FFF] == []
    assert [t for t in found if style.safe(t) != t] == []


def test_user_names_cannot_break_a_table():
    made = style.markdown([table("effect", "share", rows=[("a|b\nc", "50 %")])]).splitlines()
    assert len(made) == 3
    assert {len(re.findall(r"(?<!\\)\|", line)) for line in made} == {3}


def test_thousands_of_readings_stay_small_and_say_what_they_show(tmp_path):
    big, path = story(poses=3000, loads=1, mode="absolute"), tmp_path / "big.rrd"
    save(big, path)
    assert path.stat().st_size < 20e6
    arrows = rows(path, "/world/residual/arrows", "Arrows3D:vectors", "revision")
    assert all(100 < len(a) < 300 for a in arrows.values())
    title = campaign.titles(big)[0]
    assert f"about {len(arrows[0])} of 3000" in title
    balls = rows(path, "/world/residual/noise", "Ellipsoids3D:centers", "revision")
    origins = rows(path, "/world/residual/arrows", "Arrows3D:origins", "revision")
    for k in range(4):
        assert {tuple(c) for c in balls[k]} <= {tuple(o) for o in origins[k]}
    assert len(rows(path, "/world/arm/body3", "Transform3D:translation", "pose")) == 3000


def test_subsample_keeps_the_worst():
    badness = np.random.default_rng(0).random(1000)
    chosen = worst_and_even(badness, 50)
    assert len(chosen) <= 50
    assert set(np.argsort(-badness)[:10]) <= set(chosen.tolist())
    assert np.diff(chosen).max() < 100


def test_noise_balls_give_the_covariance_back():
    rng = np.random.default_rng(3)
    a = 1e-5 * rng.standard_normal((12, 3, 3))
    told = replace(story(poses=4, loads=3), covariance=a @ a.transpose(0, 2, 1) + 1e-10 * np.eye(3))
    half, quaternion = campaign.noise_balls(told, np.arange(12))
    half = half / (style.BALL_SIGMAS * campaign.residual_scale(told))
    rotation = Rotation.from_quat(quaternion).as_matrix()
    again = rotation * half[:, None] ** 2 @ rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(again, told.covariance, rtol=1e-9, atol=1e-18)


def test_levels_hold_the_share_of_noise_they_name():
    norm2 = np.random.default_rng(4).chisquare(3, 200_000)
    share = np.bincount(levels(norm2), minlength=3) / len(norm2)
    assert share[1] == pytest.approx(0.0099, abs=0.001)
    assert share[2] == pytest.approx(0.0001, abs=0.0001)


def test_the_arm_is_drawn_as_its_capsules(told, recording):
    for i in range(told.arm.n + 1):
        own = [c for c in capsules(told.arm) if c.body == i]
        entity = f"/world/arm/body{i}"
        (start,), (radius,), (length,), (turn,) = (
            [x for chunk in RrdReader(recording).stream().filter(content=entity).to_chunks()
             if name in (batch := chunk.to_record_batch()).schema.names
             for x in batch.column(name).to_pylist()]
            for name in ("Capsules3D:translations", "Capsules3D:radii", "Capsules3D:lengths",
                         "Capsules3D:quaternions")
        )  # fmt: skip
        assert len(own) >= 1
        np.testing.assert_allclose(start, [c.start for c in own], atol=1e-6)
        np.testing.assert_allclose(radius, [c.radius for c in own], atol=1e-6)
        axis = Rotation.from_quat(turn).apply([0.0, 0.0, 1.0])
        end = np.array(start) + np.array(length)[:, None] * axis
        np.testing.assert_allclose(end, [c.end for c in own], atol=1e-6)


def test_arm_of_another_shape_is_drawn(tmp_path):
    six = ur10e()
    four = replace(
        six,
        links=six.links[:5],
        masses=six.masses[:4],
        coms=six.coms[:4],
        joint_names=six.joint_names[:4],
    )
    told = story(poses=3)
    path = tmp_path / "four.rrd"
    save(replace(told, arm=four, q=told.q[:, :4]), path)
    assert len(rows(path, "/world/arm/body5", "Transform3D:translation", "pose")) == 3
