"""Simulated cells: `simulate`, and campaigns on their devices or by drawing of lots alone."""

import shlex
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hilcal.cell import cell_from_config
from hilcal.cli.options import (
    POSES,
    catalogue_with,
    check_seed,
    command,
)
from hilcal.cli.planning import make_plan, read_cell
from hilcal.cli.running import measure
from hilcal.cli.terminal import Terminal, terminal, told_to_end
from hilcal.config import CellConfig
from hilcal.config.template import to_toml
from hilcal.design.checked_plan import refuse
from hilcal.drivers.simulated.rehearsal import (
    NOTHING,
    RANDOM,
    Rehearsal,
    SimulationCase,
    as_told,
    case_of_plan,
    read_plan,
    simulated_cell,
)
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import DeviceError, InputError
from hilcal.identification.full_covariance import full_readings
from hilcal.measuring.dry_run import dry_run
from hilcal.present.diagnosis import NEWCOMER
from hilcal.present.progress import Say, counting, working
from hilcal.procedure.procedure import Measure, Procedure
from hilcal.procedure.state import WORLD
from hilcal.readings.covariance import COVERS, WHOLE
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, load_plan, with_new_names
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import RunLog, create_run
from hilcal.whole_file import replace_file

TRIES = 4
BREAK = 600.0
"""Between two plans of a campaign that is drawn by lots, s."""


@dataclass(frozen=True, slots=True)
class RehearsalSettings:
    """What a rehearsal is of."""

    config: CellConfig
    choice: str  # an effect that is hidden, "random" or "nothing"
    seed: int
    output: Path
    base_dir: Path  # directory that paths in the configuration are relative to
    catalogue: Catalogue
    lacking: Catalogue | None = None
    """The same with what is hidden, where the models cannot have that."""

    @property
    def world(self) -> Catalogue:
        """The effects that can be hidden."""
        return self.catalogue if self.lacking is None else self.lacking

    def case(self, plan: Plan) -> SimulationCase:
        """Hide what is chosen in the simulated cell; see `case_of_plan`."""
        return case_of_plan(self.config, plan, self.choice, self.seed, self.world, self.base_dir)


@dataclass(frozen=True, slots=True, eq=False)
class RehearsedCampaign:
    """A first campaign, in a simulated cell that is still there."""

    rehearsal: Rehearsal  # the cell, and all readings
    further: Callable[[Plan], Rehearsal]
    """Measures one further plan, into the same campaign; returns all readings."""
    measure: Measure  # measures what is missing of another campaign, in the same cell


def first_plan(told: RehearsalSettings, config: CellConfig, poses: int, say: Say) -> Plan:
    """Plan a campaign, as the program that is not told what is hidden would.

    `config` may have some of the loads only.
    """
    config = as_told(config, told.choice, told.world)
    cell = cell_from_config(config, told.base_dir)
    plan = make_plan(cell, config, poses, told.seed, told.catalogue, say)
    refuse(dry_run(cell, config, plan), "the plan")
    return plan


@contextmanager
def on_devices(t: Terminal, told: RehearsalSettings, plan: Plan) -> Iterator[RehearsedCampaign]:
    """Run a plan on simulated devices; they stay for further plans as long as the block lasts.

    The drivers are the real ones; what they talk to are the simulated devices of one world, each
    a process of its own.
    """
    with ExitStack() as stack:
        with working(t.progress) as say:
            secret = told.case(plan)
            say("starting the simulated devices")
            there = stack.enter_context(simulated_cell(secret, told.seed, told.base_dir))
        t.notice(NEWCOMER)
        made = create_run(told.output, there.config, told.base_dir, plan, True)
        campaign = stack.enter_context(made)

        def missing(of: CampaignFile, epoch: float | None = None) -> None:
            to_the_end(
                t,
                lambda: measure(t, there.config, secret.cell, of, epoch=epoch),
                lambda: of.n_readings,
            )

        def measured() -> Rehearsal:
            missing(campaign)
            stored = campaign.readings(), campaign.about(COVERS)
            readings = full_readings(*stored, secret.cell, there.config)
            return secret.measured(readings, there.config)

        def further(more: Plan) -> Rehearsal:
            log = RunLog(campaign)
            log.append(log.with_new_names(more))
            return measured()

        yield RehearsedCampaign(measured(), further, missing)


