"""A running cluster of `dask scheduler` and `dask worker`.

Anybody who reaches a scheduler or a worker at a tcp:// address can run code there. With tls:// both
sides need certificates of the same authority; Dask's configuration names their files
(`distributed.comm.tls`, https://distributed.dask.org/en/stable/tls.html).
"""

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.engine.processes import ClusterError, Task, deadly
from hilcal.errors import InputError
from hilcal.optional import needed_by

if TYPE_CHECKING:  # takes half a second to import
    from distributed import Client

ANSWER_S = 10.0  # most time for the scheduler's answer, s; a choice
WORKERS_S = 10.0  # most time until a cluster has a worker, s; a choice


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
            raise deadly(f"cluster {self.address}") from error
        except (FutureCancelledError, OSError) as error:
            raise ClusterError(
                f"cluster {self.address}: lost in the middle; start it again"
            ) from error
        finally:
            waiting.clear()


@contextmanager
def cluster(address: str) -> Iterator[Cluster]:
    """Yield a connection to a cluster."""
    with _quiet():
        from distributed import Client

        if address.startswith("tls://"):
            _check_certificates(address)
        try:
            client = Client(address, timeout=ANSWER_S, set_as_default=False)
        except ValueError as error:
            raise InputError(
                f"--scheduler {address}: not an address; valid: as `dask scheduler` prints it, "
                "tcp://host:8786"
            ) from error
        except OSError as error:
            raise ClusterError(
                f"--scheduler {address}: no scheduler answers within {ANSWER_S:g} s, or none that "
                "takes tcp:// or our certificate; start one with `dask scheduler --host ADDRESS`"
            ) from error
        with client:
            try:
                client.wait_for_workers(1, timeout=WORKERS_S)
            except TimeoutError as error:
                raise ClusterError(
                    f"--scheduler {address}: the scheduler has no workers; start some with "
                    f"`dask worker {address}`"
                ) from error
            yield Cluster(client, address)


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
