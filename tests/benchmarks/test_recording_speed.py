"""Cost of a recording of 10,000 readings, and of telling a live viewer a reading."""

import time
from pathlib import Path
from typing import Any

import pytest
from rerun.chunk import RrdReader

from hilcal.present.live_viewer import LiveViewer
from hilcal.present.viewer import save
from tests.benchmarks.conftest import Claim
from tests.support.live_story import events, measuring, plan
from tests.support.viewer_story import story

pytestmark = pytest.mark.slow

ROUNDS = 4


def test_recording_of_ten_thousand_readings(tmp_path: Path, benchmark: Any, claim: Claim) -> None:
    told, path = story(poses=2500, loads=4), tmp_path / "x.rrd"
    walls, works = [], []

    def written() -> None:
        begun, work = time.perf_counter(), time.process_time()
        save(told, path)
        walls.append(time.perf_counter() - begun)
        works.append(time.process_time() - work)

    benchmark.pedantic(written, rounds=ROUNDS)
    chunks = RrdReader(path).stream().filter(content="/world/arm/body1").to_chunks()
    assert sum(c.to_record_batch().num_rows for c in chunks) >= 2500
    size = path.stat().st_size / 1e6
    claim(
        "recording of 10,000 readings and 4 revisions",
        f"{min(walls):.2f} s ({min(works):.2f} s of work, {size:.1f} MB)",
        "1 s",
    )


def test_telling_a_live_viewer(tmp_path: Path, benchmark: Any, claim: Claim) -> None:
    live = LiveViewer(tmp_path / "x.live.rrd", print)
    live.start()
    each = []

    def tell() -> None:
        for wall, what in events(measuring(plan(100))):
            begun = time.perf_counter()
            live._send(wall, what)
            each.append(time.perf_counter() - begun)

    try:
        benchmark.pedantic(tell, rounds=1)
    finally:
        live.close()
    assert live.dropped == 0
    claim("an event told to a live viewer", f"{1e6 * max(each):.0f} µs at most", "not blocking")
