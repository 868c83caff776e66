"""`add`, `remove` and a SIGTERM while a live viewer, a real client, follows."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from hilcal.present.viewer.recording import executable
from tests.support.bench_cases import BASE, store_campaign
from tests.support.timing import wait_until

pytestmark = pytest.mark.slow

URL = re.compile(r"rerun\+http://127\.0\.0\.1:\d+/proxy")
LONG = 120.0


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Settings of the viewer go here."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(tmp_path))
    monkeypatch.setenv("OMP_NUM_THREADS", "1")


def begun(folder: Path, *words: object) -> tuple["subprocess.Popen[str]", Path]:
    """A command with --view as a process, and what it tells."""
    told = folder / "told.txt"
    with told.open("w") as out:
        line = [sys.executable, "-m", "hilcal", *map(str, words), "--view"]
        return subprocess.Popen(line, stdout=out, stderr=out, text=True), told


def revisions(recording: Path) -> set[int]:
    """The revisions whose verdicts a recording has."""
    try:
        chunks = RrdReader(recording).stream().filter(content="/words/verdict").to_chunks()
        batches = [c.to_record_batch() for c in chunks]
    except (ValueError, RuntimeError):  # nothing in it yet; a part of a message
        return set()
    found = [b["revision"].to_pylist() for b in batches if "revision" in b.schema.names]
    return {k for one in found for k in one}


@pytest.mark.filterwarnings("ignore:RRD file has no footer")
def test_added_and_removed_a_viewer_sees_both_revisions(tmp_path: Path) -> None:
    run = store_campaign(tmp_path / "run.hilcal")
    for word, seen in (("add", {1, 2}), ("remove", {1, 2, 3})):
        process, told = begun(tmp_path, word, run, BASE)
        wait_until(lambda told=told: URL.search(told.read_text()), "served", LONG)
        url = URL.search(told.read_text())
        assert url is not None
        late = tmp_path / f"{word}.rrd"
        client = subprocess.Popen(
            [executable(), "--port", "auto", "--save", str(late), url.group()],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        try:
            assert process.wait(LONG) == 0, told.read_text()
            # what it had sent when it ended
            wait_until(lambda late=late: revisions(late), "seen", LONG)
        finally:
            client.kill()
            client.wait()
        recording = run.with_name("run.live.rrd")
        assert revisions(recording) == seen
        assert RrdReader(recording).store() is not None  # it has its footer: whole