@contextmanager
def in_process(t: Terminal, told: RehearsalSettings, plan: Plan) -> Iterator[RehearsedCampaign]:
    """Draw the readings of a plan from the simulated world without any device.

    They are written bit by bit, as a real campaign grows.
    """
    with working(t.progress):
        secret = told.case(plan)
    source = "rehearsal in a simulated cell, without devices"
    made = secret.config.to_json()
    with CampaignFile.create(
        told.output, made, str(told.base_dir), source, overwrite=True, more={COVERS: WHOLE}
    ) as campaign:

        def measured(part: Plan, number: int, begun: float) -> Rehearsal:
            r = read_plan(secret, part, [told.seed, number], begun)
            _write(t, campaign, r.readings)
            return secret.measured(campaign.readings())

        def further(more: Plan) -> Rehearsal:
            last = last_time(campaign.readings())
            return measured(with_new_names(more, plan, 2), 2, last + BREAK)

        def missing(of: CampaignFile, epoch: float | None = None) -> None:
            # Campaigns beside the first one are told by what their names have beyond its own.
            log, number = RunLog(of), 3 + len(of.path.stem) - len(told.output.stem)
            begun = last_time(campaign.readings()) + number * BREAK
            drawn = read_plan(secret, log.plan, [told.seed, number], begun).readings
            for k, step in enumerate(log.plan.steps):
                log.record(drawn[slice(k, k + 1)], step, {"drawn": True})

        yield RehearsedCampaign(measured(plan, 1, 0.0), further, missing)


@command()
def last_time(readings: str | None) -> None:
    """Return when the last reading was taken, s; 0 where that is not known."""
    time = readings.states.time
    return 0.0 if time is None else float(time.max())


def to_the_end(t: Terminal, work: Callable[[], object], done: Callable[[], int]) -> None:
    """Do the work of measuring what is missing, and go on after a failure as `run --resume` does.

    A busy computer gives a simulated device no turn for a while, which is the same to the driver
    as a device that fails. `done` tells how many readings there are.
    """
    left, before = TRIES, done()
    while True:
        try:
            work()
        except DeviceError as error:
            now = done()
            left, before = (TRIES if now > before else left) - 1, now
            if left <= 0:
                raise
            t.notice(f"note: {error}")
            t.notice("going on with what is missing")
        else:
            return


@command()
def _write(t: Terminal, campaign: CampaignFile, readings: str | None) -> None:
    """Append readings in their order, pose after pose."""
    starts = [0, *(np.flatnonzero(np.diff(readings.pose)) + 1).tolist(), len(readings)]
    with counting(t.progress, "measuring poses", len(starts) - 1) as advance:
        for begin, end in pairwise(starts):
            campaign.append_readings(readings[slice(begin, end)])
            advance(1)


NEXT_SEED = 1000
"""Between the seeds of two starts: each device takes the seed and a few that follow."""


@contextmanager
def lasting_cell(p: Procedure) -> Iterator[CellConfig]:
    """Run the simulated devices of a calibration, whose campaign file is there.

    What is true follows from the cell, its first plan and the seed, which do not change. The
    world's time has gone on since its first start; the devices' noise is another each time.
    """
    with CampaignFile.open(p.run) as campaign:
        plan, log = RunLog(campaign).plans[0], ProcedureLog(campaign)
        starts = [entry for entry in log.entries() if entry["kind"] == WORLD]
        now = time.time()
        log.append(WORLD, {"wall_s": now})
    choice, seed = p.settings.hide or NOTHING, p.settings.seed
    secret = case_of_plan(p.config, plan, choice, seed, p.catalogue, p.base_dir)
    passed = now - starts[0]["wall_s"] if starts else 0.0
    begun = max(passed, 0.0) * p.config.simulation.clock
    own = seed + NEXT_SEED * len(starts)
    with simulated_cell(secret, own, p.base_dir, begun=begun) as there:
        yield there.config


