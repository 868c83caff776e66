"""A Dask cluster on this machine, of processes that can be killed."""

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from tests.support.paths import ROOT

HERE = {**os.environ, "PYTHONPATH": str(ROOT)}
WORKER = ("--host", "127.0.0.1", "--no-nanny", "--no-dashboard", "--nthreads", "1")
"""Of `dask worker`, behind the address."""


@contextmanager
def running(*command: str) -> "Iterator[subprocess.Popen[str]]":
    process = subprocess.Popen(
        [sys.executable, "-m", *command], env=HERE, cwd=ROOT, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def scheduler() -> Iterator[str]:
    """A real scheduler on loopback; its address."""
    command = ("dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard")
    with running(*command, "--dashboard-address", "127.0.0.1:0") as process:
        assert process.stderr is not None
        for line in process.stderr:
            if found := re.search(r"Scheduler at:\s*(tcp://127\S+)", line):
                yield found[1]
                return
    pytest.fail("no scheduler")
