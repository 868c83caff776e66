"""A campaign on simulated devices while a live viewer follows it: nothing waits for the viewer."""

import os
import re
import signal
import subprocess
import time
from pathlib import Path

import psutil
import pytest
from rerun.chunk import RrdReader

from hilcal.present.viewer.recording import executable
from tests.support.campaign_cases import (
    STARVED,
    TRIES,
    EndedError,
    Run,
    Site,
    check_complete,
    check_readings,
)

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("nothing_goes_on")]

MORE_READINGS = 12
URL = re.compile(r"rerun\+http://127\.0\.0\.1:\d+/proxy")


def live_process(run: Run) -> psutil.Process:
    """The process that serves and records."""
    children = psutil.Process(run.process.pid).children(recursive=True)
    return next(p for p in children if "hilcal.present.live_viewer" in p.cmdline())


def drawn(recording: Path) -> int:
    """Readings that a recording of one session shows, with those of earlier sessions."""
    found = 0
    for kind in ("arrows", "dots"):
        chunks = RrdReader(recording).stream().filter(content=f"/world/live/1/{kind}").to_chunks()
        found += sum(c.to_record_batch().num_rows for c in chunks)
    return found


def test_whatever_happens_to_the_viewer_the_campaign_is_whole(
    cell: Site, path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    recording = path.with_name("run.live.rrd")

    # Ctrl-C: the recording is complete, and no process is left
    run = Run(cell, path, "--view")
    run.some_readings()
    served = URL.search(run.output)
    assert served is not None
    run.interrupt()
    code, words = run.end()
    assert code == 130, words
    assert f"recorded {recording}" in words
    assert RrdReader(recording).store() is not None
    assert run.orphans() == []
    check_readings(cell, path)

    # a viewer that is frozen all the time, and then the process that is killed
    run = Run(cell, path, "--view")
    run.wait_until(lambda: URL.search(run.output) is not None, "viewer")
    found = URL.search(run.output)
    assert found is not None
    viewer = subprocess.Popen(
        [executable(), "--port", "auto", "--save", str(tmp_path / "frozen.rrd"), found.group()],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        time.sleep(0.5)
        viewer.send_signal(signal.SIGSTOP)
        run.some_readings()
        run.next_reading("a frozen viewer")
        os.kill(live_process(run).pid, signal.SIGKILL)
        run.next_reading("a killed process")
        assert "the live viewer has ended; everything else goes on" in run.output
        run.interrupt()
        run.end()
    finally:
        viewer.kill()
        viewer.wait()
    check_readings(cell, path)

    # to the end; what earlier sessions measured is in the recording as well
    for left in reversed(range(TRIES)):
        run = Run(cell, path, "--view")
        code, words = run.end(900.0)
        if code == 0:
            break
        if not left or not STARVED.search(words):
            raise EndedError(words)
    check_complete(cell, path)
    assert drawn(recording) == len(cell.plan.steps)
