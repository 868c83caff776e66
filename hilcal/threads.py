"""Independent parts of one computation on the processors of this machine, by threads.

numpy and LAPACK compute outside of Python's lock, so that threads of this process share the arrays
and still use all processors. Each part depends on its arguments alone and computes as it would
alone, and results keep the order of the items: the same bits on any number of processors. Many
large computations, and those on other machines, are for `hilcal.engine`.
"""

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

MANY = 20_000
"""Rows from which on parts are computed one after the other. Each thread keeps what it has freed of
the copies that it makes: half a gigabyte in a refinement of 72,000 rows. A choice, for memory."""

_here = threading.local()


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], rows: int = 0
) -> list[Result]:
    """Return function(item) of every item, in order of the items.

    What a thread of this function calls computes its own items one after the other, as everything
    does where there is one processor.

    Args:
        function: of compiled code mostly; it must not wait for what its caller has locked, as a
            `cached_property` that is being computed.
        items: all in memory at once.
        rows: of the arrays that the function makes parts or copies of.
    """
    todo = list(items)
    count = min(cores(), len(todo))
    if count < 2 or rows > MANY or getattr(_here, "busy", False):
        return [function(item) for item in todo]
    with ThreadPoolExecutor(count, "hilcal", one_thread) as pool:
        return list(pool.map(function, todo))


@contextmanager
def beside(function: Callable[[], object], rows: int = 0) -> Iterator[None]:
    """Call a function in a thread beside the block, and wait for it at the end of the block.

    The function is called after the block where there is one processor, or rows are many. What it
    raises is raised at the end, unless the block raises itself.

    Args:
        function: of compiled code mostly, like the block.
        rows: of the arrays that the function works on.
    """
    if cores() < 2 or rows > MANY or getattr(_here, "busy", False):
        yield
        function()
        return
    with ThreadPoolExecutor(1, "hilcal", one_thread) as pool:
        done = pool.submit(function)
        yield
        done.result()


@contextmanager
def later() -> Iterator[Callable[[Callable[[], object], int], None]]:
    """Compute in a thread beside the block what the block asks for, one after the other.

    What is yielded takes a function of compiled code mostly, and the rows of the arrays that it
    works on: where they are many, or there is one processor for this thread, it is left undone. So
    it serves for what keeps its result, and is computed when that is needed. The block's end waits;
    what was raised is raised again where the result is needed.
    """
    if cores() < 2 or getattr(_here, "busy", False):
        yield lambda function, rows: None
        return
    pool = ThreadPoolExecutor(1, "hilcal", one_thread)

    def ask(function: Callable[[], object], rows: int) -> None:
        if rows <= MANY:
            pool.submit(function)

    try:
        yield ask
    finally:
        pool.shutdown(cancel_futures=True)


def one_thread() -> None:
    """Compute in this thread alone from here on, as a worker of many does."""
    _here.busy = True
