"""Campaigns on one simulated cell whose runs meet faults: the site, a run, what has to hold."""

import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulated_cell
from hilcal.drivers.simulated.world import World
from hilcal.identification.noise.full_covariance import with_joint_scatter
from hilcal.measuring.route import dry_run
from hilcal.robot.catalogue import configs_dir
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, Step
from hilcal.store.run_log import RunLog
from tests.support.paths import ROOT
from tests.support.spread_plan import spread_plan
from tests.support.timing import wait_until

DEADLINE = 60.0  # nothing here may take longer, s; far above what it takes
HAND_S = 2.0
"""The simulated person is quick, s of cell time: nothing here depends on how long it takes."""


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

    def end_runs(self):
        """End what a test that failed has left running."""
        for run in self.runs:
            if run.process.poll() is None:
                run.kill()
                run.process.wait()
        self.runs.clear()

    def ask(self, device, op, **arguments):
        return self.simulated.ask(device, op, **arguments)

    def slider(self, share):
        """Set the speed slider on the pendant; what runs goes on at that share of its speed."""
        self.ask("arm", "set", slider=share)

    def shorter(self, directory, poses):
        plan = spread_plan(self.cell, poses, np.random.default_rng(7), repeats=0)
        plan_file = directory / "plan.json"
        plan_file.write_text(plan.to_json(), encoding="utf-8")
        return replace(self, plan=plan, plan_file=plan_file, directory=directory)

    def dashboard(self, *commands):
        """Say something to the controller's dashboard, as the pendant's buttons do."""
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


@contextmanager
def site(directory, *, poses, seed=5, tracker=None, force_sensor=None):
    """Run a simulated cell with two loads and a plan of few poses; other instruments as given."""
    base_dir = configs_dir() / "cells"
    config = load_config(base_dir / "demo_ur10e.toml")
    changes = {
        "simulation": config.simulation.model_copy(update={"clock": 20.0}),
        "operator": config.operator.model_copy(update={"options": {"hand_s": HAND_S}}),
        "loads": config.loads[:2],
        "tracker": config.tracker.model_copy(update=tracker),
        "force_sensor": config.force_sensor and config.force_sensor.model_copy(update=force_sensor),
    }
    config = config.model_copy(update=changes)
    cell = cell_from_config(config)
    # Not every such plan passes the check: some motion may be too near to an obstacle.
    rngs = (np.random.default_rng([seed, k]) for k in range(20))
    plans = (spread_plan(cell, poses, rng, repeats=1) for rng in rngs)
    plan = next(p for p in plans if not dry_run(cell, p).problems)
    secret = case_of_plan(config, plan, "nothing", seed)
    with simulated_cell(secret, seed, base_dir, directory / "cell") as running:
        toml, plan_file = directory / "cell.toml", directory / "plan.json"
        toml.write_text(to_toml(running.config), encoding="utf-8")
        plan_file.write_text(plan.to_json(), encoding="utf-8")
        yield Site(
            running, secret.world, secret.cell, running.config, plan, toml, plan_file, directory, []
        )


STARTED = "waiting for the operator to take everything off"
"""What a run says as soon as every device is there and ready."""
READING_COUNT = re.compile(r"\d+/\d+ ")
SLOW_SLIDER = 0.1  # position of the speed slider while an arm is to be stopped on its way
LOOK_S = 0.25
"""Time between two looks at the processes that a run has started; each reads those of the whole
machine."""
FAR_RAD = 0.5
"""The arm is stopped so far from its goal; at that speed it would take 0.8 s to arrive."""


class EndedError(AssertionError):
    """A run has ended too early."""


