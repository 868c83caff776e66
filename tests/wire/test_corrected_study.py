"""`studies corrected` on several workers: every cell once, and no device outlives its worker."""

import json
import os
import signal
import subprocess
import sys
import time

import psutil
import pytest

from hilcal.errors import HilcalError
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.cluster import WORKER, environment, running, scheduler
from tests.support.paths import ROOT

ARMS, EFFECT = ("ur3e", "ur10e"), "encoder_offset"
SIZE = ("--poses", "4", "--points", "2", "--arms", ",".join(ARMS), "--effects", EFFECT, "--json")
DEVICES = 4  # processes of a cell: world, arm, tracker, force sensor
MEASURING_S, CASES_S, END_S = 240.0, 600.0, 15.0
"""Longest until both cells measure, until both are done, and until a process is gone."""


def study(folder, *options, temporary=None):
    more = {} if temporary is None else {"TMPDIR": str(temporary)}
    return subprocess.Popen(
        [sys.executable, "-m", "studies", "corrected", str(folder), *SIZE, *options],
        env=environment() | {"OMP_NUM_THREADS": "1"} | more,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def until_both_measure(folder, process):
    end = time.monotonic() + MEASURING_S
    while min(readings(folder, arm) for arm in ARMS) < 2:
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end
        time.sleep(0.1)


def readings(folder, arm):
    try:
        with CampaignFile.open(folder / f"{arm}-{EFFECT}.hilcal", read_only=True) as campaign:
            return campaign.n_readings
    except HilcalError:  # not there yet
        return 0


def devices(*of):
    every = [p for pid in of for p in psutil.Process(pid).children(recursive=True)]
    return [p for p in every if "drivers." in " ".join(p.cmdline())]


def gone(family):
    return not psutil.wait_procs(family, timeout=END_S)[1]


@pytest.mark.slow
def test_ctrl_c(tmp_path):
    (temporary := tmp_path / "tmp").mkdir()
    process = study(tmp_path / "d", "--jobs", "2", temporary=temporary)
    try:
        until_both_measure(tmp_path / "d", process)
        family = psutil.Process(process.pid).children(recursive=True)
        assert len(devices(process.pid)) >= 2 * DEVICES
        os.killpg(process.pid, signal.SIGINT)
        told = process.communicate(timeout=60)[1]
    finally:
        process.kill()
    assert process.returncode == 130
    assert told.rstrip().endswith("interrupted")
    assert gone(family)
    assert not list(temporary.glob("hilcal-*"))
    for arm in ARMS:
        assert readings(tmp_path / "d", arm) >= 2


@pytest.mark.slow
def test_a_worker_of_a_cluster_is_killed(tmp_path):
    with scheduler() as address:
        start = ("dask", "worker", address, *WORKER)
        with running(*start) as doomed, running(*start) as other:
            process = study(tmp_path, "--scheduler", address)
            try:
                until_both_measure(tmp_path, process)
                lost = devices(doomed.pid)
                assert len(lost) >= DEVICES
                doomed.send_signal(signal.SIGKILL)
                assert gone(lost)
                out, told = process.communicate(timeout=CASES_S)
            finally:
                process.kill()
            assert process.returncode == 0, told
            assert devices(other.pid) == []
    cases = json.loads(out)["cases"]
    assert [c["arm"] for c in cases] == list(ARMS)
    for case in cases:
        error = case["error"]
        assert error["after"]["rms_m"] < 0.3 * error["before"]["rms_m"]
        with CampaignFile.open(tmp_path / f"{case['arm']}-{EFFECT}.hilcal", read_only=True) as c:
            assert c.n_readings == sum(len(plan.steps) for plan in RunLog(c).plans)
