"""`Engine.map`: a function of each item, in order, bit-identical for any number of workers.

A single worker computes in this process. Several are processes of this machine (`processes`) or of
a running cluster (`cluster`). The following do not depend on the number of workers nor on the
distribution of the items:

- the random numbers: item k has the k-th child of `SeedSequence(seed)`;
- BLAS: one thread;
- the order of the results, and so of a sum over them.

The item of a worker that dies is computed again. Ctrl-C leaves no process.
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


ALONE = Engine(None)  # computes in this process, with the present number of BLAS threads


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
        from threadpoolctl import threadpool_limits

        with threadpool_limits(limits=1, user_api="blas"):
            yield ALONE
        return
    with processes(count) as local:
        yield Engine(local)