class Run:
    """One `hilcal run`, in a session of its own."""

    def __init__(self, site, path, *more, how=()):
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
            )
        self._family = {self.process.pid}
        self._looked = 0.0
        site.runs.append(self)

    @property
    def output(self):
        return self.log.read_text(encoding="utf-8", errors="replace")

    def wait_until(self, what, words):
        end = time.monotonic() + DEADLINE
        while not what():
            self._look()
            if self.process.poll() is not None:
                raise EndedError(f"it ended before {words}:\n{self.output}")
            assert time.monotonic() < end, f"no {words} in {DEADLINE} s:\n{self.output}"
            time.sleep(0.02)

    def some_readings(self):
        self.wait_until(lambda: bool(READING_COUNT.search(self.output)), "a reading")

    def moving(self):
        """Wait until the arm moves, so slowly and so far that it will not arrive soon."""
        self.site.slider(SLOW_SLIDER)
        plan = self.site.plan
        goal = np.zeros(6)

        def far():
            name = self.output.splitlines()[-1].partition("moving to ")[2]
            state = self.site.ask("arm", "state")
            if name not in plan.pose_names or not state["moving"]:
                return False
            goal[:] = plan.joints(name)
            return bool(np.abs(goal - state["q"]).max() > FAR_RAD)

        self.wait_until(far, "motion")
        return goal

    def measuring(self):
        count = len(self.output.splitlines())
        self.wait_until(
            lambda: "measuring" in "".join(self.output.splitlines()[count:]), "measurement"
        )

    def next_reading(self, words):
        count = len(READING_COUNT.findall(self.output))
        self.wait_until(
            lambda: len(READING_COUNT.findall(self.output)) > count, f"a reading with {words}"
        )

    def family(self):
        """Process numbers of it and of all that it has started."""
        try:
            children = psutil.Process(self.process.pid).children(recursive=True)
            self._family |= {child.pid for child in children}
        except psutil.Error:
            pass
        return self._family

    def _look(self):
        """Note what it has started meanwhile, now and then."""
        if time.monotonic() - self._looked > LOOK_S:
            self.family()
            self._looked = time.monotonic()

    def interrupt(self):
        """Ctrl-C at the terminal: the whole group gets it."""
        self.family()
        os.killpg(self.process.pid, signal.SIGINT)

    def kill(self):
        self.family()
        self.process.kill()

    def end(self, longest=DEADLINE):
        """Wait for its end; returns the exit code and what it said."""
        end = time.monotonic() + longest
        while self.process.poll() is None:
            self._look()
            assert time.monotonic() < end, f"it hangs:\n{self.output}"
            time.sleep(0.02)
        return self.process.wait(), self.output

    def orphans(self):
        """Processes that it has left behind, after a moment."""
        return still_running(self._family, 3.0)


def still_running(processes, seconds):
    """Commands of those of some processes that have not ended after so long."""
    end = time.monotonic() + seconds
    while True:
        names = [name for pid in processes if (name := _alive(pid))]
        if not names or time.monotonic() > end:
            return names
        time.sleep(0.02)


def _alive(pid):
    try:
        process = psutil.Process(pid)
        if process.status() == psutil.STATUS_ZOMBIE:
            return ""
        return " ".join(process.cmdline())
    except psutil.Error:
        return ""


CAMPAIGN_S = 900.0  # a whole campaign may take so long, s
STARVED = re.compile(
    r"no new data over RTDE|no answer within|by its watchdog|too busy|nothing came for|"
    r"its motion was not supervised"
)
"""What a run says, too, where this computer has given one of the processes no turn for long."""
TRIES = 3

Act = Callable[[Site], object]


@dataclass(frozen=True, slots=True)
class Fault:
    """What happens in the middle of a run, what is said, and how it is put right."""

    name: str  # of the test
    cause: Act  # makes it happen
    mend: Act  # puts it right, as the operator would
    patterns: tuple[str, ...]  # patterns that the one line has to contain
    stops_arm: bool = True  # whether the arm has to be stopped for it (else it stands already)
    fast: bool = False  # whether it is one of the few that are long, not slow


def act(device, op, **arguments):
    return lambda cell: cell.ask(device, op, **arguments)


def no_action(cell):
    """Nothing has to be put right."""


def switch(name, device, op, *says, fast=False):
    return Fault(name, act(device, op, on=True), act(device, op, on=False), says, fast=fast)


def parametrize_faults(faults):
    mark = {True: pytest.mark.long, False: pytest.mark.slow}
    rows = [pytest.param(one, id=one.name, marks=mark[one.fast]) for one in faults]
    return pytest.mark.parametrize("fault", rows)


