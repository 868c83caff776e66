"""`Engine.map`: a function of each item, in order, the same bits on any number of workers.

One worker computes in this process. Several are processes of this machine, threads of this one, or
those of a cluster that somebody has started (`dask scheduler`, `dask worker`). What does not depend
on how many there are or which computes what:

- the random numbers of an item: item k has the k-th child of `SeedSequence(seed)`;
- BLAS: one thread;
- the order of the results, and so of a sum over them.

A worker that dies costs no result: what it held is computed again. Ctrl-C leaves no process.
"""

import logging
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from hilcal.engine.tasks import Task, compute, versions
from hilcal.errors import HilcalError, InputError
from hilcal.threads import cores

if TYPE_CHECKING:  # takes half a second to import
    from distributed import Client

Item = TypeVar("Item")
Result = TypeVar("Result")
Advance = Callable[[int], None]

DEATHS = 3
"""Workers that one item may take with it before it is given up; Dask's own, a choice."""
ANSWER_S = 10.0
"""How long a cluster's scheduler may take to answer; a choice."""
WORKERS_S = 10.0
"""How long a cluster may have no worker at the start; a choice."""
END_S = 1.0
"""How long a worker may take to end by itself after Ctrl-C, before it is killed; a choice."""
LOOPBACK = "127.0.0.1"
SIGNALLED = 128
"""Exit code of a program that a signal ended, less the signal's number, as shells have it."""


class ClusterError(HilcalError):
    """A cluster does not answer, or an item kills its workers; exit code as of a device."""

    exit_code = 3


@dataclass(frozen=True, slots=True, eq=False)
class Engine:
    """Computes many items; made by `open_engine`.

    Attributes:
        client: connection to workers; None where this process computes.
        where: of the workers, for messages.
    """

    client: "Client | None"
    where: str

    def map(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        seed: int | None = None,
        advance: Advance | None = None,
    ) -> tuple[Result, ...]:
        """Return function(item) of every item, in order of the items.

        Args:
            function: of a module, which workers find by its name, or a `partial` of one. It must
                depend on its arguments alone.
            items: what it is called with.
            seed: with a seed the function is called with a generator of its own as well:
                function(item, generator).
            advance: told 1 for each item that is done.

        Raises:
            ClusterError: the cluster is gone, or an item ended every worker that computed it.
        """
        found: dict[int, Result] = {}
        for k, result in self.results(function, items, seed):
            found[k] = result
            if advance is not None:
                advance(1)
        return tuple(found[k] for k in range(len(items)))

    def results(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        seed: int | None = None,
    ) -> Iterator[tuple[int, Result]]:
        """Yield (number of the item, result) as they are done, in no order; see `map`."""
        seeds = _seeds(seed, len(items))
        if self.client is None:
            for k, item in enumerate(items):
                yield k, compute(function, item, seeds[k])
            return
        yield from self._of_workers(self.client, function, items, seeds)

    def _of_workers(
        self,
        client: "Client",
        function: Callable[..., Result],
        items: Sequence[Item],
        seeds: Sequence[np.random.SeedSequence | None],
    ) -> Iterator[tuple[int, Result]]:
        from distributed import KilledWorker, as_completed
        from distributed.client import FutureCancelledError

        if not items:
            return
        task = Task(function, versions())
        futures = client.map(task, list(items), list(seeds), pure=False)
        number = {future.key: k for k, future in enumerate(futures)}
        waiting = as_completed(futures, loop=client.loop, with_results=True)
        del futures  # so that a worker can forget what has been fetched
        try:
            for future, result in waiting:
                yield number[future.key], result
        except KilledWorker as error:
            raise ClusterError(
                f"{self.where}: one computation ended {DEATHS + 1} workers, each time without a "
                "word (out of memory?); start fewer workers, or larger ones"
            ) from error
        except (FutureCancelledError, OSError) as error:
            raise ClusterError(f"{self.where}: lost in the middle; start it again") from error
        finally:
            waiting.clear()


ALONE = Engine(None, "this process")
"""Computes in this process; BLAS has as many threads as it had."""


def _seeds(seed: int | None, count: int) -> Sequence[np.random.SeedSequence | None]:
    return [None] * count if seed is None else np.random.SeedSequence(seed).spawn(count)


