"""`calibrate --rehearse`, killed at random moments: it finishes, with every reading once."""

import os
import signal
import time

import numpy as np
import pytest

from hilcal.procedure.state import IMPROVED, next_step
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.procedure_log import ProcedureLog
from tests.support.calibrate_process import CalibrationProcess

MOMENTS = int(os.environ.get("HILCAL_KILLS", "50"))
EACH = 10  # kills of one calibration
LONGEST = 14.0  # a moment is drawn up to here, s: so long a start, its devices and some steps take


def finished(c):
    assert next_step(c.run).kind == "done"
    c.check_each_reading_once()
    with CampaignFile.open(c.run, read_only=True) as campaign:
        found = ProcedureLog(campaign).last(IMPROVED)
    assert found is not None
    error = found["error"]
    assert error["after"]["rms_m"] < 0.3 * error["before"]["rms_m"]


@pytest.mark.long
def test_killed_twice_while_it_measures(tmp_path):
    c = CalibrationProcess(tmp_path)
    for wanted in (2, 5):
        process = c.start()
        end = time.monotonic() + 120.0
        while c.n_stored() < wanted:
            c.look(process.pid)
            assert process.poll() is None, c.output
            assert time.monotonic() < end, c.output
            time.sleep(0.02)
        c.look(process.pid)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        assert c.orphans() == []
        c.check_readable()
        assert c.n_stored() >= wanted
    assert next_step(c.run).kind == "measure"


@pytest.mark.slow
def test_killed_at_fifty_random_moments(tmp_path):
    seed = int(np.random.SeedSequence().generate_state(1)[0])
    print(f"seed {seed}")
    rng = np.random.default_rng(seed)
    kills = campaigns = 0
    while kills < MOMENTS:
        campaigns += 1
        directory = tmp_path / str(campaigns)
        directory.mkdir()
        c = CalibrationProcess(directory)
        for _ in range(min(EACH, MOMENTS - kills)):
            if not c.killed_after(float(rng.uniform(0.0, LONGEST))):
                break  # it has come to its end
            kills += 1
            c.check_readable()
        c.finish()
        assert c.orphans() == []
        finished(c)
    print(f"{kills} kills of {campaigns} calibrations")
