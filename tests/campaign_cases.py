"""Campaigns on a simulated cell as an operator runs them: `hilcal run` as its own process."""

import os
import re
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from drivers.simulated.cell_processes import SimulatedCell
from drivers.simulated.on_the_wire import secret_of, simulated_cell
from drivers.simulated.world import World
from hilcal.acquire.dry_run import dry_run
from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.config.write import to_toml
from hilcal.data.campaign import Campaign
from hilcal.data.plan import Plan, Step
from hilcal.data.run_log import RunLog
from hilcal.identify.repeatability import with_repeatability
from hilcal.plan.spread import spread_plan
from hilcal.robot.catalogue import configs_dir

ROOT = Path(__file__).resolve().parents[1]
TAKEN = re.compile(r"\d+/\d+ ")
DEADLINE = 60.0
"""Nothing here may take longer, s; far above what it takes."""


@dataclass(frozen=True, slots=True, eq=False)
class Site:
    """A running simulated cell with its files, and a short plan for it."""

    simulated: SimulatedCell
    world: World
    cell: Cell
    config: CellConfig
    plan: Plan
    toml: Path
    plan_file: Path
    directory: Path
    runs: list["Run"]

    def end_runs(self) -> None:
        """End what a test that failed has left running."""
        for run in self.runs:
            if run.process.poll() is None:
                run.kill()
                run.process.wait()
        self.runs.clear()

    def ask(self, device: str, op: str, **arguments: Any) -> Any:
        return self.simulated.ask(device, op, **arguments)

    def now(self) -> float:
        """Time as the simulated devices stamp it, s."""
        return time.monotonic()

    def shorter(self, directory: Path, poses: int) -> "Site":
        """The same cell with a plan of fewer poses."""
        plan = spread_plan(self.cell, self.config, poses, np.random.default_rng(7), repeats=0)
        plan_file = directory / "plan.json"
        plan_file.write_text(plan.to_json(), encoding="utf-8")
        return replace(self, plan=plan, plan_file=plan_file, directory=directory)

    def dashboard(self, *commands: str) -> list[str]:
        """Say something to the controller's dashboard, as the pendant's buttons do."""
        assert self.config.robot.host is not None
        with (
            socket.create_connection((self.config.robot.host, 29999), timeout=5.0) as line,
            line.makefile("rw") as stream,
        ):
            stream.readline()
            answers = []
            for command in commands:
                stream.write(command + "\n")
                stream.flush()
                answers.append(stream.readline().strip())
        return answers

    def until(self, what: Callable[[], bool]) -> None:
        """Wait until something holds."""
        end = time.monotonic() + DEADLINE
        while not what():
            assert time.monotonic() < end
            time.sleep(0.02)


@contextmanager
def site(directory: Path, *, clock: float = 20.0, poses: int = 3, seed: int = 5) -> Iterator[Site]:
    """Run a simulated cell with two loads and a plan of few poses."""
    base_dir = configs_dir() / "cells"
    config = load_config(base_dir / "demo_ur10e.toml")
    simulation = config.simulation.model_copy(update={"clock": clock})
    config = config.model_copy(update={"simulation": simulation, "loads": config.loads[:2]})
    cell = cell_from_config(config)
    plan = spread_plan(cell, config, poses, np.random.default_rng(seed), repeats=1)
    assert dry_run(cell, config, plan).problems == ()
    secret = secret_of(config, plan, "nothing", seed)
    with simulated_cell(secret, seed, base_dir, directory / "cell") as running:
        toml, plan_file = directory / "cell.toml", directory / "plan.json"
        toml.write_text(to_toml(running.config), encoding="utf-8")
        plan_file.write_text(plan.to_json(), encoding="utf-8")
        yield Site(
            running, secret.world, secret.cell, running.config, plan, toml, plan_file, directory, []
        )


