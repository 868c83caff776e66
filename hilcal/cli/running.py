"""`run`, and `check --factory`: campaigns on devices."""

import shlex
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType

import numpy as np

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.options import POSES, check_seed, command
from hilcal.cli.planning import answer_json, dry_checked, make_plan, refuse_unready
from hilcal.cli.showing import live_viewer
from hilcal.cli.terminal import Terminal, confirmed, handled, person_present
from hilcal.design.goal import GoalRule
from hilcal.design.summary import refuse
from hilcal.diagnosis.live_model import LiveModel
from hilcal.drivers.simulated.rehearsal import (
    NO_EFFECT,
    case_of_plan,
    program_config,
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
from hilcal.identification.noise.noise_estimate import NOISE_KEY, measured_noise
from hilcal.measuring import connect
from hilcal.measuring.devices import Clock, TargetLostError
from hilcal.measuring.run import HOW_ON
from hilcal.measuring.run import run as run_plan
from hilcal.names import quoted
from hilcal.numbers import sentence
from hilcal.present.campaign import factory_words
from hilcal.present.live_viewer import LiveViewer
from hilcal.present.plan import plan_facts
from hilcal.present.progress import CampaignProgress, Say, full_words, missed_words, working
from hilcal.present.registration import covariance_words
from hilcal.procedure.procedure import checked_plan
from hilcal.readings.readings import SAME_POSE
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, load_plan
from hilcal.store.procedure_log import refuse_fitting
from hilcal.store.run_log import (
    PLAN,
    REHEARSED,
    RunLog,
    changed_since_begun,
    check_same_arm,
    check_same_cell,
    check_same_devices,
    create_run,
)
from hilcal.transfer.compare import check_factory

UNSURE_ARM = (
    "the arm reports no serial number, or did not before: nothing shows that it is the arm of this "
    "campaign; if it is another one, stop and start another campaign"
)


@command("""
    output | -o --output RUN.hilcal | The campaign file.
    resume | --resume | Measure what is missing in RUN.hilcal.
    skip | --skip POSE | With --resume: omit a pose that cannot be measured; repeatable.
    append | --append | Add the readings of a further plan to RUN.hilcal, see hilcal next.
    rehearse | --rehearse | Measure on simulated devices that are started for this run.
    until | --until GOAL | Stop as soon as a goal is met, e.g. "joint std < 2 %" or "deflection std
        < 20 um": the arm goes home, and the load is taken off. Exit 4 if it is not met after all
        readings; they are kept.
    yes | --yes -y | Without --plan: measure the plan that is made without asking.
    """)
def run(
    t: Terminal, catalogue: Catalogue, cell: Path, output: Path, plan: Path | None = None,
    resume: bool = False, append: bool = False, skip: list[str] | None = None,
    rehearse: bool = False, until: str | None = None, yes: bool = False, view: bool = False,
    effects_from: list[Path] | None = None,
) -> None:  # fmt: skip
    """Measure a campaign: every step of the plan, each reading stored before the next motion."""
    robot_cell = Cell.load(cell)
    config = robot_cell.configured()
    goal = None if until is None else GoalRule(until, robot_cell, catalogue)
    base_dir = cell.absolute().parent
    if skip and not resume:
        raise InputError("--skip omits missing poses of a campaign; give it with --resume")
    if rehearse:  # refuses an effect that cannot be hidden before anything is planned
        program_config(config, config.simulation.hide or NO_EFFECT, catalogue)
    elif plan is None and not resume:
        connect.drivers_of(config)  # refuses a cell without them before anything is planned
    with ExitStack() as stack:
        further: Plan | None = None
        if resume or append:
            if resume and append:
                raise InputError(
                    "--append adds a plan, --resume continues the present one; give one"
                )
            if resume and plan is not None:
                raise InputError("--plan with --resume: the plan is in the campaign; leave it out")
            if append and plan is None:
                raise InputError("--append needs the further plan: give it with --plan PLAN")
            campaign = stack.enter_context(CampaignFile.open(output, check_revisions=False))
            campaign.measure_alone()
            check_same_devices(campaign, rehearse)
            check_same_cell(campaign, config, base_dir)
            for text in changed_since_begun(campaign, config):
                t.notice(f"note: {text}")
            log = RunLog(campaign)
            campaign_plan = log.plans[0]
            if plan is not None:
                refuse_fitting(campaign)  # a further plan would change a frozen test
                given = load_plan(plan)
                further = log.with_new_names(given)
                if moved := _reference_moved(given, further):
                    t.notice(f"note: {plan}: {moved}")
                _check_given(t, robot_cell, further, plan)
                if missing := len(log.plan.without(log.done()).steps):
                    t.notice(
                        f"note: {missing} readings of the previous plan are missing; they will not "
                        "be measured"
                    )
        else:
            if output.exists():
                raise InputError(
                    f"{output}: the file exists; --resume continues it, --append adds a plan; or "
                    "choose another name"
                )
            if plan is None:
                campaign_plan = _default_plan(t, cell, robot_cell, catalogue, yes)
                refuse(dry_checked(t, robot_cell, campaign_plan), "the plan")
            else:
                campaign_plan = load_plan(plan)
                _check_given(t, robot_cell, campaign_plan, plan)
        if rehearse:
            with working(t.progress) as say:
                say("starting the simulated devices")
                choice, seed = config.simulation.hide or NO_EFFECT, config.simulation.seed
                secret = case_of_plan(config, campaign_plan, choice, seed, catalogue, base_dir)
                config = stack.enter_context(simulated_cell(secret, seed, base_dir)).config
                robot_cell = robot_cell.with_config(config)
        else:
            connect.drivers_of(config)  # before a campaign is begun
        if skip:
            RunLog(campaign).skip(skip)
        if further is not None:
            RunLog(campaign).append(further)
        elif not resume:
            source = f"{REHEARSED if rehearse else 'measured'} by hilcal run"
            campaign = stack.enter_context(
                create_run(output, config, base_dir, campaign_plan, source=source)
            )
        planned = len(RunLog(campaign).plan.steps) * len(robot_cell.all_targets)
        options = ["--rehearse"] * rehearse + ["--view"] * view
        options += [] if until is None else ["--until", until]
        options += [word for path in effects_from or () for word in ("--effects-from", str(path))]
        line = shlex.join(("hilcal", "run", str(cell), "-o", str(output), "--resume", *options))
        live = stack.enter_context(live_viewer(t, view, output))
        with _resumable(campaign, planned, line):
            measured = measure(t, robot_cell, campaign, goal, viewer=live)
    document: dict[str, object] = {"campaign": str(output), "readings": measured}
    document["planned"] = planned
    if goal is not None:
        document["goal"] = goal.status.to_dict()
        if goal.status.met:
            t.show(f'The goal "{goal.goal.text}" is met: {full_words(goal.status)}.')
    count = f"{measured}" if measured == planned else f"{measured} of {planned}"
    t.show(f"{count} readings are in {output}. Go on with: hilcal refine {quoted(output)}")
    missed: CannotAnswerError | None = None
    if goal is not None and not goal.status.met:
        line = f"hilcal plan {quoted(cell)} -o more.json --after {quoted(output)}"
        missed = CannotAnswerError(f"{missed_words(goal.status, measured)}; plan on with: {line}")
    t.document(document, missed)


def _reference_moved(given: Plan, renamed: Plan) -> str:
    """Return that the reference pose of a further plan is replaced by the campaign's, or ""."""
    if REFERENCE not in given.pose_names:
        return ""
    far = float(np.abs(renamed.joints(REFERENCE) - given.joints(REFERENCE)).max())
    if far <= SAME_POSE:
        return ""
    return (
        f'its pose "{REFERENCE}" is up to {far:.3g} rad from that of the campaign, to which the '
        "arm goes in its place: the drift is measured there"
    )


def _check_given(t: Terminal, cell: Cell, plan: Plan, path: Path) -> None:
    """Check a given plan in a dry run, and print its remarks; refuse a plan with problems."""
    dry = dry_checked(t, cell, plan)
    refuse(dry, str(path))
    for remark in dry.remarks:
        t.notice(f"note: {path}: {remark}")


def _default_plan(t: Terminal, path: Path, cell: Cell, catalogue: Catalogue, yes: bool) -> Plan:
    """Make a plan and show it; ask whether to measure it, unless `yes` or nobody can answer."""
    with working(t.progress) as say:
        seed = check_seed(cell.configured().simulation.seed)
        rng = np.random.default_rng(seed)
        planned = checked_plan(cell, POSES, rng, catalogue, say)
    t.show(plan_facts(planned.summary))
    options = ("--seed", str(seed)) if seed else ()
    line = shlex.join(("hilcal", "plan", str(path), "-o", "plan.json", *options))
    if notes := len(planned.summary.remarks):
        t.show(f"Its assumptions ({notes} note{'s' * (notes > 1)}) are printed by:")
        t.command(line)
    if yes or not person_present(t):
        return planned.plan
    t.notice("")
    if not confirmed(t, "Measure this plan now? The arm will move."):
        raise StoppedError(f"not measured, nothing has moved. To write the plan to a file: {line}")
    return planned.plan


@contextmanager
def _resumable(campaign: CampaignFile, planned: int, line: str) -> Iterator[None]:
    """Add the number of stored readings and the command that resumes to errors of a run."""

    def safe() -> str:
        stored = "all stored"
        with suppress(HilcalError):  # another program may have locked the file
            stored = f"{campaign.n_readings} of {planned}"
        return f"{stored} readings are safe; go on with: {line}"

    try:
        try:
            yield
        finally:
            campaign.check_place()
    except MovedFileError as error:
        message = str(error).removesuffix(HOW_ON).rstrip(". ")
        raise MovedFileError(f"{message}; then go on with: {line}") from error
    except KeyboardInterrupt:
        raise StoppedError(f"interrupted: the arm stands, {safe()}") from None
    except HilcalError as error:
        message = str(error)
        if not message.endswith(HOW_ON):
            raise
        raise type(error)(message.removesuffix(HOW_ON) + safe()) from error


def measure(
    t: Terminal,
    cell: Cell,
    campaign: CampaignFile,
    goal: GoalRule | None = None,
    epoch: float | None = None,
    viewer: LiveViewer | None = None,
) -> int:
    """Measure what a campaign lacks, until a goal is met; `epoch` is the wall time at zero, s."""
    config = cell.configured()
    campaign.measure_alone()
    log = RunLog(campaign)
    stored = log.readings()
    kinds = [e["kind"] for e in log.events() if e["kind"] != NOISE_KEY]
    complete = kinds[-1:] == ["finished"]  # the last session has reported the load on the arm
    if goal is not None and stored is not None and goal(stored, last=True).met and complete:
        return campaign.n_readings
    if not log.plan.without(log.done()).steps:
        t.notice("nothing is missing")
        hung = (log.last("load") or {}).get("hanging", UNLOADED)
        if not complete and hung not in (None, UNLOADED):
            t.notice(f"load {hung} may still be on the arm: take it off")
        estimate_noise(t, cell, campaign)  # the last session may have ended before it
        return campaign.n_readings
    with _ends_as_interrupt(t) as stop_requested, ExitStack() as stack:
        with working(t.progress) as say:
            say("connecting to every device")
            rig, answers = connect.connect(config)
            if rig is not None:
                stack.callback(rig.close)
                answers = tuple(_sighted(rig, answer, say) for answer in answers)
        answers = connect.with_kinematics(answers, cell)
        refuse_unready(answers)
        assert rig is not None  # noqa: S101  (refuse_unready has raised otherwise)
        if viewer is not None:
            viewer.measuring(campaign.path.name, cell, log)
        total, done = len(log.plan.steps), len(log.done())
        watcher = stack.enter_context(CampaignProgress(t.progress, total, viewer, done))
        log.event("devices", {"answers": _same_arm(t, campaign, answers)})
        clock = Clock(config.clock)
        run_plan(
            rig, cell, log.plan, log, clock, watcher, LiveModel(cell), goal=goal, epoch=epoch,
            stop_requested=stop_requested,
        )  # fmt: skip
    estimate_noise(t, cell, campaign)
    return campaign.n_readings


def _same_arm(
    t: Terminal, campaign: CampaignFile, answers: tuple[connect.ConnectionResult, ...]
) -> list[dict[str, object]]:
    """Refuse another arm than the campaign's, and say where that is not known; return answers."""
    identities = [answer_json(answer) for answer in answers]
    if not check_same_arm(RunLog(campaign), identities):
        t.notice(f"warning: {campaign.path}: {UNSURE_ARM}")
    return identities


def estimate_noise(t: Terminal, cell: Cell, campaign: CampaignFile) -> None:
    """Estimate, store and print the noise of the readings, where no source states it."""
    log = RunLog(campaign)
    noise = measured_noise(campaign.readings(), cell)
    if noise is not None:
        log.event(NOISE_KEY, asdict(noise))
        t.notice(sentence(covariance_words("instrument", noise)))
    elif log.last(NOISE_KEY) is not None:  # withdraws an estimate from fewer readings
        log.event(NOISE_KEY, {"factors": None})


IN_SIGHT = "if the arm hides the target, move the arm by hand until the tracker sees it"


def _sighted(
    rig: connect.Rig, answer: connect.ConnectionResult, say: Say
) -> connect.ConnectionResult:
    """Let a tracker that has lost its target search for it; the arm does not move."""
    if answer.device != "tracker" or not answer.problems:
        return answer
    say(f"{answer.problems[0]}; searching")
    try:
        rig.tracker.find_target()
        return replace(answer, report=rig.tracker.report())
    except TargetLostError:
        if answer.report is None:
            return answer
        *others, last = answer.report.problems
        advice = f"{last}; {IN_SIGHT}"
        return replace(answer, report=replace(answer.report, problems=(*others, advice)))
    except DeviceError:  # the tracker's report decides
        return answer


@contextmanager
def _ends_as_interrupt(t: Terminal) -> Iterator[Callable[[], bool]]:
    """Raise KeyboardInterrupt at the first SIGINT, SIGTERM or SIGHUP, so that the arm stops.

    Yields whether a signal has come: a driver may suppress the exception. Stopping has its own
    deadlines: further signals only print a notice. Threads other than the main one cannot handle
    signals; there, only the end of the process stops the measurement.
    """
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    received: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        received.append(number)
        if len(received) == 1:
            raise KeyboardInterrupt
        t.notice("stopping the arm; wait a moment")

    with handled((signal.SIGINT, signal.SIGTERM, signal.SIGHUP), stop):
        yield lambda: bool(received)


FACTORY_SOURCE = "measured by hilcal check --factory"
FACTORY_POSES = 20  # Without a load; a choice: with 12, an encoder offset of 1 mrad may be in doubt


def factory_check(
    t: Terminal,
    path: Path,
    catalogue: Catalogue,
    answers: tuple[connect.ConnectionResult, ...],
    output: Path,
    yes: bool,
) -> dict[str, object]:
    """Compare the arm with its factory kinematics on a campaign; measure what it lacks.

    `path` is the cell file. An existing campaign that was not begun here is taken as it is.
    """
    cell = Cell.load(path)
    factory = connect.reported_kinematics(answers) or cell.factory
    if factory is None:
        raise InputError(
            "--factory: no kinematics reported by the arm's controller; give [robot] calibration"
        )
    _measure_without_loads(t, path, cell, catalogue, output, yes)
    with CampaignFile.open(output, read_only=True) as campaign:
        if answers and campaign.about(PLAN) is not None:
            _same_arm(t, campaign, answers)
    with Campaign.open(output, catalogue, read_only=True) as run, working(t.progress) as say:
        say("fitting all effects from the factory's kinematics")
        checked = check_factory(
            run.cell, connect.nominal_arm(run.cell), factory, run.readings, catalogue
        )
    t.show(factory_words(checked))
    return {**asdict(checked), "campaign": str(output)}


def _measure_without_loads(
    t: Terminal, path: Path, cell: Cell, catalogue: Catalogue, output: Path, yes: bool
) -> None:
    plan, missing = None, 0
    if output.exists():
        with CampaignFile.open(output, read_only=True) as campaign:
            if campaign.source == FACTORY_SOURCE:
                log = RunLog(campaign)
                plan, missing = log.plan, len(log.plan.without(log.done()).steps)
        if not missing:
            return
    config = cell.configured()
    bare = config.with_keys("planning", readings="absolute")
    bare = bare.model_copy(update={"loads": (), "force_sensor": None})
    robot_cell = cell_from_config(bare, cell.base_dir)
    if plan is None:
        with working(t.progress) as say:
            plan = make_plan(robot_cell, FACTORY_POSES, config.simulation.seed, catalogue, say)
        refuse(dry_checked(t, robot_cell, plan), "the plan")
    steps = len(plan.steps)
    if not yes:
        count = missing or steps
        if not person_present(t):
            raise InputError(
                f"--factory measures {count} readings and moves the arm; agree with --yes"
            )
        if not confirmed(t, f"Measure {count} readings without a load? The arm will move."):
            raise StoppedError("not measured, nothing has moved")
    line = shlex.join(("hilcal", "check", str(path), "--factory", str(output), *["--yes"] * yes))
    with (
        CampaignFile.open(output)
        if missing
        else create_run(output, bare, cell.base_dir, plan, source=FACTORY_SOURCE)
    ) as campaign:
        check_same_cell(campaign, bare, cell.base_dir)
        with _resumable(campaign, steps, line):
            measure(t, robot_cell, campaign)