FASTEST = 200.0
"""Clock of a simulated world, as `[simulation] clock` allows."""


@command(
    """
    output | -o --output DIR | Where the devices meet; gets a cell.toml.
    hide | --hide EFFECT | An effect, random or nothing.
    seed | --seed | Of everything random.
    person | --person | `run` asks you for each load, as in a real cell; without it nobody is asked.
    clock | --clock N | The simulated world goes so many times faster than real time, e.g. 20.
    """
)
def simulate(
    cell: Path,
    output: Path,
    plan: Path | None = None,
    hide: str | None = None,
    seed: int | None = None,
    person: bool = False,
    clock: float | None = None,
    effects_from: list[Path] | None = None,
) -> None:
    """Run simulated devices for a cell until Ctrl-C, for `check` and `run` to talk to."""
    t, catalogue = terminal(False), catalogue_with(effects_from)
    config, numbers = read_cell(cell)
    number = check_seed(config.simulation.seed if seed is None else seed)
    if clock is not None:
        if not 1.0 <= clock <= FASTEST:
            raise InputError(f"--clock {clock:g}; valid: a number from 1 to {FASTEST:g}")
        simulation = config.simulation.model_copy(update={"clock": clock})
        config = config.model_copy(update={"simulation": simulation})
    base_dir = cell.absolute().parent
    choice = hide or config.simulation.hide or NOTHING
    as_told(config, choice, catalogue)  # refuses what cannot be hidden before anything is planned
    with working(t.progress) as say:
        if plan is None:
            say("planning a campaign, to know how strong an effect has to be")
            made = make_plan(numbers, config, POSES, number, catalogue, say)
        else:
            made = load_plan(plan)
        say("preparing the simulated cell")
        secret = case_of_plan(config, made, choice, number, catalogue, base_dir)
    if secret.hidden != NOTHING and (config.fitted, secret.mode) == ("deflection", "absolute"):
        what = f"{choice} hides what they may not show" if choice == RANDOM else f"{choice} cancels"
        t.notice(
            f"warning: deflections are planned and fitted, and {what} in them; set readings = "
            f'"absolute" in [planning] of {cell} for a campaign that shows it'
        )
    with told_to_end(signal.SIGTERM, signal.SIGINT, signal.SIGHUP) as wait, ExitStack() as stack:
        with working(t.progress) as say:
            say("starting the devices")
            there = stack.enter_context(simulated_cell(secret, number, base_dir, output))
        target = output / "cell.toml"
        told = with_person(there.config) if person else there.config
        replace_file(target, to_toml(_placed(told, base_dir)))
        t.show(f"The devices run. Their cell is {target}; go on in another terminal with:")
        t.command(shlex.join(("hilcal", "check", str(target))))
        which = () if plan is None else ("--plan", str(plan))
        t.command(shlex.join(("hilcal", "run", str(target), *which, "-o", "run.hilcal")))
        t.show("Ctrl-C ends them.")
        wait()
    t.show("The devices have ended.")


def with_person(config: CellConfig) -> CellConfig:
    """Return the configuration of a simulated cell whose loads are left to a person."""
    options = {**config.operator.options, "person": True}
    operator = config.operator.model_copy(update={"options": options})
    return config.model_copy(update={"operator": operator})


def _placed(config: CellConfig, base_dir: Path) -> CellConfig:
    """Return the configuration with a robot's files named by their whole paths."""
    told = {"model": config.robot.model, "calibration": config.robot.calibration or ""}
    files = {k: str((base_dir / v).absolute()) for k, v in told.items() if Path(v).suffix}
    robot = config.robot.model_copy(update=files)
    return config.model_copy(update={"robot": robot})
