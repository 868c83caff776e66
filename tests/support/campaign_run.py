"""One `hilcal run` in a process of its own, as an operator starts it."""

import os
import re
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import psutil

from hilcal.types import Floats
from tests.support.campaign_site import DEADLINE, Site

ROOT = Path(__file__).resolve().parents[2]
BEGUN = "waiting for the operator to take everything off"
"""What a run says as soon as every device is there and ready."""
TAKEN = re.compile(r"\d+/\d+ ")
SLOW = 0.1  # position of the speed slider while an arm is to be stopped on its way
LOOK_S = 0.25
"""Time between two looks at the processes that a run has started; each reads those of the whole
machine."""
FAR_RAD = 0.5
"""The arm is stopped so far from its goal; at that speed it would take 0.8 s to arrive."""


class EndedError(AssertionError):
    """A run has ended too early."""


class Run:
    """One `hilcal run`, in a session of its own."""

    def __init__(
        self,
        site: Site,
        path: Path,
        *more: str,
        limit: int | None = None,
        how: tuple[str, ...] = (),
    ) -> None:
        """Start it; unless `how` says otherwise, `--resume` where the campaign is there already."""
        self.site, self.path = site, path
        self.log = path.with_suffix(f".{time.monotonic_ns()}.log")
        usual = ("--resume",) if path.exists() else ("--plan", str(site.plan_file))
        command = [sys.executable, "-m", "hilcal", "run", str(site.toml), "-o", str(path)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, *(how or usual), *more],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=environment,
                preexec_fn=None if limit is None else lambda: _limited(limit),
            )
        self._family: set[int] = {self.process.pid}
        self._looked = 0.0
        site.runs.append(self)

    @property
    def words(self) -> str:
        """What it has said so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_until(self, what: Callable[[], bool], words: str) -> None:
        """Wait until something holds."""
        end = time.monotonic() + DEADLINE
        while not what():
            self._look()
            if self.process.poll() is not None:
                raise EndedError(f"it ended before {words}:\n{self.words}")
            assert time.monotonic() < end, f"no {words} in {DEADLINE} s:\n{self.words}"
            time.sleep(0.02)

    def some_readings(self) -> None:
        """Wait until this run has stored a reading."""
        self.wait_until(lambda: bool(TAKEN.search(self.words)), "a reading")

    def moving(self) -> Floats:
        """Wait until the arm moves, so slowly and so far that it will not arrive soon."""
        self.site.slider(SLOW)
        plan = self.site.plan
        goal = np.zeros(6)

        def far() -> bool:
            name = self.words.splitlines()[-1].partition("moving to ")[2]
            state = self.site.ask("arm", "state")
            if name not in plan.pose_names or not state["moving"]:
                return False
            goal[:] = plan.joints(name)
            return bool(np.abs(goal - state["q"]).max() > FAR_RAD)

        self.wait_until(far, "motion")
        return goal

    def measuring(self) -> None:
        """Wait until a reading has just begun."""
        count = len(self.words.splitlines())
        self.wait_until(
            lambda: "measuring" in "".join(self.words.splitlines()[count:]), "measurement"
        )

    def next_reading(self, words: str) -> None:
        """Wait until one more reading is stored."""
        count = len(TAKEN.findall(self.words))
        self.wait_until(lambda: len(TAKEN.findall(self.words)) > count, f"a reading with {words}")

    def family(self) -> set[int]:
        """Process numbers of it and of all that it has started."""
        try:
            children = psutil.Process(self.process.pid).children(recursive=True)
            self._family |= {child.pid for child in children}
        except psutil.Error:
            pass
        return self._family

    def _look(self) -> None:
        """Note what it has started meanwhile, now and then."""
        if time.monotonic() - self._looked > LOOK_S:
            self.family()
            self._looked = time.monotonic()

    def interrupt(self) -> None:
        """Ctrl-C at the terminal: the whole group gets it."""
        self.family()
        os.killpg(self.process.pid, signal.SIGINT)

    def kill(self) -> None:
        """Kill -9, only the program itself."""
        self.family()
        self.process.kill()

    def end(self, longest: float = DEADLINE) -> tuple[int, str]:
        """Wait for its end; returns the exit code and what it said."""
        end = time.monotonic() + longest
        while self.process.poll() is None:
            self._look()
            assert time.monotonic() < end, f"it hangs:\n{self.words}"
            time.sleep(0.02)
        return self.process.wait(), self.words

    def left_behind(self) -> list[str]:
        """Processes that it has left behind, after a moment."""
        return still_running(self._family, 3.0)


def still_running(processes: set[int], seconds: float) -> list[str]:
    """Commands of those of some processes that have not ended after so long."""
    end = time.monotonic() + seconds
    while True:
        names = [name for pid in processes if (name := _alive(pid))]
        if not names or time.monotonic() > end:
            return names
        time.sleep(0.02)


def _limited(size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def _alive(pid: int) -> str:
    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return ""
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""
