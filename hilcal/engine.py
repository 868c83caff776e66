"""Many independent computations: `Engine.map`, bit-identical for any number of workers.

A single worker computes in this process. Several are processes of this machine or of a running
cluster (Dask). The following do not depend on the number of workers nor on the distribution of the
items:

- the random numbers: item k has the k-th child of `SeedSequence(seed)`;
- BLAS: one thread;
- the order of the results, and so of a sum over them.

The item of a worker that dies is computed again. Ctrl-C leaves no process.

Workers run code that they receive. Those of this machine are connected by pipes only: a socket on
the loopback address would admit every user of the machine; a pipe has no name by which another
process could open it. Anybody who reaches a scheduler or a worker at a tcp:// address can run code
there. With tls:// both sides need certificates of the same authority; Dask's configuration names
their files (`distributed.comm.tls`, https://distributed.dask.org/en/stable/tls.html).
"""

import logging
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
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, wraps
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np
import scipy
import scipy.linalg  # loads scipy's BLAS, which is not numpy's, so that its threads can be limited
from threadpoolctl import threadpool_limits

from hilcal import __version__
from hilcal.errors import HilcalError, InputError
from hilcal.optional import needed_by

if TYPE_CHECKING:  # takes half a second to import
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")
Parameters = ParamSpec("Parameters")
Advance = Callable[[int], None]
Counting = Callable[[str, int], AbstractContextManager[Advance]]
"""Shows the progress of a number of items under a label, as `present.progress.counting` does."""
Versions = tuple[tuple[str, str], ...]


def uncounted(label: str, total: int) -> AbstractContextManager[Advance]:
    """Show no progress."""
    return nullcontext(lambda step: None)


MOST_DEATHS = 3
"""Most workers that may die with one item before it is given up; as in Dask."""


class ClusterError(HilcalError):
    """A cluster does not answer, or an item kills its workers; exit code as for a device."""

    exit_code = 3


def worker_deaths(where: str) -> ClusterError:
    """Return the error for an item whose workers all died."""
    return ClusterError(
        f"{where}: one computation ended {MOST_DEATHS + 1} workers, each time without a message "
        "(out of memory?); start fewer workers, or larger ones"
    )


def versions() -> Versions:
    """Return the versions of the packages that determine the last bits of a result."""
    python = ".".join(platform.python_version_tuple()[:2])
    libraries = (("numpy", np.__version__), ("scipy", scipy.__version__))
    return ("hilcal", __version__), ("Python", python), *libraries


@cache
def one_blas_thread() -> None:
    """Limit BLAS to one thread in this process, permanently.

    The last bits of a sum depend on the number of threads.
    """
    threadpool_limits(limits=1, user_api="blas")


