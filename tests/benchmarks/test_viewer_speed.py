"""How fluently the viewer shows 10,000 readings: processor time of its pictures, beside 100.

rerun's own viewer draws without a screen, by software; so what counts is not how long a picture
takes but how much longer than that of a small recording, in processor time of the viewer.
"""

import math
import os
from pathlib import Path
from statistics import median

import pytest

from hilcal.present.viewer import live, save
from tests.support.live_story import events, measuring, plan
from tests.support.picture import opened, vulkan_available
from tests.support.viewer_story import story

pytestmark = [
    pytest.mark.slow,
    pytest.mark.vulkan,
    pytest.mark.skipif(not vulkan_available(), reason="no Vulkan driver installed"),
]
SIZE = (960, 540)
PICTURES = 8
ROUNDS = 2
SMALL, LARGE = 102, 10_002
MOST = 1.5
TICKS = os.sysconf("SC_CLK_TCK")


def finished(readings, path):
    """Write the recording of a campaign with four revisions."""
    save(story(poses=readings // 3, loads=3), path)


def followed(readings, path):
    """Write what a live viewer was told of a campaign, as `--view` does."""
    outlet = live._Outlet("speed", print, file=path)
    for wall, event in events(measuring(plan(readings // 2))):
        outlet.draw(wall, event)
    outlet.end()


def spent(process):
    """Processor time of a process until now, ms."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return 1e3 * (int(fields[11]) + int(fields[12])) / TICKS


def turned(viewer):
    """Turn every 3-D view a little, again and again."""
    cos, sin = math.cos(0.1), math.sin(0.1)
    while True:
        parts = viewer.get_blueprint().blueprint
        for name, part in parts.items():
            eye = part.get("EyeControls3D")
            if eye:
                x, y, z = eye["position"]
                moved = [cos * x - sin * y, sin * x + cos * y, z]
                parts[name] = {**part, "EyeControls3D": {**eye, "position": moved}}
        viewer.set_blueprint(parts, of="recording")
        yield


def dragged(viewer, timeline):
    """Drag the time along the second half of a recording, again and again."""
    selected = [t for r in viewer.get_state().recordings for t in r.timelines if t.name == timeline]
    start, end = float(selected[0].start), float(selected[0].end)
    while True:
        for k in range(PICTURES):
            at = start + (end - start) * (0.5 + 0.5 * k / PICTURES)
            when = {"sequence": int(at)} if timeline == "pose" else {"timestamp": at / 1e9}
            viewer.set_time(timeline, play_state="paused", **when)
            yield


@pytest.mark.parametrize(("make", "timeline"), [(finished, "pose"), (followed, "time")])
def test_ten_thousand_readings_are_shown_as_fluently_as_a_hundred(
    make, timeline, tmp_path, benchmark, claim
):
    def cost(readings):
        """Processor time of a picture while the view is turned, and while time is dragged, ms."""
        path = tmp_path / f"{readings}.rrd"
        if not path.exists():
            make(readings, path)
        out = []
        with opened(path, SIZE) as (viewer, process):
            for move in (turned(viewer), dragged(viewer, timeline)):
                for _ in range(2):  # the first pictures wait for what is computed once
                    next(move)
                    viewer.take_screenshot(max_size=64)
                begun = spent(process)
                for _ in range(PICTURES):
                    next(move)
                    viewer.take_screenshot(max_size=64)
                out.append((spent(process) - begun) / PICTURES)
        return out[0], out[1]

    def measured():
        rounds = [(cost(SMALL), cost(LARGE)) for _ in range(ROUNDS)]
        few, many = ([r[k] for r in rounds] for k in (0, 1))
        return [median(c) for c in zip(*few, strict=True)], [
            median(c) for c in zip(*many, strict=True)
        ]

    few, many = benchmark.pedantic(measured, rounds=1)
    ratios = [b / a for a, b in zip(few, many, strict=True)]
    summary_text = "turned {:.2f} ({:.0f} ms), time dragged {:.2f} ({:.0f} ms) times 100 readings"
    words = summary_text.format(ratios[0], many[0], ratios[1], many[1])
    claim(f"viewer with 10,000 readings, {make.__name__}", words, f"{MOST:g}")
    assert max(ratios) <= MOST
