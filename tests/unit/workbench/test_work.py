"""One piece of work at a time; what it raises is one line."""

import threading

from hilcal.errors import InputError
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
