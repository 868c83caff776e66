"""A simulated cell with its files, as an operator finds it."""

import socket
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.config import CellConfig, load_config
from hilcal.config.reference import to_toml
from hilcal.drivers.simulated.cell_processes import SimulatedCell
from hilcal.drivers.simulated.rehearsal import case_of_plan, simulated_cell
from hilcal.drivers.simulated.world import World
from hilcal.measuring.route import dry_run
from hilcal.robot.catalogue import configs_dir
from hilcal.store.plan import Plan
from tests.support.spread_plan import spread_plan

if TYPE_CHECKING:
    from tests.support.campaign_run import Run

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

    def end_runs(self) -> None:
        """End what a test that failed has left running."""
        for run in self.runs:
            if run.process.poll() is None:
                run.kill()
                run.process.wait()
        self.runs.clear()

    def ask(self, device: str, op: str, **arguments: Any) -> Any:
        return self.simulated.ask(device, op, **arguments)

    def slider(self, share: float) -> None:
        """Set the speed slider on the pendant; what runs goes on at that share of its speed."""
        self.ask("arm", "set", slider=share)

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
def site(
    directory: Path,
    *,
    clock: float = 20.0,
    poses: int = 3,
    seed: int = 5,
    tracker: dict[str, Any] | None = None,
    force_sensor: dict[str, Any] | None = None,
) -> Iterator[Site]:
    """Run a simulated cell with two loads and a plan of few poses; other instruments as given."""
    base_dir = configs_dir() / "cells"
    config = load_config(base_dir / "demo_ur10e.toml")
    changes = {
        "simulation": config.simulation.model_copy(update={"clock": clock}),
        "operator": config.operator.model_copy(update={"options": {"hand_s": HAND_S}}),
        "loads": config.loads[:2],
        "tracker": config.tracker.model_copy(update=tracker),
        "force_sensor": config.force_sensor and config.force_sensor.model_copy(update=force_sensor),
    }
    config = config.model_copy(update=changes)
    cell = cell_from_config(config)
    # Not every such plan passes the check: some motion may be too near to an obstacle.
    rngs = (np.random.default_rng([seed, k]) for k in range(20))
    plans = (spread_plan(cell, config, poses, rng, repeats=1) for rng in rngs)
    plan = next(p for p in plans if not dry_run(cell, config, p).problems)
    secret = case_of_plan(config, plan, "nothing", seed)
    with simulated_cell(secret, seed, base_dir, directory / "cell") as running:
        toml, plan_file = directory / "cell.toml", directory / "plan.json"
        toml.write_text(to_toml(running.config), encoding="utf-8")
        plan_file.write_text(plan.to_json(), encoding="utf-8")
        yield Site(
            running, secret.world, secret.cell, running.config, plan, toml, plan_file, directory, []
        )