class Run:
    """One `hilcal run`, in a session of its own."""

    def __init__(self, site: Site, path: Path, *more: str, limit: int | None = None) -> None:
        """Start it; `--resume` where the campaign is there already.

        With `limit`, no file of the program can grow beyond so many bytes.
        """
        self.site, self.path = site, path
        self.log = path.with_suffix(f".{time.monotonic_ns()}.log")
        how = ("--resume",) if path.exists() else ("--plan", str(site.plan_file))
        command = [sys.executable, "-m", "hilcal", "run", str(site.toml), "-o", str(path)]
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with self.log.open("wb") as log:
            self.process = subprocess.Popen(
                [*command, *how, *more],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=environment,
                preexec_fn=None if limit is None else lambda: _limited(limit),
            )
        self._family: set[int] = {self.process.pid}
        site.runs.append(self)

    @property
    def words(self) -> str:
        """What it has said so far."""
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_for(self, readings: int) -> None:
        """Wait until so many readings of this campaign are stored."""
        self.wait_until(lambda: f" {readings}/" in self.words, f"{readings} readings")

    def wait_until(self, what: Callable[[], bool], words: str) -> None:
        """Wait until something holds."""
        end = time.monotonic() + DEADLINE
        while not what():
            self.family()
            assert self.process.poll() is None, f"it ended before {words}:\n{self.words}"
            assert time.monotonic() < end, f"no {words} in {DEADLINE} s:\n{self.words}"
            time.sleep(0.02)

    def some_readings(self) -> None:
        """Wait until this run has stored a reading."""
        self.wait_until(lambda: bool(TAKEN.search(self.words)), "a reading")

    def moving(self) -> None:
        """Wait until the arm has just begun to move."""
        count = len(self.words.splitlines())

        def begun() -> bool:
            new = self.words.splitlines()[count:]
            return any("moving to" in w for w in new) and self.site.ask("arm", "state")["moving"]

        self.wait_until(begun, "motion")

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
            self.family()
            assert time.monotonic() < end, f"it hangs:\n{self.words}"
            time.sleep(0.02)
        return self.process.wait(), self.words

    def left_behind(self) -> list[str]:
        """Processes that it has left behind, after a moment."""
        end = time.monotonic() + 3.0
        while True:
            there = [_alive(pid) for pid in self._family]
            names = [name for name in there if name]
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


LONG = 900.0
"""A whole campaign may take so long, s."""


def failed(run: Run, code: int = 3) -> str:
    """Check that a run ended as it should when something fails; returns the line that says why."""
    got, words = run.end()
    assert got == code, words
    assert "Traceback" not in words
    lines = [line for line in words.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, words
    assert run.left_behind() == []
    return lines[0]


def finish(site: Site, path: Path, tries: int = 1) -> None:
    """Resume until it is done, and check the campaign."""
    for attempt in range(tries):
        run = Run(site, path)
        code, words = run.end(LONG)
        assert run.left_behind() == []
        if code == 0:
            break
        assert attempt + 1 < tries, words
    whole(site, path)


def whole(site: Site, path: Path) -> None:
    """Check that every step of the plan is there once, and that every reading is right."""
    with Campaign.open(path) as campaign:
        log = RunLog(campaign)
        stored = [Step(**d["step"]) for d in log.details()]
        assert sorted(map(str, stored)) == sorted(map(str, site.plan.steps))
        assert campaign.n_readings == len(site.plan.steps)
    right(site, path)


def right(site: Site, path: Path) -> None:
    """Check that every stored reading is what a tracker may read of the state it is stored with."""
    with Campaign.open(path) as campaign:
        readings = campaign.readings()
    for k, name in enumerate(readings.load_names):
        load = next((x for x in site.config.loads if x.name == name), None)
        pull = np.zeros(6) if load is None else load.wrench(site.cell.gravity)
        rows = readings.load == k
        assert np.abs(readings.states.wrench[rows] - pull).max(initial=0.0) < 1.0
    sight = site.world.sight(readings.states)
    off = readings.value - sight.value(readings.m)
    scatter = site.config.repeatability.per_joint(site.cell.arm.n)
    known = with_repeatability(_registered(site), readings, scatter)
    white = np.linalg.solve(np.linalg.cholesky(known.covariance), off[:, :, None])
    # a wrong pose, load or a broken frame is off by hundreds
    assert np.abs(white).max() < 7.0


def _registered(site: Site) -> Cell:
    return replace(
        site.cell, registration=site.world.registration, registration_known=True, target_known=True
    )


def stopped_within(site: Site, since: float | None = None, seconds: float = 0.5) -> None:
    """Check that the arm stands since at most so long after `since` (monotonic, s).

    Without it, after the last fault that the simulated controller was asked for.
    """
    site.until(lambda: not site.ask("arm", "state")["moving"])
    state = site.ask("arm", "state")
    begun = state["fault_ns"] * 1e-9 if since is None else since
    assert state["rest_ns"] * 1e-9 - begun <= seconds
