"""A Dask cluster on this machine, of processes that can be killed."""

import os
import re
import subprocess
import sys
from contextlib import contextmanager

import pytest

from tests.support.paths import ROOT

WORKER = ("--host", "127.0.0.1", "--no-nanny", "--no-dashboard", "--nthreads", "1")
"""Of `dask worker`, behind the address."""


def environment():
    """As it is now, with this checkout on the path."""
    return {**os.environ, "PYTHONPATH": str(ROOT)}


@contextmanager
def running(*command):
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        env=environment(),
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


@contextmanager
def scheduler(protocol="tcp"):
    """A real scheduler on loopback; its address."""
    host = ("--host", "127.0.0.1", "--protocol", protocol)
    command = ("dask", "scheduler", *host, "--port", "0", "--no-dashboard")
    with running(*command, "--dashboard-address", "127.0.0.1:0") as process:
        for line in process.stderr:
            if found := re.search(r"Scheduler at:\s*(\w+://127\S+)", line):
                yield found[1]
                return
    pytest.fail("no scheduler")


def certificates(folder, names):
    """Make an authority of each name, and a certificate `NAME-own` of it."""
    for name in names:
        key = ("-newkey", "rsa:2048", "-nodes", "-keyout")
        openssl(folder, "req", "-x509", *key, f"{name}.key", "-out", f"{name}.pem",
                "-subj", f"/CN={name}")  # fmt: skip
        openssl(folder, "req", *key, f"{name}-own.key", "-out", f"{name}.csr",
                "-subj", "/CN=localhost")  # fmt: skip
        openssl(folder, "x509", "-req", "-in", f"{name}.csr", "-CA", f"{name}.pem",
                "-CAkey", f"{name}.key", "-CAcreateserial", "-out", f"{name}-own.pem")  # fmt: skip


def openssl(folder, *arguments):
    subprocess.run(["openssl", *arguments], cwd=folder, check=True, capture_output=True)


def tls(folder, name):
    """Dask's configuration of an authority's certificate, for scheduler, worker and client."""
    at = "distributed.comm.tls"
    own = {"cert": f"{folder}/{name}-own.pem", "key": f"{folder}/{name}-own.key"}
    roles = {f"{at}.{role}.{k}": v for role in ("scheduler", "worker", "client")
             for k, v in own.items()}  # fmt: skip
    return {f"{at}.ca-file": f"{folder}/{name}.pem", **roles}


def in_environment(settings):
    """Dask's configuration as environment variables."""
    return {f"DASK_{k}".replace(".", "__").replace("-", "_").upper(): v
            for k, v in settings.items()}  # fmt: skip
