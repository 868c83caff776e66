"""`Engine.map`: a function of each item, in order, the same bits on any number of workers.

One worker computes in this process. Several are processes of this machine (`processes`), or those
of a cluster that somebody has started (`cluster`). What does not depend on how many there are or
which computes what:

- the random numbers of an item: item k has the k-th child of `SeedSequence(seed)`;
- BLAS: one thread;
- the order of the results, and so of a sum over them.

A worker that dies costs no result: what it held is computed again. Ctrl-C leaves no process.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from hilcal.engine.cluster import Cluster, cluster
from hilcal.engine.processes import Processes, Task, compute, processes, versions
from hilcal.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")
Advance = Callable[[int], None]


@dataclass(frozen=True, slots=True, eq=False)
class Engine:
    """Computes many items; made by `open_engine`."""

    workers: Processes | Cluster | None  # what computes; None where this process does

    def map(
        self,
        function: Callable[..., Result],
        items: Sequence[Item],
        seed: int | None = None,
        advance: Advance | None = None,
    ) -> tuple[Result, ...]:
        """Return function(item) of every item, in order of the items."""
        found: dict[int, Result] = {}
        for k, result in self.results(function, items, seed):
            found[k] = result
            if advance is not None:
                advance(1)
        return tuple(found[k] for k in range(len(items)))

    def results(
        self, function: Callable[..., Result], items: Sequence[Item], seed: int | None = None
    ) -> Iterator[tuple[int, Result]]:
        """Yield (number of the item, result) as they are done, in no order; see `map`."""
        count = len(items)
        seeds = [None] * count if seed is None else np.random.SeedSequence(seed).spawn(count)
        if self.workers is None:
            for k, item in enumerate(items):
                yield k, compute(function, item, seeds[k])
            return
        yield from self.workers.results(Task(function, versions()), items, seeds)


ALONE = Engine(None)  # Computes in this process; BLAS has as many threads as it had


@contextmanager
def open_engine(workers: int | None = None, scheduler: str | None = None) -> Iterator[Engine]:
    """Yield an engine of processes of this machine, or a cluster; workers end with the block.

    Whoever reaches a scheduler at a tcp:// address can run code there, and here; tls:// keeps
    others out. An address that is none is an InputError, one where nothing answers a ClusterError.
    """
    if scheduler is not None:
        if workers is not None:
            raise InputError(
                "a cluster has its own workers; valid: --workers N or --scheduler ADDRESS"
            )
        with cluster(scheduler) as there:
            yield Engine(there)
        return
    count = len(os.sched_getaffinity(0)) if workers is None else workers
    if count < 1:
        raise InputError(f"--workers {count}; valid: a whole number from 1")
    if count == 1:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1, user_api="blas"):
            yield ALONE
        return
    with processes(count) as here:
        yield Engine(here)
