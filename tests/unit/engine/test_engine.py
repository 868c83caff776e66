"""Many computations: the same bits wherever they run, and nothing lost or left."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from functools import partial
from itertools import permutations
from pathlib import Path

import dask
import numpy as np
import psutil
import pytest

from hilcal.engine import ClusterError, open_engine
from hilcal.errors import InputError
from tests.support.engine_cases import die_once, negative, refuse, singular_value, strides, wait
from tests.support.paths import ROOT

ITEMS = range(40)
SEED = 11


def here():
    with open_engine(1) as engine:
        return engine.map(singular_value, ITEMS, SEED)


def test_workers_of_this_machine_give_the_same_bits_and_can_be_reached_by_nobody():
    before = sockets()  # of what the tests before this one have left
    with open_engine(2) as engine:
        assert engine.map(singular_value, ITEMS, SEED) == here()
        going = engine.results(wait, range(2))
        assert next(going) == (0, 0)
        assert len(workers()) == 2
        assert set(sockets()) <= set(before)
        going.close()  # while a worker computes
        with pytest.raises(ValueError, match="item 3 is odd"):
            engine.map(refuse, range(6))
        large = [np.full(200_000, k) for k in range(6)]  # more than a pipe holds
        assert [results[-1] for results in engine.map(negative, large)] == [-k for k in range(6)]
        turned = [np.zeros((2, 3, 4)).transpose(axes) for axes in permutations(range(3))]
        assert engine.map(strides, turned) == tuple(map(strides, turned))
    assert not workers()


def workers():
    """Every process below this one but that which Python keeps for its semaphores."""
    every = psutil.Process().children(recursive=True)
    alive = [p for p in every if p.status() != psutil.STATUS_ZOMBIE]
    return [p for p in alive if "resource_tracker" not in " ".join(p.cmdline())]


def sockets():
    """What the processes of the engine listen at, or have on a network; this process included."""
    every = [psutil.Process(), *workers()]
    return [
        f"{c.laddr} {c.status}"
        for p in every
        for c in p.net_connections("all")
        if c.family != socket.AF_UNIX or c.laddr
    ]


@pytest.mark.long
def test_what_a_killed_worker_held_is_computed_by_another(tmp_path):
    with open_engine(2) as engine:
        results = engine.map(partial(die_once, folder=tmp_path), range(6))
        assert results == tuple(range(6))
        assert len(list(tmp_path.iterdir())) == 2
        with pytest.raises(ClusterError, match=r"ended 4 workers") as ended:
            engine.map(partial(die_once, folder=tmp_path / "none"), range(6))
        assert ended.value.exit_code == 3
        assert engine.map(refuse, range(2)) == (0, 1)  # nothing of it is left


QUICK, SLOW = signal.SIGINT, (signal.SIGTERM, signal.SIGHUP, signal.SIGKILL)


@pytest.mark.parametrize("kind", [QUICK, *(pytest.param(k, marks=pytest.mark.slow) for k in SLOW)])
def test_a_signal_leaves_no_process_and_no_folder(kind, tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.support.engine_cases"],
        env=environment() | {"TMPDIR": str(tmp_path)},
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr.readline() == "computing\n"  # by the first of its workers
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    assert list(tmp_path.glob("hilcal-workers-*"))
    if kind is signal.SIGINT:  # as a terminal sends it: to all of them, and only one heeds it
        assert all(deaf(worker.pid, kind) for worker in workers)
        os.killpg(process.pid, kind)
    else:  # as a service manager does
        process.send_signal(kind)
    stderr = process.communicate(timeout=30)[1]
    _, alive = psutil.wait_procs(workers, timeout=5)
    assert not alive
    if kind is signal.SIGKILL:  # nothing can be tidied
        return
    assert not list(tmp_path.glob("hilcal-workers-*"))
    if kind is signal.SIGINT:
        assert stderr.count("Traceback") == 1  # of the program itself, which does not catch it
        assert stderr.rstrip().endswith("KeyboardInterrupt")
    else:
        assert process.returncode == 128 + kind
        assert "Traceback" not in stderr


def deaf(pid, number):
    """Whether a process blocks or ignores a signal; proc(5), SigBlk and SigIgn."""
    lines = Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines()
    masks = [int(line.split()[1], 16) for line in lines if line.startswith(("SigBlk", "SigIgn"))]
    return any(mask & 1 << (number - 1) for mask in masks)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="needs openssl")
def test_a_cluster_with_certificates(tmp_path, monkeypatch):
    certificates(tmp_path, ("ours", "theirs"))
    for name, value in in_environment(tls(tmp_path, "ours")).items():
        monkeypatch.setenv(name, value)  # of the cluster's processes
    with scheduler("tls") as address, running("dask", "worker", address, *WORKER):
        with dask.config.set(tls(tmp_path, "ours")), open_engine(scheduler=address) as engine:
            assert engine.map(singular_value, ITEMS, SEED) == here()
        with (
            dask.config.set(tls(tmp_path, "theirs")),
            pytest.raises(ClusterError, match="our certificate"),
            open_engine(scheduler=address),
        ):
            pass


def test_certificates_that_are_not_there_are_said_in_one_line(tmp_path):
    for settings, why in (({}, "none are named"), (tls(tmp_path, "none"), "No such file")):
        with (
            dask.config.set(settings),
            pytest.raises(InputError, match=why),
            open_engine(scheduler="tls://127.0.0.1:1"),
        ):
            pass


@pytest.mark.parametrize(
    ("workers", "address", "message"),
    [
        (None, "nowhere", "not an address"),
        (0, None, "from 1"),
        (2, "tcp://127.0.0.1:1", "own workers"),
    ],
)
def test_what_is_no_cluster_is_said_in_one_line(workers, address, message, monkeypatch):
    # A client that fails holds a lock for ever if it is collected while the next one starts.
    monkeypatch.setattr("distributed.Client", None)
    with pytest.raises(InputError, match=message), open_engine(workers, address):
        pass


def test_a_scheduler_without_workers_is_refused(monkeypatch):
    monkeypatch.setattr("hilcal.engine.WORKERS_TIMEOUT_S", 0.2)
    with (
        scheduler() as address,
        pytest.raises(ClusterError, match="dask worker"),
        open_engine(scheduler=address),
    ):
        pass


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
            if match := re.search(r"Scheduler at:\s*(\w+://127\S+)", line):
                yield match[1]
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
    certificate = {"cert": f"{folder}/{name}-own.pem", "key": f"{folder}/{name}-own.key"}
    roles = {f"{at}.{role}.{k}": v for role in ("scheduler", "worker", "client")
             for k, v in certificate.items()}  # fmt: skip
    return {f"{at}.ca-file": f"{folder}/{name}.pem", **roles}


def in_environment(settings):
    """Dask's configuration as environment variables."""
    return {f"DASK_{k}".replace(".", "__").replace("-", "_").upper(): v
            for k, v in settings.items()}  # fmt: skip
