"""Workers that are processes of this machine, connected by pipes only.

Workers run code that they receive. A socket on the loopback address would admit every user of the
machine; a pipe has no name by which another process could open it.
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
import scipy.linalg  # loads scipy's BLAS, which is not numpy's, so that its threads can be limited
from threadpoolctl import threadpool_limits

from hilcal import __version__
from hilcal.errors import HilcalError, InputError

Versions = tuple[tuple[str, str], ...]

DEATHS = 3  # most workers that may die with one item before it is given up; Dask's own, a choice


class ClusterError(HilcalError):
    """A cluster does not answer, or an item kills its workers; exit code as for a device."""

    exit_code = 3


def deadly(where: str) -> ClusterError:
    """Return the error for an item whose workers all died."""
    return ClusterError(
        f"{where}: one computation ended {DEATHS + 1} workers, each time without a message (out of "
        "memory?); start fewer workers, or larger ones"
    )


def versions() -> Versions:
    """Return the versions of the packages that determine the last bits of a result."""
    return (
        ("hilcal", __version__),
        ("Python", ".".join(platform.python_version_tuple()[:2])),
        ("numpy", np.__version__),
        ("scipy", scipy.__version__),
    )


@cache
def one_blas_thread() -> None:
    """Limit BLAS to one thread in this process, permanently.

    The last bits of a sum depend on the number of threads.
    """
    threadpool_limits(limits=1, user_api="blas")


@dataclass(frozen=True, slots=True)
class Task:
    """A function for workers."""

    function: Callable[..., Any]  # of an item or, with seeds, of an item and a generator
    versions: Versions  # of the calling program

    def __call__(self, item: Any, seed: np.random.SeedSequence | None = None) -> Any:
        """Compute one item."""
        for (name, caller), (_, worker) in zip(self.versions, versions(), strict=True):
            if caller != worker:
                raise InputError(
                    f"a worker of the cluster has {name} {worker}, this program {caller}; start "
                    "the workers from an environment of the same lock"
                )
        one_blas_thread()
        return compute(self.function, item, seed)


def compute(
    function: Callable[..., Any], item: Any, seed: np.random.SeedSequence | None = None
) -> Any:
    """Compute one item in this process, without warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return function(item) if seed is None else function(item, np.random.default_rng(seed))


SIGNALLED = 128
"""Exit code of a program that a signal ended, minus the number of the signal, as in shells."""
_SPAWN = multiprocessing.get_context("spawn")  # a fork would copy locks that threads of BLAS hold


@contextmanager
def processes(count: int) -> Iterator["Processes"]:
    """Yield workers of this machine, which are killed at the end of the block."""
    # Temporary files of killed workers are deleted with the folder.
    folder: tempfile.TemporaryDirectory[str] = tempfile.TemporaryDirectory(
        prefix="hilcal-workers-", ignore_cleanup_errors=True
    )
    with _signals_as_exit(), folder as scratch:
        workers = Processes(count, scratch)
        try:
            yield workers
        finally:
            workers.end()


class Processes:
    """Workers, started on demand."""

    def __init__(self, count: int, scratch: str) -> None:
        """Start no worker yet; `scratch` is the folder of their temporary files."""
        self._count, self._scratch = count, scratch
        self._all: set[_Worker] = set()
        self._idle: list[_Worker] = []

    def results(
        self, task: Task, items: Sequence[Any], seeds: Sequence[np.random.SeedSequence | None]
    ) -> Iterator[tuple[int, Any]]:
        """Yield (number of the item, result) in the order of completion."""
        todo, deaths = deque(range(len(items))), Counter[int]()
        busy: dict[Any, tuple[_Worker, int]] = {}
        try:
            while todo or busy:
                while len(self._idle) < min(self._count - len(busy), len(todo)):
                    self._start()
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
            self._end([worker for worker, _ in busy.values()])  # their results are not needed

    def end(self) -> None:
        """Kill all workers."""
        self._end(list(self._all))

    def _start(self) -> None:
        # Only this process handles Ctrl-C: a worker starts with SIGINT blocked. Python 3.11
        # unblocks the signal when it starts the resource tracker, which therefore runs before.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            worker = _Worker(self._scratch)
            self._all.add(worker)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._idle.append(worker)

    def _end(self, workers: list["_Worker"]) -> None:
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.line.close()
            self._all.discard(worker)  # an abandoned `results` may end its workers again


class _Worker:
    """A process and the pipe to it."""

    def __init__(self, scratch: str) -> None:
        self.line, remote = _SPAWN.Pipe()
        self.process = _SPAWN.Process(target=_serve, args=(remote, scratch))
        self.process.start()
        remote.close()
        self._task: Task | None = None

    def give(self, task: Task, item: Any, seed: np.random.SeedSequence | None) -> None:
        """Send an item to compute; the last task is not sent again."""
        with suppress(ConnectionError):  # a dead worker; `results` notices the end of its pipe
            self.line.send_bytes(_packed((None if task is self._task else task, item, seed)))
        self._task = task


def _serve(line: "Connection[Any, Any]", scratch: str) -> None:
    """Run a worker: compute the items from the pipe until it is closed."""
    os.environ["TMPDIR"] = tempfile.tempdir = scratch
    threading.Thread(target=_end_with_parent, daemon=True).start()
    task: Any = None
    while True:
        try:
            new_task, item, seed = line.recv()
        except EOFError:
            return
        task = new_task or task
        try:
            answer = _packed((True, task(item, seed)))
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = _packed((False, error))
        line.send_bytes(answer)


def _packed(message: tuple[Any, ...]) -> bytes:
    """Pickle by protocol 5, which preserves any order of an array's axes in memory.

    The order of sums, and so their last bits, depend on that order; protocol 4 preserves only C and
    Fortran order.
    """
    return pickle.dumps(message, protocol=5)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _signals_as_exit() -> Iterator[None]:
    """Raise SystemExit in the block on SIGTERM and SIGHUP.

    By default these end the process at once and leave the workers' folder behind.
    """

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(SIGNALLED + number)

    kinds = []
    if threading.current_thread() is threading.main_thread():
        endings = (signal.SIGTERM, signal.SIGHUP)
        kinds = [kind for kind in endings if signal.getsignal(kind) is signal.SIG_DFL]
    for kind in kinds:
        signal.signal(kind, end)
    try:
        yield
    finally:
        for kind in kinds:
            signal.signal(kind, signal.SIG_DFL)
