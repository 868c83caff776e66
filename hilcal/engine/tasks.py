"""What one computation is where it runs: one BLAS thread, its own random numbers, its versions."""

import platform
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import scipy
import scipy.linalg  # its BLAS is another library than numpy's, and must be loaded to be limited
from threadpoolctl import threadpool_limits

from hilcal import __version__
from hilcal.errors import HilcalError, InputError

Versions = tuple[tuple[str, str], ...]

DEATHS = 3
"""Workers that one item may take with it before it is given up; Dask's own, a choice."""


class ClusterError(HilcalError):
    """A cluster does not answer, or an item kills its workers; exit code as of a device."""

    exit_code = 3


def deadly(where: str) -> ClusterError:
    """Return the error of an item that ended every worker that computed it."""
    return ClusterError(
        f"{where}: one computation ended {DEATHS + 1} workers, each time without a word (out of "
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
