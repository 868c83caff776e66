"""Cases on several processes: in any order, stoppable, and the same results every time."""

import multiprocessing
import signal
import threading
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait

from threadpoolctl import threadpool_limits

from studies.diagnosis import Asked, Outcome

Run = Callable[[Asked], Outcome]
Advance = Callable[[int], None]
_AHEAD = 4  # cases per process that wait for their turn


def run_all(
    questions: Sequence[Asked], run: Run, jobs: int, advance: Advance
) -> tuple[tuple[Outcome, ...], bool]:
    """Run all cases; those that are done, in order of the questions, and whether that is all.

    Ctrl-C ends it: cases that are running are let go, those that are done are returned.

    Args:
        questions: what to ask.
        run: runs a case; a function of a module, which other processes find by its name.
        jobs: processes; 1 runs all in this one.
        advance: told of each case that is done.
    """
    found: dict[int, Outcome] = {}
    try:
        if jobs == 1:
            for number, asked in enumerate(questions):
                found[number] = run(asked)
                advance(1)
        else:
            _on_processes(questions, run, jobs, advance, found)
    except KeyboardInterrupt:
        pass
    return tuple(found[k] for k in sorted(found)), len(found) == len(questions)


def _on_processes(
    questions: Sequence[Asked],
    run: Run,
    jobs: int,
    advance: Advance,
    found: dict[int, Outcome],
) -> None:
    # Processes of their own, not copies of this one: it has threads that draw the progress.
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_alone)
    waiting: dict[Future[Outcome], int] = {}
    ahead = iter(enumerate(questions))
    try:
        while True:
            while len(waiting) < _AHEAD * jobs and (item := next(ahead, None)) is not None:
                waiting[pool.submit(run, item[1])] = item[0]
            if not waiting:
                break
            for done in wait(waiting, return_when=FIRST_COMPLETED).done:
                found[waiting.pop(done)] = done.result()
                advance(1)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _alone() -> None:
    """Prepare a process of the pool: one thread, no warnings, an end with the one who began it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the one who started it
    warnings.simplefilter("ignore")
    threadpool_limits(limits=1, user_api="blas")
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _end_with(sentinel: int) -> None:
    """End at once when the process that started this one is no more."""
    import os
    from multiprocessing.connection import wait as wait_for

    wait_for([sentinel])
    os._exit(1)
