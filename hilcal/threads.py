"""Independent parts of one computation on the processors of this machine, by threads.

numpy and LAPACK compute outside of Python's lock, so that threads of this process share the arrays
and still use all processors. Each part depends on its arguments alone and computes as it would
alone, and results keep the order of the items: the same bits on any number of processors. Many
large computations, and those on other machines, are for `hilcal.engine`.

Parts may have parts of their own. No thread begins where as many compute as there are processors;
those that wait for others do not count, so that what they wait for can use theirs.
"""

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cached_property
from typing import Any, TypeVar, overload

Item = TypeVar("Item")
Result = TypeVar("Result")

MANY = 20_000
"""Rows from which on parts are computed one after the other. Each thread keeps what it has freed of
the copies that it makes: half a gigabyte in a refinement of 72,000 rows. A choice, for memory."""

_here = threading.local()


def cores() -> int:
    """Return how many processors this process may use."""
    return len(os.sched_getaffinity(0))


class _Processors:
    """How many threads compute beside the one that asked first."""

    def __init__(self) -> None:
        self._more = 0
        self._changed = threading.Condition()

    def take(self) -> bool:
        """Take one more processor, if one is free."""
        with self._changed:
            free = self._more < cores() - 1
            self._more += free
        return free

    def wait_for_one(self) -> None:
        """Take one more processor as soon as one is free."""
        with self._changed:
            self._changed.wait_for(lambda: self._more < cores() - 1)
            self._more += 1

    def give_back(self) -> None:
        """Give back what was taken."""
        with self._changed:
            self._more -= 1
            self._changed.notify()

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """Let others have the processor of this thread, which waits for them in the block."""
        self.give_back()
        try:
            yield
        finally:
            with self._changed:
                self._more += 1


_processors = _Processors()


def in_threads(
    function: Callable[[Item], Result], items: Iterable[Item], rows: int = 0
) -> list[Result]:
    """Return function(item) of every item, in order of the items.

    Where several fail, the error of the first is raised, as it would be one after the other.

    Args:
        function: of compiled code mostly; it must not wait for what its caller has locked, as a
            property that is being computed.
        items: all in memory at once.
        rows: of the arrays that the function makes parts or copies of.
    """
    todo = list(items)
    if _alone(rows) or len(todo) < 2:
        return [function(item) for item in todo]
    work = _Work(function, todo)
    with ThreadPoolExecutor(len(todo), "hilcal") as pool:
        try:
            while work.left:
                if work.left > 1 and _processors.take():
                    pool.submit(_helping, work.next)
                else:
                    work.next()
        finally:
            work.stop()
            with _processors.waiting():
                pool.shutdown()
    return work.results()


class _Work:
    """The items of `in_threads`, each taken once, and their results."""

    def __init__(self, function: Callable[[Any], Any], items: list[Any]) -> None:
        self._function, self._items = function, items
        self._found: list[Any] = [None] * len(items)
        self._errors: dict[int, BaseException] = {}
        self._taken = 0
        self._lock = threading.Lock()

    @property
    def left(self) -> int:
        """Items that nobody has taken; none after an error."""
        return 0 if self._errors else len(self._items) - self._taken

    def stop(self) -> None:
        """Leave what nobody has taken."""
        with self._lock:
            self._taken = len(self._items)

    def next(self) -> bool:
        """Compute the next item, if there is one; whether there was."""
        with self._lock:
            if not self.left:
                return False
            number = self._taken
            self._taken += 1
        try:
            self._found[number] = self._function(self._items[number])
        except Exception as error:
            self._errors[number] = error
        return True

    def results(self) -> list[Any]:
        """Return the results, or raise the first error."""
        if self._errors:
            raise self._errors[min(self._errors)]
        return self._found


def _helping(compute_next: Callable[[], bool]) -> None:
    """Compute item after item on a processor that was taken for it."""
    try:
        while compute_next():
            pass
    finally:
        _processors.give_back()


@contextmanager
def later() -> Iterator[Callable[[Callable[[], object], int], None]]:
    """Compute beside the block what the block asks for, in that order, as processors are free.

    What is yielded takes a function of compiled code mostly, and the rows of the arrays that it
    works on: where they are many, or there is one processor for this thread, it is left undone, as
    is what was not begun at the end of the block. So it serves for what keeps its result (`once`),
    and is computed when that is needed. The block's end waits for what was begun; what was raised
    is raised again where the result is needed.
    """
    if _alone(0):
        yield lambda function, rows: None
        return
    pool = ThreadPoolExecutor(cores(), "hilcal")
    ended = threading.Event()

    def compute(function: Callable[[], object]) -> None:
        _processors.wait_for_one()
        try:
            if not ended.is_set():
                function()
        finally:
            _processors.give_back()

    def ask(function: Callable[[], object], rows: int) -> None:
        if rows <= MANY:
            pool.submit(compute, function)

    try:
        yield ask
    finally:
        ended.set()
        with _processors.waiting():
            pool.shutdown(cancel_futures=True)


class once(cached_property[Result]):  # noqa: N801 - a decorator, as the one that it extends
    """A property that is computed when it is first read, by one thread; others wait for it.

    Unlike `functools.cached_property`, which locks that property of all instances (Python 3.11) or
    computes it in every thread that reads it (3.12 and later).
    """

    def __init__(self, function: Callable[[Any], Result]) -> None:
        """Take what computes the property."""
        super().__init__(function)
        self._locks: dict[int, threading.RLock] = {}

    @overload
    def __get__(self, instance: None, owner: type[Any] | None = None) -> "once[Result]": ...
    @overload
    def __get__(self, instance: object, owner: type[Any] | None = None) -> Result: ...

    def __get__(self, instance: Any, owner: type[Any] | None = None) -> Any:
        """Return the property, computed if it is not known yet."""
        if instance is None:
            return self
        known, name = instance.__dict__, str(self.attrname)
        if name in known:
            return known[name]
        own = id(instance)
        lock = self._locks.setdefault(own, threading.RLock())
        if not lock.acquire(blocking=False):
            with _processors.waiting():
                lock.acquire()
        try:
            if name not in known:
                known[name] = self.func(instance)
            return known[name]
        finally:
            self._locks.pop(own, None)
            lock.release()


def _alone(rows: int) -> bool:
    """Whether this thread computes everything itself."""
    return cores() < 2 or rows > MANY or getattr(_here, "alone", False)


def one_thread() -> None:
    """Compute in this thread alone from here on, as a worker of many does."""
    _here.alone = True
