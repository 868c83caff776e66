"""One piece of work at a time, and the files of the viewer by the loopback address alone."""

import os
import threading
import time
from pathlib import Path

import pytest

from hilcal.errors import InputError
from hilcal.workbench import viewer
from hilcal.workbench.work import Work


def test_only_one_thing_is_done_at_a_time() -> None:
    work, go, done = Work(), threading.Event(), []

    def slow(say: object) -> None:
        go.wait(10)
        done.append("slow")

    assert work.start("Adding creep", slow)
    assert not work.start("Adding creep", slow)  # the second of a double click
    assert work.line == "Adding creep"
    go.set()
    assert work.wait(10)
    assert (done, work.line, work.failure()) == (["slow"], "", "")


def test_progress_and_failures_are_lines() -> None:
    def fails(error: Exception) -> str:
        def do(say: object) -> None:
            raise error

        work = Work()
        assert work.start("Reading", do)
        assert work.wait(10)
        return work.failure()

    assert fails(InputError("no such file")) == "no such file"
    told = fails(ZeroDivisionError("by\nzero"))
    assert told == "unexpected ZeroDivisionError: by zero; please report it"

    work, seen, go = Work(), threading.Event(), threading.Event()

    def says(say) -> None:  # type: ignore[no-untyped-def]
        say("diagnosing")
        seen.set()
        go.wait(10)

    work.start("Adding creep", says)
    assert seen.wait(10)
    assert work.line == "Adding creep: diagnosing"
    go.set()
    assert work.wait(10)


LISTENS = "0A"
LOOPBACK = ("0100007F", "00000000000000000000000001000000")


def listening() -> dict[str, str]:
    """Address, as the kernel writes it, of each listening socket of this machine by inode."""
    rows = [
        line.split()
        for table in ("tcp", "tcp6")
        for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]
    ]
    return {row[9]: row[1].partition(":")[0] for row in rows if row[3] == LISTENS}


def sockets_below(parent: int) -> set[str]:
    """Inodes of the sockets of all processes below one."""
    found, mine = set(), {parent}
    for process in sorted(Path("/proc").glob("[0-9]*"), key=lambda p: int(p.name)):
        try:
            above = int((process / "stat").read_text().rpartition(")")[2].split()[1])
            if above in mine:
                mine.add(int(process.name))
                open_files = [str(f.readlink()) for f in (process / "fd").iterdir()]
                found |= {f[8:-1] for f in open_files if f.startswith("socket:[")}
        except OSError:  # it has ended
            continue
    return found


@pytest.mark.skipif(not Path("/proc/net/tcp").exists(), reason="needs /proc of Linux")
def test_the_viewers_files_come_by_the_loopback_address_alone() -> None:
    seen: set[str] = set()
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            time.sleep(0.02)
            below = sockets_below(os.getpid())
            seen.update(address for inode, address in listening().items() if inode in below)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        files = viewer._fetched()
    finally:
        done.set()
        watcher.join()
    assert seen
    assert seen <= set(LOOPBACK)
    assert files["re_viewer_bg.wasm"][:4] == b"\0asm"
