"""`simulate`, and rehearsals: campaigns on simulated devices, or drawn without devices."""

import shlex
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import POSES, check_seed, command
from hilcal.cli.planning import make_plan
from hilcal.cli.running import measure
from hilcal.cli.terminal import Terminal, end_signals, terminal
from hilcal.config import CellConfig
from hilcal.config.reference import to_toml
from hilcal.design.summary import refuse
from hilcal.drivers.simulated.rehearsal import (
    NO_EFFECT,
    RANDOM,
    Rehearsal,
    SimulationCase,
    case_of_plan,
    program_config,
    simulate_plan,
    simulated_cell,
)
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import DeviceError, InputError
from hilcal.identification.noise.full_covariance import full_readings
from hilcal.measuring.route import dry_run
from hilcal.measuring.run import HOW_ON
from hilcal.present.diagnosis import RUN_EXPLANATION
from hilcal.present.progress import Say, counting, working
from hilcal.procedure.procedure import Measure, Procedure
from hilcal.procedure.state import WORLD
from hilcal.readings.covariance import COVERS_KEY, INSTRUMENT_AND_ARM
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, load_plan, with_new_names
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import REHEARSED, RunLog, create_run
from hilcal.whole_file import replace_file, spare_other

TRIES = 4
BREAK_S = 600.0  # Time between two plans of a campaign that is drawn at random, s


@dataclass(frozen=True, slots=True)
class RehearsalSettings:
    """Cell, hidden effect and files of a rehearsal."""

    config: CellConfig
    choice: str  # the hidden effect, "random" or "nothing"
    seed: int
    output: Path
    base_dir: Path  # directory that paths in the configuration are relative to
    catalogue: Catalogue  # the effects of models
    world: Catalogue  # the effects that can be hidden

    def case(self, plan: Plan) -> SimulationCase:
        """Hide the choice in the simulated cell; see `case_of_plan`."""
        return case_of_plan(self.config, plan, self.choice, self.seed, self.world, self.base_dir)


@dataclass(frozen=True, slots=True, eq=False)
class RehearsedCampaign:
    """A first campaign, in a simulated cell that can measure again."""

    rehearsal: Rehearsal  # the cell, and all readings
    measure_plan: Callable[[Plan], Rehearsal]  # measures another plan into it; all readings
    measure_missing: Measure  # measures the missing readings of another campaign in the same cell


def first_plan(settings: RehearsalSettings, config: CellConfig, poses: int, say: Say) -> Plan:
    """Plan a campaign without knowledge of the hidden effect, in a cell that may lack loads."""
    config = program_config(config, settings.choice, settings.world)
    cell = cell_from_config(config, settings.base_dir)
    plan = make_plan(cell, poses, settings.seed, settings.catalogue, say)
    refuse(dry_run(cell, plan), "the plan")
    return plan


@contextmanager
def on_devices(t: Terminal, settings: RehearsalSettings, plan: Plan) -> Iterator[RehearsedCampaign]:
    """Run a plan by the real drivers on simulated devices, processes that end with the block."""
    with ExitStack() as stack:
        with working(t.progress) as say:
            secret = settings.case(plan)
            say("starting the simulated devices")
            world = stack.enter_context(simulated_cell(secret, settings.seed, settings.base_dir))
        t.notice(RUN_EXPLANATION)
        campaign = stack.enter_context(
            create_run(
                settings.output,
                world.config,
                settings.base_dir,
                plan,
                overwrite=True,
                source=f"{REHEARSED} by hilcal demo",
            )
        )

        def missing(file: CampaignFile, epoch: float | None = None) -> None:
            def work() -> None:
                measure(t, secret.cell.with_config(world.config), file, epoch=epoch)

            retry_after_failures(t, work, lambda: file.n_readings)

        def measured() -> Rehearsal:
            missing(campaign)
            stored = campaign.readings(), campaign.about(COVERS_KEY)
            readings = full_readings(*stored, secret.cell.with_config(world.config))
            return secret.measured(readings, world.config)

        def further(next_plan: Plan) -> Rehearsal:
            log = RunLog(campaign)
            log.append(log.with_new_names(next_plan))
            return measured()

        yield RehearsedCampaign(measured(), further, missing)


