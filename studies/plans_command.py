"""`python -m studies plans`: planned, random and hand-made campaigns on simulated arms."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.demo import CELL
from hilcal.cli.options import Jobs, Json, Scheduler
from hilcal.cli.terminal import terminal
from hilcal.config import CellConfig, load_config
from hilcal.design.nominal_model import nominal_tracker_place
from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.drivers.simulated.rehearsal import measurement_noise, simulate
from hilcal.drivers.simulated.world import World
from hilcal.engine import open_engine
from hilcal.errors import InputError
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings, States
from hilcal.robot import se3
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.types import Floats
from studies.plans import MakeArm, PlansStudy, kinds_of, plans_study
from studies.plans_errors import PlannedReadings
from studies.plans_table import CAPTION, as_predicted, halved, report
from studies.records import Figure, Keep, keep

ROBOTS = ("ur10e", "ur5e")
FRAMES = ("base_frame", "target_offset")
"""Effects whose true values are relative to a registration, which identification repeats."""


def plans(
    cell: Annotated[
        Path | None,
        typer.Argument(metavar="CELL.toml", help="The cell; that of the demo by default."),
    ] = None,
    robot: Annotated[
        list[str] | None,
        typer.Option(
            "--robot", help="Another robot in this cell, loads by its payload; repeatable."
        ),
    ] = None,
    readings: Annotated[int, typer.Option("--readings", help="Of each plan.")] = 100,
    campaigns: Annotated[int, typer.Option("--campaigns", help="Of each kind of plan.")] = 50,
    candidates: Annotated[
        int | None, typer.Option("--candidates", help="Poses to choose from; as configured.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", help="Of everything that is random.")] = 0,
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Carry out planned, random and grid plans on simulated arms and compare their true errors."""
    t = terminal(as_json)
    if readings < 1 or campaigns < 2 or seed < 0 or (candidates is not None and candidates < 1):
        option = "" if candidates is None else f"--candidates {candidates}, "
        raise InputError(
            f"{option}--readings {readings}, --campaigns {campaigns}, --seed {seed}; valid: whole "
            "numbers from 1, at least 2 campaigns, a seed from 0"
        )
    path = configs_dir() / "cells" / CELL if cell is None else cell
    config_of_cell = load_config(path)
    models = robot or (list(ROBOTS) if cell is None else [config_of_cell.robot.model])
    base = path.absolute().parent
    settings = [with_robot(config_of_cell, model, base) for model in models]
    total = sum(campaigns * len(kinds_of(config)) for config in settings)
    studies = []
    with (
        open_engine(jobs, scheduler) as engine,
        counting(t.progress, "campaigns", total) as advance,
    ):
        for config in settings:
            studies.append(
                plans_study(
                    cell_from_config(config, base), arms(seed),
                    readings=readings, campaigns=campaigns, candidates=candidates,
                    seed=seed, engine=engine, advance=advance,
                )
            )  # fmt: skip
    for study in studies:
        t.show(report(study))
        t.show("")
    t.show(CAPTION)
    keep(keep_file, "What planning buys", [f for study in studies for f in _figures(study)])
    t.document({"robots": [document(study) for study in studies]})


def _figures(study: PlansStudy) -> Iterator[Figure]:
    for line in study.lines:
        plan = f"{study.robot}, {study.readings} {study.mode} readings, plan {line.kind}"
        spread = line.result.spread
        ratio = f"{spread.value:.2f} ± {spread.std:.2f}"
        yield Figure(f"{plan}: true over predicted error of the parameters", ratio)
        if line.efficiency is not None:
            yield Figure(f"{plan}: certified efficiency", f"{100 * line.efficiency:.1f} %")
        if line.random_readings is not None:
            times = line.random_readings / study.readings
            yield Figure(f"{plan}: readings that a random plan needs", f"{times:.1f} times")


def document(study: PlansStudy) -> dict[str, object]:
    """Return the JSON document of a study."""
    shrinkage = [
        {**asdict(s), "as_predicted": as_predicted(s.agreement), "half": halved(study, s)}
        for s in study.shrinkage()
    ]
    return {**asdict(study), "shrinkage": shrinkage}


def with_robot(config: CellConfig, model: str, base_dir: Path | None = None) -> CellConfig:
    """Return the cell with another robot, and with loads scaled by the payload."""
    old = config.robot
    if model == old.model:
        return config
    new = old.model_copy(update={"model": model, "base_link": None, "tip_link": None})
    old_arm = load_arm(old.model, base_dir, base_link=old.base_link, tip_link=old.tip_link)
    share = load_arm(model, base_dir).payload / old_arm.payload
    if not np.isfinite(share) or share <= 0.0:
        raise InputError(f"--robot {model}: loads cannot be scaled, a payload is not known")
    loads = tuple(
        load.model_copy(
            update={
                "name": load.name if load.mass_kg == 0.0 else f"{share * load.mass_kg:.3g}kg",
                "mass_kg": share * load.mass_kg,
                "force_N": tuple(share * f for f in load.force_N),
                "moment_Nm": tuple(share * m for m in load.moment_Nm),
            }
        )
        for load in config.loads
    )
    names = {load.name: scaled.name for load, scaled in zip(config.loads, loads, strict=True)}
    work_load = names.get(config.planning.work_load, config.planning.work_load)
    planning = config.planning.model_copy(update={"work_load": work_load})
    return config.model_copy(update={"robot": new, "loads": loads, "planning": planning})


def arms(seed: int) -> MakeArm:
    """Return a function that makes arms by number."""

    def make(cell: Cell, number: int) -> SimulatedArm:
        return SimulatedArm(world(cell, np.random.default_rng([seed, number, 99])))

    return make


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedArm:
    """A simulated arm for the study."""

    world: World

    @property
    def parameters(self) -> Mapping[str, Floats]:
        """True parameters by effect, SI."""
        physics = self.world.physics
        names = (f.name for f in fields(physics) if f.name not in FRAMES)
        return {name: np.asarray(getattr(physics, name)).reshape(-1) for name in names}

    def measure(self, asked: PlannedReadings, rng: np.random.Generator) -> Readings:
        """Return simulated readings of the tracker."""
        return simulate(
            self.world, asked.states, asked.pose, asked.load, asked.cycle, asked.load_names, rng
        )

    def position(self, states: States) -> Floats:
        """Return (N, 3) true positions of the target, sensor axes, m."""
        return self.world.ideal_readings(states).position


def world(cell: Cell, rng: np.random.Generator) -> World:
    """Return an arm without hidden effects, measured as configured.

    The tracker has the position that the plan assumes, and a random rotation about the vertical.
    A reading is the mean of the configured number of samples, with the noise that a plan assumes.
    """
    config = cell.configured()
    noise = measurement_noise(config, config.acquire.samples)
    drawn = world_without_effect(
        cell, rng, noise=noise, joint_std=config.repeatability.per_joint(cell.arm.n)
    )
    place, _ = nominal_tracker_place(cell)
    turn = se3.rotation(np.array([0.0, 0.0, rng.uniform(0.0, 2.0 * np.pi)]))
    frame = se3.matrix(turn, -turn @ place)
    if not cell.registration_known:
        return replace(drawn, registration=frame, station=np.eye(4))
    station = frame if config.tracker.frame == "base" else np.eye(4)
    return replace(drawn, registration=cell.registration, station=station)
