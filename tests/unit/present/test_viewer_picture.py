"""A recording becomes a picture, headless, without a complaint from any view."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rerun as rr

from hilcal.errors import HilcalError, InputError
from hilcal.present.story import levels
from hilcal.present.viewer import campaign, save, style
from tests.support import picture
from tests.support.picture import Shot, pictures, pixels, vulkan_available
from tests.support.viewer_story import doubtful, story

SIZE, LONGEST = (960, 540), 480
LONG = (
    "base_compliance explains 100 % of the misfit, 96 % on poses left out (p = 5e-08), but these "
    "readings do not separate it from joint_tilt_compliance (24 times as many readings like these "
    "would), link_compliance (2.1 times as many readings like these would); hilcal next plans what "
    "separates them, or add one and judge on new poses."
)
needs_vulkan = pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed")


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    rr.set_strict_mode(True)
    path = tmp_path_factory.mktemp("picture") / "story.rrd"
    save(story(), path)
    rr.set_strict_mode(False)
    return path


def share_of_red(picture_: np.ndarray) -> float:
    """Return the share of pixels in the colour of a reading that the model fails."""
    distance = np.abs(picture_[..., :3].astype(int) - style.RED).max(axis=2)
    return float((distance < 40).mean())


def colors(picture_: np.ndarray) -> int:
    return len(np.unique(picture_.reshape(-1, picture_.shape[2]), axis=0))


@pytest.mark.vulkan
@needs_vulkan
def test_the_picture_shows_the_red_vanish(recording, tmp_path):
    told = story()
    reached = [levels(r.whitened_norm2).max() for r in told.revisions]
    assert (reached[0], reached[3] < 2) == (2, True)  # red at first, none in the end
    view = campaign.titles(told)[0]
    shots = [Shot(tmp_path / f"{k}.png", "revision", k, view) for k in (0, 3)]
    reports = pictures(recording, shots, SIZE, LONGEST)
    assert len(reports) >= 10
    assert [v for v in reports if v.problems] == []
    first, last = (pixels(s.png) for s in shots)
    assert colors(first) > 500
    assert share_of_red(first) > 0
    assert share_of_red(last) == 0


@pytest.mark.long
@pytest.mark.vulkan
@needs_vulkan
def test_in_a_small_window_the_verdict_ends_above_its_edge(tmp_path):
    path = tmp_path / "doubt.rrd"
    told = doubtful()
    long = replace(told.revisions[1], panels={"verdict": (LONG,)})
    save(replace(told, revisions=(told.revisions[0], long, *told.revisions[2:])), path)
    shots = [Shot(tmp_path / f"{k}.png", "revision", k, "Verdict") for k in range(4)]
    pictures(path, shots, (1280, 720))
    for shot in shots:
        drawn = pixels(shot.png)[..., :3].astype(int)
        rows = np.flatnonzero((np.abs(drawn - drawn[-1, 2]).max(axis=2) > 40).any(axis=1))
        assert len(rows) > 25
        assert rows.max() < 0.97 * len(drawn), shot  # the last line is whole


@pytest.mark.vulkan
@pytest.mark.slow
@needs_vulkan
def test_every_view_is_drawn_without_a_report(recording, tmp_path):
    d = story()
    names = [
        *campaign.titles(d),
        *(
            "Verdict",
            "Details",
            campaign.ERRORS,
            "How to read this",
            campaign.FOLLOWS,
            "Table",
            "Log",
        ),
        "Parameters ± σ",
    ]
    shots = [Shot(tmp_path / f"{i}.png", "revision", 1, n) for i, n in enumerate(names)]
    shots.append(Shot(tmp_path / "pose.png", "pose", 7))
    reports = pictures(recording, shots, SIZE, LONGEST)
    assert set(names) <= {v.name for v in reports}
    assert [v for v in reports if v.problems] == []
    for shot in shots:
        assert colors(pixels(shot.png)) > 20, shot


@pytest.mark.long
@pytest.mark.vulkan
@needs_vulkan
def test_unknown_timeline_and_view_are_named(recording, tmp_path):
    with pytest.raises(InputError, match=r"no timeline 'frame'; the recording has .*revision"):
        picture.picture(recording, tmp_path / "a.png", "frame", 0, size=(320, 200))
    with pytest.raises(InputError, match=r"no view 'Nothing'; the recording has .*Verdict"):
        picture.picture(recording, tmp_path / "a.png", view="Nothing", size=(320, 200))


def test_missing_recording_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no such file"):
        picture.picture(tmp_path / "none.rrd", tmp_path / "a.png")


def test_missing_driver_says_what_to_install(recording, tmp_path, monkeypatch):
    monkeypatch.setenv("VK_DRIVER_FILES", str(tmp_path / "none.json"))
    assert not vulkan_available()
    with pytest.raises(HilcalError, match="mesa-vulkan-drivers"):
        picture.picture(recording, tmp_path / "a.png")
