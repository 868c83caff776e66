"""`run` and `simulate`: campaigns on devices, in a simulated cell, or drawn at once."""

import shlex
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import FrameType

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import POSES, catalogue_with, check_seed, command
from hilcal.cli.planning import (
    answer_json,
    dry_checked,
    make_plan,
    read_cell,
    refuse_unready,
)
from hilcal.cli.showing import followed
from hilcal.cli.terminal import Terminal, agreed, handled, somebody_there, terminal, told_to_end
from hilcal.config import CellConfig
from hilcal.config.reference import to_toml
from hilcal.design.goal import GoalRule
from hilcal.design.summary import refuse
from hilcal.diagnosis.live_model import LiveModel
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
from hilcal.errors import (
    CannotAnswerError,
    DeviceError,
    HilcalError,
    InputError,
    MovedFileError,
    StoppedError,
)
from hilcal.identification.full_covariance import full_readings
from hilcal.identification.noise_estimate import NOISE, measured_noise
from hilcal.measuring.connect import (
    ConnectionResult,
    Rig,
    connect,
    nominal_arm,
    told_by,
    with_kinematics,
)
from hilcal.measuring.devices import Clock
from hilcal.measuring.route import dry_run
from hilcal.measuring.run import HOW_ON
from hilcal.measuring.run import run as run_plan
from hilcal.names import quoted
from hilcal.numbers import sentence
from hilcal.present.campaign import factory_words
from hilcal.present.diagnosis import NEWCOMER
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.plan import plan_facts
from hilcal.present.progress import Say, counting, full_words, missed_words, watching, working
from hilcal.present.registration import covariance_words
from hilcal.procedure.procedure import Measure, Procedure, checked_plan
from hilcal.procedure.state import WORLD
from hilcal.readings.covariance import COVERS, WHOLE
from hilcal.readings.readings import Readings
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, load_plan, with_new_names
from hilcal.store.procedure_log import ProcedureLog
from hilcal.store.run_log import RunLog, check_same_cell, create_run
from hilcal.transfer.factory import check_factory
from hilcal.whole_file import replace_file


@command("""
    output | -o --output RUN.hilcal | The campaign file.
    resume | --resume | Go on with what is missing in RUN.hilcal.
    append | --append | Measure a further plan into RUN.hilcal, see hilcal next.
    rehearse | --rehearse | On simulated devices, started for this run.
    until | --until GOAL | End as soon as a goal is met, e.g. "joint std < 2 %" or "deflection std <
        20 um": the arm goes home, and the load is taken off. Exit 4 where all readings do not do;
        they are kept.
    yes | --yes -y | Without --plan: do not ask whether to measure what was planned.
    """)
