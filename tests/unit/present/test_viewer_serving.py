"""Where a recording goes: into files that stay whole, and to viewers that come late."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from hilcal.errors import InputError
from hilcal.present.viewer import save, serve
from hilcal.present.viewer.recording import executable
from tests.support.paths import ROOT
from tests.support.viewer_story import story


@pytest.fixture(scope="module")
def told():
    return story()


def test_missing_folder_is_refused(told, tmp_path):
    with pytest.raises(InputError, match="no folder"):
        save(told, tmp_path / "none" / "x.rrd")


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_a_viewer_that_joins_late_gets_the_whole_story(told, tmp_path, monkeypatch, free_port):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    late = tmp_path / "late.rrd"
    with serve(told, port=free_port) as served:
        assert served.url == f"rerun+http://127.0.0.1:{free_port}/proxy"
        client = subprocess.Popen(
            [executable(), "--port", "auto", "--save", str(late), served.url],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            end = time.monotonic() + 30
            while not {"/errors/fit", "/bars/zcurrent"} <= entities(late):
                assert time.monotonic() < end, "the late viewer did not receive the story"
                time.sleep(0.1)
        finally:
            client.terminate()
            client.wait(10)


def entities(path: Path) -> set[str]:
    """Return the entities that a file holds so far; it may still be growing."""
    if not path.exists() or path.stat().st_size == 0:
        return set()
    try:
        return {str(c.entity_path) for c in RrdReader(path).stream().to_chunks()}
    except (ValueError, RuntimeError):  # nothing in it yet; a part of a message
        return set()


def test_a_port_in_use_is_refused(told, free_port):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", free_port))
        taken.listen()
        with (
            pytest.raises(InputError, match=f"{free_port}.*free port"),
            serve(told, port=free_port),
        ):
            pass


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="no file size limits on Windows")
def test_a_file_that_cannot_grow_leaves_what_was_there(tmp_path):
    path = tmp_path / "x.rrd"
    path.write_text("before")
    code = (
        "import resource, signal, sys; from pathlib import Path\n"
        "from tests.support.viewer_story import story; from hilcal.present.viewer import save\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, resource.RLIM_INFINITY))\n"
        "save(story(), Path(sys.argv[1]))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(path)],
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.stderr.strip().splitlines()[-1].startswith("hilcal.errors.InputError: ")
    assert "cannot be written" in done.stderr
    assert path.read_text() == "before"
    assert list(tmp_path.iterdir()) == [path]


@pytest.fixture
def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
