"""The process of a live viewer: whatever becomes of it or of its viewers, nothing waits for it."""

import os
import signal
import socket
import subprocess
import sys
import time
from contextlib import contextmanager

import psutil
import pytest
from rerun.chunk import RrdReader

from hilcal.measuring.progress import ReadingStored
from hilcal.present import live_viewer
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.viewer.recording import executable
from hilcal.present.viewer.style import LEVEL_NAMES
from tests.support.live_story import READINGS_BEFORE_MODEL, events, measuring, plan
from tests.support.paths import ROOT
from tests.support.timing import wait_until

SOON = 0.05
"""A call that only puts something into a queue takes less, s, on a machine that is busy, too."""
posix = pytest.mark.skipif(os.name != "posix", reason="signals")
growing = pytest.mark.filterwarnings("ignore:RRD file has no footer")


@pytest.fixture
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    return tmp_path


@pytest.fixture
def said():
    return []


@pytest.fixture
def live(home, said, free_port):
    """A started viewer on a free port."""
    made = LiveViewer(home / "run.live.rrd", said.append, free_port)
    made.start()
    yield made
    made.close()


def tell(live, poses=24, paced=False):
    """Tell a campaign as fast as it goes; returns how long the slowest call took, s.

    If `paced`, no faster than the process draws.
    """
    slowest = 0.0
    for _, what in events(measuring(plan(poses))):
        while paced and live._queue.qsize() > live_viewer.MAX_MESSAGES // 2:
            time.sleep(0.01)
        begun = time.perf_counter()
        live._send(time.time(), what)
        slowest = max(slowest, time.perf_counter() - begun)
    return slowest


@contextmanager
def client(url, path):
    """A viewer without a window, that saves what it gets."""
    command = [executable(), "--port", "auto", "--save", str(path), url]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def readings(path):
    """Compared readings that a recording has so far; it may still be growing."""
    if not path.exists() or path.stat().st_size == 0:
        return 0
    try:
        streams = [RrdReader(path).stream().filter(content=f"/live/1/{n}") for n in LEVEL_NAMES]
        batches = [c.to_record_batch() for stream in streams for c in stream.to_chunks()]
        return sum(b.num_rows for b in batches if "Scalars:scalars" in b.schema.names)
    except (ValueError, RuntimeError):  # nothing in it yet; a part of a message
        return 0


def alive(pid):
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


@growing
@pytest.mark.long
def test_a_viewer_that_comes_late_gets_all_and_the_recording_has_it_too(home, said):
    with socket.socket() as listener:  # the wanted port: the next one is taken instead
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        live = LiveViewer(home / "run.live.rrd", said.append, port)
        live.start()
    try:
        assert live.url.startswith("rerun+http://127.0.0.1:")
        assert str(port) not in live.url
        process = psutil.Process(live._process.pid)
        listening = [c.laddr.ip for c in process.net_connections() if c.status == "LISTEN"]
        assert listening == ["127.0.0.1"]
        assert process.nice() > 0
        assert tell(live, 24) < SOON
        in_batches = 0.9 * (48 - READINGS_BEFORE_MODEL)
        wait_until(lambda: readings(live.record) >= in_batches, "recorded")
        with client(live.url, late := home / "late.rrd"):
            wait_until(
                lambda: readings(late) == 48 - READINGS_BEFORE_MODEL, "all with the late viewer"
            )
    finally:
        live.close()
    assert readings(live.record) == 48 - READINGS_BEFORE_MODEL
    assert RrdReader(live.record).store() is not None  # it has its footer: whole
    assert (said, live.dropped, alive(process.pid)) == ([], 0, False)


@pytest.mark.slow
@posix
def test_a_process_that_is_frozen_is_dropped_and_ended(live, said, monkeypatch):
    monkeypatch.setattr(live_viewer, "END_S", 1.0)
    pid = live._process.pid
    os.kill(pid, signal.SIGSTOP)
    assert tell(live, 1500) < SOON
    assert live._queue.qsize() <= live_viewer.MAX_MESSAGES
    assert live.dropped > 0
    begun = time.monotonic()
    live.close()
    assert time.monotonic() - begun < 10.0
    assert not alive(pid)
    assert "did not end" in said[0]
    assert "messages are not recorded" in said[1]


@pytest.mark.slow
def test_no_free_port_is_said_and_the_recording_is_written_all_the_same(home, said):
    live = LiveViewer(home / "run.live.rrd", said.append, 70_000)
    live.start()
    assert live.url is None
    tell(live, 12)
    live.close()
    assert [s for s in said if s.startswith("no free port from 70000")] == said
    assert readings(live.record) == 24 - READINGS_BEFORE_MODEL


PROGRAM = """
import os, resource, signal, sys, time
from pathlib import Path
from tests.unit.present.test_live_viewer import tell
from hilcal.present.live_viewer import LiveViewer
{before}
live = LiveViewer(Path(sys.argv[1]), print, int(sys.argv[2]))
live.start()
slowest = tell(live, {poses})
{after}
"""
FULL = PROGRAM.format(
    before="resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))",
    poses=60,
    after='time.sleep(3)\nprint("goes on", live.url is not None, slowest < 0.05)\nlive.close()',
)
KILLED = PROGRAM.format(
    before="",
    poses=24,
    after="while live._queue.qsize():\n    time.sleep(0.01)\n"
    "print(live._process.pid, flush=True)\nos.kill(os.getpid(), signal.SIGKILL)",
)


def run(code, path, port):
    """Let a program of its own tell a campaign; returns what it printed."""
    command, env = [sys.executable, "-c", code, str(path), str(port)], {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        command, env=os.environ | env, capture_output=True, text=True, check=False, timeout=120
    )
    return done.stdout + done.stderr


@pytest.mark.slow
@posix
def test_a_full_disk_ends_the_recording_only(home, free_port):
    printed = run(FULL, home / "full.live.rrd", free_port)
    assert printed.count("cannot be written") == 1
    assert "everything else goes on" in printed
    assert "goes on True True" in printed


@pytest.mark.slow
@posix
def test_the_recording_is_whole_although_the_command_was_killed(home, free_port):
    path = home / "killed.live.rrd"
    pid = int(run(KILLED, path, free_port).split()[-1])
    wait_until(lambda: not alive(pid), "ended")
    assert RrdReader(path).store() is not None
    assert readings(path) == 48 - READINGS_BEFORE_MODEL


def test_what_has_no_process_is_silent(tmp_path, said):
    live = LiveViewer(tmp_path / "x.rrd", said.append)
    live.notify(ReadingStored(plan().steps[0], 1, 2, 0.0))
    live.close()
    assert (said, live.dropped, live._process) == ([], 0, None)
