"""Workers that are processes of this machine, reached by pipes alone; what one computes.

A socket on the loopback address would let every user of the machine in, and what a worker is given
to run is code. A pipe has two ends, and no name by which another process could find it.
"""

import multiprocessing
import os
import pickle
import platform
import signal
import tempfile
import threading
import traceback
import warnings
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

import numpy as np
import scipy
import scipy.linalg  # its BLAS is another library than numpy's, and must be loaded to be limited
from threadpoolctl import threadpool_limits

from hilcal import __version__
from hilcal.errors import HilcalError, InputError

Versions = tuple[tuple[str, str], ...]

DEATHS = 3  # Workers that one item may take with it before it is given up; Dask's own, a choice


class ClusterError(HilcalError):
    """A cluster does not answer, or an item kills its workers; exit code as of a device."""

    exit_code = 3


def deadly(where: str) -> ClusterError:
    """Return the error of an item that ended every worker that computed it."""
    return ClusterError(
        f"{where}: one computation ended {DEATHS + 1} workers, each time without a message (out of "
        "memory?); start fewer workers, or larger ones"
    )


def versions() -> Versions:
    """Return the versions that decide the last bits of a result."""
    return (
        ("hilcal", __version__),
        ("Python", ".".join(platform.python_version_tuple()[:2])),
        ("numpy", np.__version__),
        ("scipy", scipy.__version__),
    )


@cache
def one_blas_thread() -> None:
    """Limit BLAS to one thread in this process, for good.

    The order of a sum over several threads depends on how many there are, and so do its last bits.
    """
    threadpool_limits(limits=1, user_api="blas")


@dataclass(frozen=True, slots=True)
class Task:
    """A function as it runs on a worker."""

    function: Callable[..., Any]  # of an item, or of an item and a generator where there are seeds
    versions: Versions  # of the program that asked

    def __call__(self, item: Any, seed: np.random.SeedSequence | None = None) -> Any:
        """Compute one item."""
        for (name, there), (_, here) in zip(self.versions, versions(), strict=True):
            if there != here:
                raise InputError(
                    f"a worker of the cluster has {name} {here}, this program {there}; start the "
                    "workers from an environment of the same lock"
                )
        one_blas_thread()
        return compute(self.function, item, seed)


def compute(
    function: Callable[..., Any], item: Any, seed: np.random.SeedSequence | None = None
) -> Any:
    """Compute one item in this process; warnings are not for the reader of a result."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(item) if seed is None else function(item, np.random.default_rng(seed))


SIGNALLED = 128
"""Exit code of a program that a signal ended, less the signal's number, as shells have it."""
_SPAWN = multiprocessing.get_context("spawn")  # a fork would copy locks that threads of BLAS hold


@contextmanager
def processes(count: int) -> Iterator["Processes"]:
    """Yield workers of this machine; they end with the block, whatever they are at."""
    # What a worker that is killed leaves among temporary files goes with the folder.
    folder: tempfile.TemporaryDirectory[str] = tempfile.TemporaryDirectory(
        prefix="hilcal-workers-", ignore_cleanup_errors=True
    )
    with _ended_in_order(), folder as scratch:
        workers = Processes(count, scratch)
        try:
            yield workers
        finally:
            workers.end()


class Processes:
    """Workers, begun when there is something for them."""

    def __init__(self, count: int, scratch: str) -> None:
        """Begin none yet; `scratch` is the folder of their temporary files."""
        self._count, self._scratch = count, scratch
        self._all: set[_Worker] = set()
        self._idle: list[_Worker] = []

    def results(
        self, task: Task, items: Sequence[Any], seeds: Sequence[np.random.SeedSequence | None]
    ) -> Iterator[tuple[int, Any]]:
        """Yield (number of the item, result) as they are done."""
        todo, deaths = deque(range(len(items))), Counter[int]()
        busy: dict[Any, tuple[_Worker, int]] = {}
        try:
            while todo or busy:
                while len(self._idle) < min(self._count - len(busy), len(todo)):
                    self._begin()
                while todo and len(busy) < self._count:
                    worker, k = self._idle.pop(), todo.popleft()
                    busy[worker.line] = worker, k
                    worker.give(task, items[k], seeds[k])
                for line in wait(list(busy)):
                    worker, k = busy.pop(line)
                    try:
                        done, result = worker.line.recv()
                    except (EOFError, ConnectionError) as error:
                        self._end([worker])
                        deaths[k] += 1
                        if deaths[k] > DEATHS:
                            raise deadly(f"{self._count} workers of this machine") from error
                        todo.appendleft(k)
                        continue
                    self._idle.append(worker)
                    if not done:
                        raise result
                    yield k, result
        finally:
            self._end([worker for worker, _ in busy.values()])  # nobody waits for them any more

    def end(self) -> None:
        """End all of them."""
        self._end(list(self._all))

    def _begin(self) -> None:
        # Ctrl-C is for this process: a worker is born with it blocked. Python 3.11 unblocks it
        # where the first worker starts the tracker of resources, so that is started before.
        resource_tracker.ensure_running()
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            worker = _Worker(self._scratch)
            self._all.add(worker)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._idle.append(worker)

    def _end(self, workers: list["_Worker"]) -> None:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.line.close()
            self._all.discard(worker)  # results that are given up later end theirs again


class _Worker:
    """A process and the line to it."""

    def __init__(self, scratch: str) -> None:
        self.line, there = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(there, scratch))
        self.process.start()
        there.close()
        self._task: Task | None = None

    def give(self, task: Task, item: Any, seed: np.random.SeedSequence | None) -> None:
        """Let it compute an item; a task that it has is not sent again."""
        with suppress(ConnectionError):  # it is dead, as the end of its line will tell
            self.line.send_bytes(_packed((None if task is self._task else task, item, seed)))
        self._task = task


def _serve(line: "Connection[Any, Any]", scratch: str) -> None:
    """Compute what comes over the line until it is closed, in the process of a worker."""
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    threading.Thread(target=_end_with_parent, daemon=True).start()
    task: Any = None
    while True:
        try:
            given, item, seed = line.recv()
        except EOFError:
            return
        task = given or task
        try:
            answer = _packed((True, task(item, seed)))
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = _packed((False, error))
        line.send_bytes(answer)


def _packed(message: tuple[Any, ...]) -> bytes:
    """Pickle by protocol 5, which keeps the order of an array's axes in memory.

    The order of sums depends on it, and so do the last bits; protocol 4 keeps only C and Fortran's.
    """
    return pickle.dumps(message, protocol=5)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _ended_in_order() -> Iterator[None]:
    """Let a plea to end, or a closed terminal, leave the block as Ctrl-C does.

    Their default ends the process at once, and leaves the workers' folder behind.
    """

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(SIGNALLED + number)

    kinds = []
    if threading.current_thread() is threading.main_thread():
        both = (signal.SIGTERM, signal.SIGHUP)
        kinds = [kind for kind in both if signal.getsignal(kind) is signal.SIG_DFL]
    for kind in kinds:
        signal.signal(kind, end)
    try:
        yield
    finally:
        for kind in kinds:
            signal.signal(kind, signal.SIG_DFL)
