"""One `hilcal calibrate --rehearse` in a process of its own, to be killed."""

import os
import signal
import subprocess
import sys
import time

import psutil

from hilcal.procedure.state import Files
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.run_log import RunLog
from tests.support.campaign_cases import LOOK_S, still_running
from tests.support.paths import ROOT

CELL = (ROOT / "tests" / "data" / "calibrated_cell.toml").read_text(encoding="utf-8")
"""A tiny cell without a force sensor; its world goes forty times faster than a clock."""
SIZE = ("--poses", "4", "--validation", "3")
LONGEST = 120.0  # a calibration that is not killed takes a fifth of this, s
STARTING = 15.0
"""A device process that starts on a busy computer sees only then that its parent is gone, s."""


class CalibrationProcess:
    """Starts `calibrate` in a session of its own, as often as it takes."""

    def __init__(self, directory):
        self.toml, self.run = directory / "cell.toml", directory / "run.hilcal"
        self.log = directory / "calibrate.log"
        self.toml.write_text(CELL, encoding="utf-8")
        self._family = set()

    def start(self):
        """Start it, with --resume in any case: without a campaign it begins."""
        command = [sys.executable, "-m", "hilcal", "calibrate", self.toml, "-o", self.run]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as log:
            return subprocess.Popen(
                [*map(str, command), "--rehearse", "--resume", "--json", *SIZE],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                env=environment,
            )

    def killed_after(self, seconds):
        """Start it, and kill its process group so long after; False where it ended before."""
        process = self.start()
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0 and process.poll() is None:
            self.look(process.pid)
            time.sleep(min(left, LOOK_S))
        self.look(process.pid)
        ended = process.poll() is not None
        if not ended:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
        assert ended or code == -signal.SIGKILL
        assert code <= 0, f"exit code {code}: {self.output[-500:]}"
        left = self.orphans()
        assert not left, left
        return not ended

    def finish(self):
        process = self.start()
        assert process.wait(LONGEST) == 0, self.output

    @property
    def output(self):
        return self.log.read_text(encoding="utf-8", errors="replace")[-4000:]

    def orphans(self):
        """Return its processes that still run, after a moment: one may be starting just then."""
        return still_running(self._family, STARTING)

    def check_each_reading_once(self):
        """Check that each step of each plan was measured once; returns the number of readings."""
        count = 0
        for path in self._files():
            count += self._once(path)
            with CampaignFile.open(path, read_only=True) as campaign:
                log = RunLog(campaign)
                assert log.done() == frozenset(log.plan.steps)
                assert len(log.plan.steps) == campaign.n_readings
        return count

    def n_stored(self):
        return self._once(self.run) if self.run.exists() else 0

    def check_readable(self):
        """Check that what is there can be read."""
        for path in self._files():
            if path.exists():
                with CampaignFile.open(path, read_only=True) as campaign:
                    assert self._once(path) == campaign.n_readings

    def _files(self):
        files = Files(self.run)
        return files.run, files.validation, files.corrected

    def _once(self, path):
        """Return how many readings a campaign holds, each with its details once."""
        with CampaignFile.open(path, read_only=True) as campaign:
            steps = [tuple(d["step"].values()) for d in RunLog(campaign).details()]
            assert len(steps) == len(set(steps))
            assert len(steps) <= campaign.n_readings  # read later: the run may go on meanwhile
        return len(steps)

    def look(self, pid):
        try:
            children = psutil.Process(pid).children(recursive=True)
        except psutil.Error:
            return
        self._family |= {pid, *(child.pid for child in children)}
