"""Commands that a live viewer, a real client, follows: nothing waits for it, and it sees all."""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil
import pytest
from rerun.chunk import RrdReader

from hilcal.present.viewer.recording import executable
from tests.support.bench_cases import BASE, store_campaign
from tests.support.campaign_cases import (
    STARVED,
    TRIES,
    EndedError,
    Run,
    check_complete,
    check_readings,
)
from tests.support.timing import wait_until

pytestmark = pytest.mark.slow

URL = re.compile(r"rerun\+http://127\.0\.0\.1:\d+/proxy")
LONG = 120.0


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    """Settings of the viewer go here."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))


@contextmanager
def follower(told, saved):
    """A viewer of its own that follows what a command serves."""
    url = URL.search(told)
    viewer = subprocess.Popen(
        [executable(), "--port", "auto", "--save", str(saved), url.group()],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        yield viewer
    finally:
        viewer.kill()
        viewer.wait()


def live_process(run):
    """The process that serves and records."""
    children = psutil.Process(run.process.pid).children(recursive=True)
    return next(p for p in children if "hilcal.present.live_viewer" in p.cmdline())


def drawn(recording):
    """Readings that a recording of one session shows, with those of earlier sessions."""
    count = 0
    for kind in ("arrows", "dots"):
        chunks = RrdReader(recording).stream().filter(content=f"/world/live/1/{kind}").to_chunks()
        count += sum(c.to_record_batch().num_rows for c in chunks)
    return count


@pytest.mark.usefixtures("nothing_goes_on")
def test_whatever_happens_to_the_viewer_the_campaign_is_whole(cell, path, tmp_path):
    recording = path.with_name("run.live.rrd")

    # Ctrl-C: the recording is complete, and no process is left
    run = Run(cell, path, "--view")
    run.some_readings()
    assert URL.search(run.output)
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
    with follower(run.output, tmp_path / "frozen.rrd") as viewer:
        time.sleep(0.5)
        viewer.send_signal(signal.SIGSTOP)
        run.some_readings()
        run.next_reading("a frozen viewer")
        os.kill(live_process(run).pid, signal.SIGKILL)
        run.next_reading("a killed process")
        assert "the live viewer has ended; everything else goes on" in run.output
        run.interrupt()
        run.end()
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


def revisions(recording):
    """The revisions whose verdicts a recording has."""
    try:
        chunks = RrdReader(recording).stream().filter(content="/words/verdict").to_chunks()
        batches = [c.to_record_batch() for c in chunks]
    except (ValueError, RuntimeError):  # nothing in it yet; a part of a message
        return set()
    selected = [b["revision"].to_pylist() for b in batches if "revision" in b.schema.names]
    return {k for one in selected for k in one}


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_added_and_removed_a_viewer_sees_both_revisions(tmp_path):
    run, log_file = store_campaign(tmp_path / "run.hilcal"), tmp_path / "told.txt"
    for word, expected in (("add", {1, 2}), ("remove", {1, 2, 3})):
        late = tmp_path / f"{word}.rrd"
        line = [sys.executable, "-m", "hilcal", word, str(run), BASE, "--view"]
        with log_file.open("w") as out:
            process = subprocess.Popen(line, stdout=out, stderr=out)
        wait_until(lambda: URL.search(log_file.read_text()) is not None, "served", LONG)
        with follower(log_file.read_text(), late):
            assert process.wait(LONG) == 0, log_file.read_text()
            # what it had sent when it ended
            wait_until(lambda late=late: revisions(late), "seen", LONG)
        recording = run.with_name("run.live.rrd")
        assert revisions(recording) == expected
        assert RrdReader(recording).store() is not None  # it has its footer: whole
