"""One piece of work at a time, and the files of the viewer by the loopback address alone."""

import contextlib
import threading

import psutil

from hilcal.errors import InputError
from hilcal.workbench import viewer
from hilcal.workbench.session import Work
from tests.support.timing import wait_until


def test_only_one_thing_is_done_at_a_time():
    work, go, done = Work(), threading.Event(), []

    def slow(say):
        go.wait(10)
        done.append("slow")

    assert work.start("Adding creep", slow)
    assert not work.start("Adding creep", slow)  # the second of a double click
    assert work.line == "Adding creep"
    go.set()
    wait_until(lambda: work.task is None, "done")
    assert (done, work.line, work.failure()) == (["slow"], "", "")


def test_progress_and_failures_are_lines():
    def fails(error):
        def do(say):
            raise error

        work = Work()
        assert work.start("Reading", do)
        wait_until(lambda: work.task is None, "done")
        return work.failure()

    assert fails(InputError("no such file")) == "no such file"
    refusal_text = fails(ZeroDivisionError("by\nzero"))
    assert refusal_text == "unexpected ZeroDivisionError: by zero; please report it"

    work, started, go = Work(), threading.Event(), threading.Event()

    def says(say):
        say("diagnosing")
        started.set()
        go.wait(10)

    work.start("Adding creep", says)
    assert started.wait(10)
    assert work.line == "Adding creep: diagnosing"
    go.set()


def test_the_viewers_files_come_by_the_loopback_address_alone():
    heard = set()
    done = threading.Event()

    def watch():
        while not done.wait(0.02):
            for process in psutil.Process().children(recursive=True):
                with contextlib.suppress(psutil.Error):  # it has ended
                    connections = process.net_connections("tcp")
                    heard.update(c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN)

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        files = viewer._fetched()
    finally:
        done.set()
        watcher.join()
    assert heard
    assert heard <= {"127.0.0.1", "::1"}
    assert files["re_viewer_bg.wasm"][:4] == b"\0asm"