def start_run(cell, path, then):
    """Start a run, wait for its first reading and for what comes then; returns both."""
    for left in reversed(range(TRIES)):
        run = Run(cell, path)
        try:
            run.some_readings()
            return run, then(run)
        except EndedError as error:
            if not left or not STARVED.search(str(error)):
                raise
        cell.slider(1.0)
    raise AssertionError("unreachable")


def check_fault(fault, cell, path, *, moving):
    """Let a run meet a fault after its first reading, and check what the operator sees."""
    for left in reversed(range(TRIES)):
        run, goal = start_run(cell, path, Run.moving if moving else Run.measuring)
        since = time.monotonic()
        try:
            fault.cause(cell)
            line = failed(run)
            if goal is not None and fault.stops_arm:
                check_stopped_on_its_way(cell, since, goal)
            assert not cell.ask("arm", "state")["moving"]
        finally:
            fault.mend(cell)
        named = all(re.search(words, line) for words in fault.patterns)
        assert "--resume" in line, line
        check_readings(cell, path)
        if named:
            return
        assert left, line
        assert STARVED.search(line), line
        cell.slider(1.0)


def failed(run, code=3):
    """Check that a run ended as it should when something fails; returns the line that says why."""
    got, words = run.end()
    assert got == code, words
    assert "Traceback" not in words
    lines = [line for line in words.splitlines() if line.startswith("error:")]
    assert len(lines) == 1, words
    assert run.orphans() == []
    return lines[0]


def finish(site, path):
    """Resume until it is done, and check the campaign; see `start_run` for more than one try."""
    for left in reversed(range(TRIES)):
        run = Run(site, path)
        code, words = run.end(CAMPAIGN_S)
        assert run.orphans() == []
        if code == 0:
            break
        assert left, words
        assert STARVED.search(words), words
    check_complete(site, path)


def check_complete(site, path):
    """Check that every step of the plan is there once, and that every reading is right."""
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        stored = [Step(**d["step"]) for d in log.details()]
        assert sorted(map(str, stored)) == sorted(map(str, site.plan.steps))
        assert campaign.n_readings == len(site.plan.steps)
    check_readings(site, path)


def check_readings(site, path):
    """Check that every stored reading is what a tracker may read of the state it is stored with."""
    with CampaignFile.open(path) as campaign:
        log = RunLog(campaign)
        steps = [str(Step(**d["step"])) for d in log.details()]
        late = {str(Step(**e["reading"])) for e in log.events() if e.get("stored")}
        runs = sum(e["kind"] == "start" for e in log.events())
        readings = campaign.readings()
    readings = readings[np.array([step not in late for step in steps], dtype=np.bool_)]
    assert len(late) <= runs, late
    for k, name in enumerate(readings.load_names):
        load = next((x for x in site.config.loads if x.name == name), None)
        pull = np.zeros(6) if load is None else load.wrench(site.cell.gravity)
        rows = readings.load == k
        assert np.abs(readings.states.wrench[rows] - pull).max(initial=0.0) < 1.0
    sight = site.world.ideal_readings(readings.states)
    off = readings.value - sight.value(readings.m)
    scatter = site.config.repeatability.per_joint(site.cell.arm.n)
    registered = replace(
        site.cell, registration=site.world.registration, registration_known=True, target_known=True
    )
    known = with_joint_scatter(registered, readings, scatter)
    white = np.linalg.solve(np.linalg.cholesky(known.covariance), off[:, :, None])
    # a wrong pose, load or a broken frame is off by hundreds
    worst = int(np.abs(white).max(axis=(1, 2)).argmax())
    assert np.abs(white).max() < 7.0, (
        f"reading {worst + 1} of {len(white)} is off by {np.abs(white[worst]).max():.1f} σ, "
        f"{off[worst].tolist()} m"
    )


def check_stopped_within(cell, since):
    """Check that the arm stands since at most half a second after `since` (monotonic, s)."""
    wait_until(lambda: not cell.ask("arm", "state")["moving"], "at rest", DEADLINE)
    assert cell.ask("arm", "state")["rest_ns"] * 1e-9 - since <= 0.5


def check_stopped_on_its_way(cell, since, goal):
    """Check that the arm came to rest in time after `since`, far from where it was to go (6,)."""
    check_stopped_within(cell, since)
    assert np.abs(goal - cell.ask("arm", "state")["q"]).max() > 0.1
