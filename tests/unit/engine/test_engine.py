"""Many computations: the same bits wherever they run, and nothing lost or left."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from hilcal.engine.engine import ClusterError, open_engine
from hilcal.errors import InputError
from tests.support.cluster import HERE, WORKER, running, scheduler
from tests.support.engine_cases import refuse, singular_value
from tests.support.paths import ROOT

ITEMS = range(40)
SEED = 11


def here() -> tuple[float, ...]:
    with open_engine(1) as engine:
        return engine.map(singular_value, ITEMS, SEED)


@pytest.mark.slow
def test_a_cluster_gives_the_same_bits_though_a_worker_is_killed() -> None:
    with scheduler() as address:
        start = ("dask", "worker", address, *WORKER)
        with running(*start) as doomed, running(*start), open_engine(scheduler=address) as engine:
            assert engine.client is not None
            engine.client.wait_for_workers(2, timeout=60)
            done: list[int] = []

            def advance(step: int) -> None:
                done.append(step)
                if len(done) == 8:
                    doomed.send_signal(signal.SIGKILL)

            assert engine.map(singular_value, ITEMS, SEED, advance) == here()
            assert doomed.wait(5) == -signal.SIGKILL
            assert len(done) == len(ITEMS)


@pytest.mark.parametrize("threads", [pytest.param(False, marks=pytest.mark.slow), True])
def test_workers_of_this_machine_give_the_same_bits_and_listen_to_it_alone(threads: bool) -> None:
    with open_engine(2, threads=threads) as engine:
        this = psutil.Process()
        every = [this, *this.children(recursive=True)]
        bound = [c.laddr.ip for p in every for c in p.net_connections() if c.status == "LISTEN"]
        assert engine.map(singular_value, ITEMS, SEED) == here()
        with pytest.raises(ValueError, match="item 3 is odd"):
            engine.map(refuse, range(6))
    assert bound
    assert set(bound) == {"127.0.0.1"}


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_leaves_no_process_and_no_folder(kind: signal.Signals, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.support.engine_cases"],
        env=HERE | {"TMPDIR": str(tmp_path)},
        cwd=ROOT,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stderr is not None
    assert process.stderr.readline() == "ready\n"
    workers = psutil.Process(process.pid).children(recursive=True)
    assert len(workers) >= 2
    time.sleep(0.5)
    assert list(tmp_path.glob("hilcal-workers-*"))
    if kind is signal.SIGINT:  # as a terminal sends it: to all of them
        os.killpg(process.pid, kind)
    else:  # as a service manager does
        process.send_signal(kind)
    told = process.communicate(timeout=30)[1]
    _, alive = psutil.wait_procs(workers, timeout=5)
    assert not alive
    assert not list(tmp_path.glob("hilcal-workers-*"))
    if kind is signal.SIGINT:
        assert told.count("Traceback") == 1  # of the program itself, which does not catch it
        assert told.rstrip().endswith("KeyboardInterrupt")
    else:
        assert process.returncode == 128 + kind
        assert "Traceback" not in told


def test_what_is_no_cluster_is_said_in_one_line() -> None:
    with pytest.raises(InputError, match="not an address"), open_engine(scheduler="nowhere"):
        pass
    with pytest.raises(InputError, match="from 1"), open_engine(0):
        pass
    with (
        pytest.raises(InputError, match="own workers"),
        open_engine(2, "tcp://127.0.0.1:1"),
    ):
        pass


def test_a_scheduler_without_workers_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilcal.engine.engine.WORKERS_S", 0.2)
    with (
        scheduler() as address,
        pytest.raises(ClusterError, match="dask worker"),
        open_engine(scheduler=address),
    ):
        pass
