"""`calibrate --rehearse`, killed twice while it measures: what was stored stays, and it goes on."""

import os
import signal
import time

import pytest

from hilcal.procedure.state import next_step
from tests.support.calibrate_process import CalibrationProcess


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