@contextmanager
def in_process(t: Terminal, settings: RehearsalSettings, plan: Plan) -> Iterator[RehearsedCampaign]:
    """Draw the readings of a plan in the simulated world; they are stored pose by pose."""
    with working(t.progress):
        secret = settings.case(plan)
    source = "rehearsal in a simulated cell, without devices"
    text = secret.config.to_json()
    with CampaignFile.create(
        settings.output,
        text,
        str(settings.base_dir),
        source,
        overwrite=True,
        more_texts={COVERS_KEY: INSTRUMENT_AND_ARM},
    ) as campaign:

        def last_time() -> float:
            time = campaign.readings().states.time
            return 0.0 if time is None else float(time.max())

        def measured(part: Plan, number: int, start: float) -> Rehearsal:
            r = simulate_plan(secret, part, [settings.seed, number], start)
            _write(t, campaign, r.readings)
            return secret.measured(campaign.readings())

        def further(next_plan: Plan) -> Rehearsal:
            return measured(with_new_names(next_plan, plan, 2), 2, last_time() + BREAK_S)

        def missing(file: CampaignFile, epoch: float | None = None) -> None:
            # The letters appended to the name of the first campaign identify a campaign.
            log, number = RunLog(file), 3 + len(file.path.stem) - len(settings.output.stem)
            start = last_time() + number * BREAK_S
            drawn = simulate_plan(secret, log.plan, [settings.seed, number], start).readings
            for k, step in enumerate(log.plan.steps):
                log.record(drawn[slice(k, k + 1)], step, {"drawn": True})

        yield RehearsedCampaign(measured(plan, 1, 0.0), further, missing)


def retry_after_failures(
    t: Terminal, work: Callable[[], object], stored_count: Callable[[], int]
) -> None:
    """Measure the missing readings by `work`; try again after a device failure.

    On a busy computer a simulated device may stall, which a driver takes for a failure. At most
    `TRIES` - 1 failures in a row without a new reading, which `stored_count` counts, are accepted.
    """
    tries, stored = TRIES, stored_count()
    while True:
        try:
            work()
            return
        except DeviceError as error:
            current = stored_count()
            tries, stored = (TRIES if current > stored else tries) - 1, current
            if tries <= 0:
                raise
            t.notice(f"note: {str(error).removesuffix(HOW_ON).rstrip()}")
            t.notice("continuing with the missing readings")


def _write(t: Terminal, campaign: CampaignFile, readings: Readings) -> None:
    starts = [0, *(np.flatnonzero(np.diff(readings.pose)) + 1).tolist(), len(readings)]
    with counting(t.progress, "measuring readings", len(readings)) as advance:
        for begin, end in pairwise(starts):
            campaign.append_readings(readings[slice(begin, end)])
            advance(end - begin)


NEXT_SEED = 1000  # Between the seeds of two starts: devices use the seed and the next few numbers


@contextmanager
def lasting_cell(p: Procedure) -> Iterator[CellConfig]:
    """Run the simulated devices of a calibration that has a campaign file.

    The true parameters follow from the cell, its first plan and the seed, which do not change. The
    world's time continues from its first start; the noise differs between starts.
    """
    with CampaignFile.open(p.run) as campaign:
        plan, log = RunLog(campaign).plans[0], ProcedureLog(campaign)
        starts = [entry for entry in log.entries() if entry["kind"] == WORLD]
        wall_s = time.time()
        log.append(WORLD, {"wall_s": wall_s})
    choice, seed = p.settings.hide or NO_EFFECT, p.settings.seed
    secret = case_of_plan(p.config, plan, choice, seed, p.catalogue, p.cell.base_dir)
    passed = wall_s - starts[0]["wall_s"] if starts else 0.0
    start = max(passed, 0.0) * p.config.simulation.clock
    device_seed = seed + NEXT_SEED * len(starts)
    with simulated_cell(secret, device_seed, p.cell.base_dir, start_s=start) as simulated:
        yield simulated.config


