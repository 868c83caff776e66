"""Freed memory stays with the process; where the C library has no such option, nothing is done."""

import ctypes
import subprocess
import sys

import pytest

from hilcal.cli.memory import keep_freed_memory

ARRAYS = """
import resource
import numpy as np
from hilcal.cli.memory import keep_freed_memory
{}
for k in range(12):
    if k == 2:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    one = np.ones((4500, 1000))
    two = one * 2
    both = one + two
    del one, two, both
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(call: str) -> int:
    """Page faults of ten times three arrays of 36 MB, in a process of its own."""
    command = [sys.executable, "-c", ARRAYS.format(call)]
    return int(subprocess.run(command, capture_output=True, text=True, check=True).stdout)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="an option of glibc")
@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="an option of glibc")
def test_arrays_use_the_memory_of_earlier_ones() -> None:
    assert 10 * faults("keep_freed_memory()") < faults("")


def test_nothing_is_done_where_the_c_library_has_no_such_option(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    keep_freed_memory()