def run(
    cell: Path, output: Path, plan: Path | None = None, resume: bool = False, append: bool = False,
    rehearse: bool = False, until: str | None = None, yes: bool = False, view: bool = False,
    effects_from: list[Path] | None = None, as_json: bool = False,
) -> None:  # fmt: skip
    """Measure a campaign: every step of the plan, each reading stored before the next motion."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    config, numbers = read_cell(cell)
    goal = None if until is None else GoalRule(until, numbers, config, catalogue)
    base_dir = cell.absolute().parent
    if rehearse:  # what cannot be hidden is refused before anything is planned
        as_told(config, config.simulation.hide or NOTHING, catalogue)
    with ExitStack() as stack:
        further: Plan | None = None
        if resume or append:
            if resume and append:
                raise InputError("--append begins a further plan, --resume goes on; give one")
            if resume and plan is not None:
                raise InputError("--plan with --resume: the plan is in the campaign; leave it out")
            if append and plan is None:
                raise InputError("--append needs the further plan: give it with --plan PLAN")
            campaign = stack.enter_context(CampaignFile.open(output, check_revisions=False))
            check_same_cell(campaign, config, base_dir)
            made = RunLog(campaign).plans[0]
            if plan is not None:
                further = RunLog(campaign).with_new_names(load_plan(plan))
                refuse(dry_checked(t, numbers, config, further), str(plan))
        else:
            if output.exists():
                raise InputError(
                    f"{output}: the file exists; go on with it by --resume, add a plan by "
                    "--append, or choose another name"
                )
            made = load_plan(plan) if plan else _own_plan(t, cell, config, numbers, catalogue, yes)
            refuse(dry_checked(t, numbers, config, made), str(plan or "the plan"))
        if rehearse:
            with working(t.progress) as say:
                say("starting the simulated devices")
                choice, seed = config.simulation.hide or NOTHING, config.simulation.seed
                secret = case_of_plan(config, made, choice, seed, catalogue, base_dir)
                config = stack.enter_context(simulated_cell(secret, seed, base_dir)).config
        if further is not None:
            RunLog(campaign).append(further)
        elif not resume:
            campaign = stack.enter_context(create_run(output, config, base_dir, made))
        planned = len(RunLog(campaign).plan.steps) * len(numbers.all_targets)
        more = ["--rehearse"] * rehearse + ["--view"] * view
        more += [] if until is None else ["--until", until]
        more += [word for path in effects_from or () for word in ("--effects-from", str(path))]
        on = shlex.join(("hilcal", "run", str(cell), "-o", str(output), "--resume", *more))
        live = stack.enter_context(followed(t, view, output))
        with _says_how_to_resume(campaign, planned, on):
            measured = measure(t, config, numbers, campaign, goal, viewer=live)
    document: dict[str, object] = {"campaign": str(output), "readings": measured}
    document["planned"] = planned
    if goal is not None:
        document["goal"] = goal.status.to_dict()
        if goal.status.met:
            t.show(f'The goal "{goal.goal.text}" is met: {full_words(goal.status)}.')
    of = "" if measured == planned else f" of {planned}"
    t.show(f"{measured}{of} readings are in {output}. Go on with: hilcal refine {quoted(output)}")
    missed: CannotAnswerError | None = None
    if goal is not None and not goal.status.met:
        on = f"hilcal plan {quoted(cell)} -o more.json --after {quoted(output)}"
        words = f"{missed_words(goal.status, measured)}; plan on with: {on}"
        missed = CannotAnswerError(words)
    t.document(document, missed)


def _own_plan(
    t: Terminal, path: Path, config: CellConfig, cell: Cell, catalogue: Catalogue, yes: bool
) -> Plan:
    """Make a plan, show it, and ask whether to measure it, where somebody can be asked."""
    with working(t.progress) as say:
        seed = check_seed(config.simulation.seed)
        rng = np.random.default_rng(seed)
        made = checked_plan(cell, config, POSES, rng, catalogue, say)
    t.show(plan_facts(made.summary))
    whole = ("hilcal", "plan", str(path), "-o", "plan.json", *(("--seed", str(seed)) * bool(seed)))
    if notes := len(made.summary.remarks):
        t.show(f"What it assumes and leaves out ({notes} note{'s' * (notes > 1)}):")
        t.command(shlex.join(whole))
    if yes or not somebody_there(t):
        return made.plan
    t.notice("")
    if not agreed(t, "Measure this plan now? The arm will move."):
        raise StoppedError(
            "not measured, nothing has moved. To see, keep or change the whole plan: "
            + shlex.join(whole)
        )
    return made.plan


@contextmanager
def _says_how_to_resume(campaign: CampaignFile, planned: int, on: str) -> Iterator[None]:
    """Let whatever ends a run early say what is safe, and the line that goes on."""

    def safe() -> str:
        return f"{campaign.n_readings} of {planned} readings are safe; go on with: {on}"

    try:
        try:
            yield
        finally:
            campaign.check_place()
    except MovedFileError as error:
        words = str(error).removesuffix(HOW_ON).rstrip(". ")
        raise MovedFileError(f"{words}; then go on with: {on}") from error
    except KeyboardInterrupt:
        raise StoppedError(f"interrupted: the arm stands, {safe()}") from None
    except HilcalError as error:
        words = str(error)
        if not words.endswith(HOW_ON):
            raise
        raise type(error)(words.removesuffix(HOW_ON) + safe()) from error


def measure(
    t: Terminal,
    config: CellConfig,
    cell: Cell,
    campaign: CampaignFile,
    goal: GoalRule | None = None,
    epoch: float | None = None,
    viewer: LiveViewer | None = None,
) -> int:
    """Measure what is missing in a campaign; returns how many readings it then holds.

    With a goal it is only as much as that needs; nothing where it is met already. The campaign's
    time counts from `epoch`, a time of day in s, where that is given. A live viewer is told all.
    """
    log = RunLog(campaign)
    stored = log.readings()
    if goal is not None and stored is not None and goal(stored, last=True).met:
        kinds = [e["kind"] for e in log.events() if e["kind"] != "noise"]
        if kinds[-1:] == ["finished"]:  # the last session came to its end: nothing hangs
            return campaign.n_readings
    with _ends_as_interrupt(t), ExitStack() as stack:
        with working(t.progress) as say:
            say("connecting to every device")
            rig, answers = connect(config)
            if rig is not None:
                stack.callback(rig.close)
                answers = tuple(_sighted(rig, answer, say) for answer in answers)
        answers = with_kinematics(answers, cell)
        refuse_unready(answers)
        assert rig is not None  # noqa: S101  (refuse_unready has raised otherwise)
        if viewer is not None:
            viewer.measuring(campaign.path.name, cell, log)
        watcher = stack.enter_context(watching(t.progress, len(log.plan.steps), viewer))
        log.event("devices", {"answers": [answer_json(answer) for answer in answers]})
        clock = Clock(config.simulation.clock)
        live = LiveModel(cell, config)
        run_plan(rig, cell, config, log.plan, log, clock, watcher, live, goal=goal, epoch=epoch)
    estimate_noise(t, config, cell, campaign)
    return campaign.n_readings


def estimate_noise(t: Terminal, config: CellConfig, cell: Cell, campaign: CampaignFile) -> None:
    """Estimate, store and say the noise of measured readings that nothing states."""
    log = RunLog(campaign)
    found = measured_noise(campaign.readings(), cell, config)
    if found is not None:
        log.event(NOISE, asdict(found))
        t.notice(sentence(covariance_words("instrument", found)))
    elif log.last(NOISE) is not None:  # of fewer readings, which these do not bear out
        log.event(NOISE, {"factors": None})


def _sighted(rig: Rig, answer: ConnectionResult, say: Say) -> ConnectionResult:
    """Let a tracker that has lost its target search for it; only its telescope turns."""
    if answer.device != "tracker" or not answer.problems:
        return answer
    say(f"tracker: {answer.problems[0]}; searching")
    with suppress(DeviceError):  # what it then says of itself is what counts
        rig.tracker.find_target()
        return replace(answer, report=rig.tracker.report())
    return answer


@contextmanager
def _ends_as_interrupt(t: Terminal) -> Iterator[None]:
    """Let Ctrl-C, a plea to end, or a closed terminal stop the arm; once is enough.

    Stopping has deadlines of its own, so whoever asks again meanwhile is told to wait. Signals are
    for a process's main thread; in another one, as of a worker of many, the process's end stops it.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if len(asked) == 1:
            raise KeyboardInterrupt
        t.notice("stopping the arm; wait a moment")

    with handled((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), stop):
        yield