SIMULATED = "# Written by hilcal simulate: the devices are simulated.\n"
MAX_CLOCK = 200.0  # Largest clock rate of a simulated world, as in `[simulation] clock`


@command("""
    output | -o --output DIR | Folder for the connections of the devices and their cell.toml.
    hide | --hide EFFECT | Effect that the simulated arm has and the model lacks; random; or
        nothing.
    seed | --seed | Seed of all random numbers.
    person | --person | `run` asks you to change each load, as in a real cell; otherwise loads
        change by themselves.
    clock | --clock N | Speed of the simulated time relative to real time, e.g. 20.
    """)
def simulate(
    catalogue: Catalogue, cell: Path, output: Path, plan: Path | None = None,
    hide: str | None = None, seed: int | None = None, person: bool = False,
    clock: float | None = None,
) -> None:  # fmt: skip
    """Run the simulated devices of a cell until Ctrl-C; `check` and `run` connect to them."""
    t = terminal(False)
    robot_cell = Cell.load(cell)
    config = robot_cell.configured()
    number = check_seed(config.simulation.seed if seed is None else seed)
    if clock is not None:
        if not 1.0 <= clock <= MAX_CLOCK:
            raise InputError(f"--clock {clock:g}; valid: a number from 1 to {MAX_CLOCK:g}")
        config = config.with_keys("simulation", clock=clock)
        robot_cell = robot_cell.with_config(config)
    base_dir, target = cell.absolute().parent, output / "cell.toml"
    spare_other(target, "a cell of hilcal simulate", SIMULATED)
    choice = hide or config.simulation.hide or NO_EFFECT
    program_config(config, choice, catalogue)  # refuses an effect that cannot be hidden
    with working(t.progress) as say:
        if plan is None:
            say("planning a campaign, from which the size of the effect follows")
            campaign_plan = make_plan(robot_cell, POSES, number, catalogue, say)
        else:
            campaign_plan = load_plan(plan)
        say("preparing the simulated cell")
        secret = case_of_plan(config, campaign_plan, choice, number, catalogue, base_dir)
    fitted_and_shown = config.readings_mode, secret.mode
    if secret.hidden != NO_EFFECT and fitted_and_shown == ("deflection", "absolute"):
        cancels = "the hidden effect may cancel" if choice == RANDOM else f"{choice} cancels"
        t.notice(
            f"warning: deflections are planned and fitted, and {cancels} in them; to show it, set "
            f'readings = "absolute" in [planning] of {cell}'
        )
    with end_signals(signal.SIGTERM, signal.SIGINT, signal.SIGHUP) as wait, ExitStack() as stack:
        with working(t.progress) as say:
            say("starting the devices")
            simulated = stack.enter_context(simulated_cell(secret, number, base_dir, output))
        written = with_person(simulated.config) if person else simulated.config
        replace_file(target, SIMULATED + to_toml(_placed(written, base_dir)))
        t.show(f"The devices run; their cell is {target}. In another terminal:")
        t.command(shlex.join(("hilcal", "check", str(target))))
        plan_option = () if plan is None else ("--plan", str(plan))
        t.command(shlex.join(("hilcal", "run", str(target), *plan_option, "-o", "run.hilcal")))
        t.show("Ctrl-C stops them.")
        wait()
    t.show("The devices have stopped.")


def with_person(config: CellConfig) -> CellConfig:
    """Return the configuration of a simulated cell whose loads a person changes."""
    return config.with_keys("operator", options={**config.operator.options, "person": True})


def _placed(config: CellConfig, base_dir: Path) -> CellConfig:
    paths = {"model": config.robot.model, "calibration": config.robot.calibration or ""}
    files = {k: str((base_dir / v).absolute()) for k, v in paths.items() if Path(v).suffix}
    return config.with_keys("robot", **files)