@contextmanager
def open_engine(
    workers: int | None = None, scheduler: str | None = None, *, threads: bool = False
) -> Iterator[Engine]:
    """Yield an engine; its workers end with the block.

    Args:
        workers: processes of this machine, one per processor by default; 1 computes here.
        scheduler: address of a cluster's scheduler, in place of workers of this machine.
        threads: threads of this process in place of processes, for what mostly waits for the
            disk or computes in compiled code.

    Raises:
        InputError: both workers and a scheduler; a number below 1; an address that is none.
        ClusterError: nothing answers at the address.
    """
    if scheduler is not None and workers is not None:
        raise InputError("a cluster has its own workers; valid: --workers N or --scheduler ADDRESS")
    count = cores() if workers is None else workers
    if count < 1:
        raise InputError(f"--workers {count}; valid: a whole number from 1")
    if scheduler is None and count == 1:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1, user_api="blas"):
            yield Engine(None, "this process")
        return
    with ExitStack() as stack:
        if scheduler is not None:
            client = stack.enter_context(_cluster(scheduler))
            where = f"cluster {scheduler}"
        else:
            client = stack.enter_context(_own(count, threads))
            where = f"{count} workers of this machine"
        yield Engine(client, where)


@contextmanager
def _cluster(address: str) -> Iterator["Client"]:
    """Yield a connection to a cluster."""
    with _quiet():
        from distributed import Client

        try:
            client = Client(address, timeout=ANSWER_S, set_as_default=False)
        except ValueError as error:
            raise InputError(
                f"--scheduler {address}: not an address; valid: as `dask scheduler` prints it, "
                "tcp://host:8786"
            ) from error
        except OSError as error:
            raise ClusterError(
                f"--scheduler {address}: no scheduler answers within {ANSWER_S:g} s; start one "
                "with `dask scheduler --host ADDRESS`"
            ) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=WORKERS_S)
            except TimeoutError as error:
                raise ClusterError(
                    f"--scheduler {address}: the scheduler has no workers; start some with "
                    f"`dask worker {address}`"
                ) from error
            yield client


@contextmanager
def _own(count: int, threads: bool) -> Iterator["Client"]:
    """Yield a connection to workers of this machine, which nothing but this machine can reach."""
    with (
        _quiet(),
        _ended_in_order(),
        tempfile.TemporaryDirectory(
            prefix="hilcal-workers-", ignore_cleanup_errors=True
        ) as scratch,
    ):
        from distributed import Client, LocalCluster

        # What a worker that is killed leaves among temporary files goes with the folder.
        own: dict[str, Any] = {} if threads else {"env": {"TMPDIR": scratch}}
        # Ctrl-C is for this process: workers are born with it blocked, and those that replace
        # a dead one as well, because the thread that starts them inherits the mask.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            cluster = LocalCluster(
                n_workers=1 if threads else count,
                threads_per_worker=count if threads else 1,
                processes=not threads,
                host=None if threads else LOOPBACK,
                dashboard_address=f"{LOOPBACK}:0",
                worker_dashboard_address=f"{LOOPBACK}:0",
                scheduler_kwargs={"dashboard": False},
                memory_limit=0,
                local_directory=scratch,
                silence_logs=logging.CRITICAL,
                **own,
            )
            client = Client(cluster, set_as_default=False)
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        with cluster, client:
            try:
                yield client
            except BaseException:
                client.close()
                if not threads:  # what is being computed would be waited for
                    cluster.sync(_end, list(cluster.workers.values()))
                raise


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


async def _end(nannies: list[Any]) -> None:
    """End the processes of workers, whatever they are doing."""
    import asyncio  # slow to import

    kills = [nanny.kill(timeout=END_S) for nanny in nannies]
    await asyncio.gather(*kills, return_exceptions=True)


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep Dask's own words about workers that come and go from the operator's screen."""
    import dask
    import distributed  # its settings are complete before they are changed

    settings: dict[str, Any] = {
        "distributed.scheduler.allowed-failures": DEATHS,
        "distributed.admin.large-graph-warning-threshold": "1GB",
        "distributed.scheduler.http.routes": [],
        "distributed.worker.http.routes": [],
    }
    loggers = [logging.getLogger(name) for name in (distributed.__name__, "tornado")]
    levels = [logger.level for logger in loggers]
    with dask.config.set(settings):
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        try:
            yield
        finally:
            for logger, level in zip(loggers, levels, strict=True):
                logger.setLevel(level)