def with_one_blas_thread(work: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """Return the function with BLAS limited to one thread while it runs.

    Several gain nothing on small matrices, and where other programs compute, too, they wait for
    each other at every product.
    """

    @wraps(work)
    def limited(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        with threadpool_limits(limits=1, user_api="blas"):
            return work(*args, **kwargs)

    return limited


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


SIGNAL_EXIT = 128
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
            workers.end(list(workers.all))


class Processes:
    """Workers, started on demand."""

    def __init__(self, count: int, scratch: str) -> None:
        """Start no worker yet; `scratch` is the folder of their temporary files."""
        self._count, self._scratch = count, scratch
        self.all: set[_Worker] = set()
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
                        self.end([worker])
                        deaths[k] += 1
                        if deaths[k] > MOST_DEATHS:
                            raise worker_deaths(f"{self._count} workers of this machine") from error
                        todo.appendleft(k)
                        continue
                    self._idle.append(worker)
                    if not done:
                        raise result
                    yield k, result
        finally:
            self.end([worker for worker, _ in busy.values()])  # their results are not needed

    def _start(self) -> None:
        # Only this process handles Ctrl-C: a worker starts with SIGINT blocked. Python 3.11
        # unblocks the signal when it starts the resource tracker, which therefore runs before.
        resource_tracker.ensure_running()
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            worker = _Worker(self._scratch)
            self.all.add(worker)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._idle.append(worker)

    def end(self, workers: list["_Worker"]) -> None:
        """Kill some workers."""
        for worker in workers:
            worker.process.kill()
        for worker in workers:
            worker.process.join()
            worker.line.close()
            self.all.discard(worker)  # `results`, closed early, may end its workers again


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
    """Pickle by protocol 5: it keeps an array's order in memory, so the last bits of sums."""
    return pickle.dumps(message, protocol=5)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


@contextmanager
def _signals_as_exit() -> Iterator[None]:
    """Raise SystemExit on SIGTERM and SIGHUP, which would leave the workers' folder behind."""

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(SIGNAL_EXIT + number)

    main = threading.current_thread() is threading.main_thread()
    endings = (signal.SIGTERM, signal.SIGHUP) if main else ()
    kinds = [kind for kind in endings if signal.getsignal(kind) is signal.SIG_DFL]
    for kind in kinds:
        signal.signal(kind, end)
    try:
        yield
    finally:
        for kind in kinds:
            signal.signal(kind, signal.SIG_DFL)


ANSWER_TIMEOUT_S = 10.0  # most time for the scheduler's answer, s; a choice
WORKERS_TIMEOUT_S = 10.0  # most time until a cluster has a worker, s; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Cluster:
    """Workers behind a scheduler."""

    client: "Client"
    address: str

    def results(
        self, task: Task, items: Sequence[Any], seeds: Sequence[np.random.SeedSequence | None]
    ) -> Iterator[tuple[int, Any]]:
        """Yield (number of the item, result) in the order of completion."""
        from distributed import KilledWorker, as_completed
        from distributed.client import FutureCancelledError

        if not items:
            return
        futures = self.client.map(task, list(items), list(seeds), pure=False)
        number = {future.key: k for k, future in enumerate(futures)}
        waiting = as_completed(futures, loop=self.client.loop, with_results=True)
        del futures  # so that workers can release fetched results
        try:
            for future, result in waiting:
                yield number[future.key], result
        except KilledWorker as error:
            raise worker_deaths(f"cluster {self.address}") from error
        except (FutureCancelledError, OSError) as error:
            raise ClusterError(
                f"cluster {self.address}: the connection was lost; start the cluster again"
            ) from error
        finally:
            waiting.clear()


@contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """Yield a connection to a cluster."""
    with _quiet():
        import asyncio
        from concurrent.futures import ThreadPoolExecutor

        from distributed import Client

        if address.startswith("tls://"):
            _check_certificates(address)
        try:
            # A client that does not reach its scheduler may lock the next one when it is collected.
            with ThreadPoolExecutor(1) as apart:  # this thread may have a loop, as in a notebook
                apart.submit(asyncio.run, _reach(address)).result()
            client = Client(address, timeout=ANSWER_TIMEOUT_S, set_as_default=False)
        except ValueError as error:
            raise InputError(
                f"--scheduler {address}: not an address; valid: as `dask scheduler` prints it, "
                "tcp://host:8786"
            ) from error
        except OSError as error:
            raise ClusterError(
                f"--scheduler {address}: no scheduler answers within {ANSWER_TIMEOUT_S:g} s, "
                "or none that takes tcp:// or our certificate; start one with "
                "`dask scheduler --host ADDRESS`"
            ) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=WORKERS_TIMEOUT_S)
            except TimeoutError as error:
                raise ClusterError(
                    f"--scheduler {address}: the scheduler has no workers; start some with "
                    f"`dask worker {address}`"
                ) from error
            yield Cluster(client, address)


async def _reach(address: str) -> None:
    """Connect to a scheduler once; raises ValueError for no address, OSError without an answer."""
    import asyncio

    from distributed.comm.core import connect
    from distributed.security import Security

    arguments = Security().get_connection_args("client")
    async with asyncio.timeout(ANSWER_TIMEOUT_S):
        await (await connect(address, timeout=ANSWER_TIMEOUT_S, **arguments)).close()


def _check_certificates(address: str) -> None:
    """Raise InputError if certificates are not configured or cannot be read."""
    from distributed.security import Security

    why: object = "none are named"
    try:
        if Security().get_connection_args("client")["ssl_context"] is not None:
            return
    except OSError as error:
        why = error
    raise InputError(
        f"--scheduler {address}: no certificates ({why}); Dask's configuration names their files: "
        "distributed.comm.tls.ca-file, client.cert and client.key"
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress Dask's log messages on workers that come and go."""
    with needed_by("a cluster"):
        import dask
        import distributed  # loads its default settings, before they are changed

    loggers = [logging.getLogger(name) for name in (distributed.__name__, "tornado")]
    levels = [logger.level for logger in loggers]
    with dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GB"}):
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)


@dataclass(frozen=True, slots=True, eq=False)
class Engine:
    """Computes many items; created by `open_engine`."""

    workers: Processes | Cluster | None  # None: this process computes

    def map(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        seed: int | None = None,
        advance: Advance | None = None,
    ) -> tuple[Result, ...]:
        """Return function(item) of every item, in the order of the items."""
        results: dict[int, Result] = {}
        for k, result in self.results(function, items, seed):
            results[k] = result
            if advance is not None:
                advance(1)
        return tuple(results[k] for k in range(len(items)))

    def results(
        self, function: Callable[..., Result], items: Sequence[Item], seed: int | None = None
    ) -> Iterator[tuple[int, Result]]:
        """Yield (number of the item, result) in the order of completion; see `map`."""
        count = len(items)
        seeds = [None] * count if seed is None else np.random.SeedSequence(seed).spawn(count)
        if self.workers is None:
            for k, item in enumerate(items):
                yield k, compute(function, item, seeds[k])
            return
        yield from self.workers.results(Task(function, versions()), items, seeds)


IN_PROCESS = Engine(None)  # computes in this process, with the present number of BLAS threads


@contextmanager
def open_engine(workers: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """Yield an engine of processes of this machine or of a cluster; processes end with the block.

    Anybody who reaches a scheduler at a tcp:// address can run code there, and here; tls:// admits
    only holders of a certificate. An invalid address is an InputError, a silent one a ClusterError.
    """
    if scheduler is not None:
        if workers is not None:
            raise InputError(
                "a cluster has its own workers; valid: --workers N or --scheduler ADDRESS"
            )
        with cluster(scheduler) as remote:
            yield Engine(remote)
        return
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    if count < 1:
        raise InputError(f"--workers {count}; valid: a whole number from 1")
    if count == 1:
        with threadpool_limits(limits=1, user_api="blas"):
            yield IN_PROCESS
        return
    with processes(count) as local:
        yield Engine(local)