TRIES = 4
BREAK = 600.0  # Between two plans of a campaign that is drawn by lots, s


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


def last_time(readings: Readings) -> float:
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


def _write(t: Terminal, campaign: CampaignFile, readings: Readings) -> None:
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


FASTEST = 200.0  # Clock of a simulated world, as `[simulation] clock` allows


@command("""
    output | -o --output DIR | Where the devices meet; gets a cell.toml.
    hide | --hide EFFECT | An effect, random or nothing.
    seed | --seed | Of everything random.
    person | --person | `run` asks you for each load, as in a real cell; without it nobody is asked.
    clock | --clock N | The simulated world goes so many times faster than real time, e.g. 20.
    """)
def simulate(
    cell: Path, output: Path, plan: Path | None = None, hide: str | None = None,
    seed: int | None = None, person: bool = False, clock: float | None = None,
    effects_from: list[Path] | None = None,
) -> None:  # fmt: skip
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


FACTORY_POSES = 20
"""Poses without a load; a choice: of 12 an offset of one encoder by 1 mrad may stay in doubt."""


def factory_check(
    t: Terminal,
    config: CellConfig,
    cell: Cell,
    catalogue: Catalogue,
    answers: tuple[ConnectionResult, ...],
    output: Path,
    yes: bool,
) -> dict[str, object]:
    """Measure into a campaign, or take one that is there, and say what it tells of the arm."""
    factory = told_by(answers) or cell.factory
    if factory is None:
        raise InputError(
            "--factory: the arm's controller does not tell its kinematics; give [robot] calibration"
        )
    if not output.exists():
        _measured(t, config, cell, catalogue, output, yes)
    with Campaign.open(output, catalogue, read_only=True) as run, working(t.progress) as say:
        say("fitting all effects from the factory's kinematics")
        found = check_factory(run.cell, nominal_arm(run.cell), factory, run.readings, catalogue)
    t.show(factory_words(found))
    return {**asdict(found), "campaign": str(output)}


def _measured(
    t: Terminal, config: CellConfig, cell: Cell, catalogue: Catalogue, output: Path, yes: bool
) -> None:
    planning = config.planning.model_copy(update={"readings": "absolute"})
    bare = config.model_copy(update={"loads": (), "planning": planning, "force_sensor": None})
    numbers = cell_from_config(bare, cell.base_dir)
    with working(t.progress) as say:
        plan = make_plan(numbers, bare, FACTORY_POSES, config.simulation.seed, catalogue, say)
    refuse(dry_checked(t, numbers, bare, plan), "the plan")
    steps = len(plan.steps)
    if not yes:
        if not somebody_there(t):
            raise InputError(
                f"--factory measures {steps} readings, the arm moves; agree with --yes"
            )
        if not agreed(t, f"Measure {steps} readings without a load? The arm will move."):
            raise StoppedError("not measured, nothing has moved")
    with create_run(output, bare, cell.base_dir, plan) as campaign:
        measure(t, bare, numbers, campaign)
