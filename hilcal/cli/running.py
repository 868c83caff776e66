"""`run`: measure a campaign; `--resume` goes on after any stop."""

import shlex
import signal
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from types import FrameType
from typing import Annotated

from hilcal.cell import Cell
from hilcal.cli.options import (
    POSES,
    CellFile,
    EffectsFrom,
    Json,
    PlanFile,
    View,
    catalogue_with,
    option,
)
from hilcal.cli.planning import answer_json, dry_checked, make_checked, read_cell, refuse_unready
from hilcal.cli.showing import followed
from hilcal.cli.terminal import Terminal, agreed, handled, somebody_there, terminal
from hilcal.config import CellConfig
from hilcal.design.checked_plan import refuse
from hilcal.design.goal_rule import GoalRule
from hilcal.diagnosis.live_model import LiveModel
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import (
    CannotAnswerError,
    DeviceError,
    HilcalError,
    InputError,
    MovedFileError,
    StoppedError,
)
from hilcal.measuring.connect import ConnectionResult, Rig, connect
from hilcal.measuring.devices import Clock
from hilcal.measuring.kinematics import with_kinematics
from hilcal.measuring.progress import Watcher
from hilcal.measuring.run import HOW_ON
from hilcal.measuring.run import run as run_plan
from hilcal.names import quoted
from hilcal.present.live_viewer import LiveViewer, Several
from hilcal.present.plan import plan_facts
from hilcal.present.progress import Say, full_words, missed_words, watching, working
from hilcal.store.campaign_file import CampaignFile
from hilcal.store.plan import Plan, load_plan
from hilcal.store.run_log import RunLog, check_same_cell, create_run


def run(
    cell: CellFile,
    output: Annotated[Path, option("-o --output RUN.hilcal", "The campaign file.")],
    plan: PlanFile = None,
    resume: Annotated[
        bool, option("--resume", "Go on with what is missing in RUN.hilcal.")
    ] = False,
    append: Annotated[
        bool, option("--append", "Measure a further plan into RUN.hilcal, see hilcal next.")
    ] = False,
    rehearse: Annotated[
        bool, option("--rehearse", "On simulated devices, started for this run.")
    ] = False,
    until: Annotated[
        str | None,
        option(
            "--until GOAL",
            'End as soon as a goal is met, e.g. "joint std < 2 %" or "deflection std < 20 um": '
            "the arm goes home, and the load is taken off. Exit 4 where all readings do not do; "
            "they are kept.",
        ),
    ] = None,
    yes: Annotated[
        bool, option("--yes -y", "Without --plan: do not ask whether to measure what was planned.")
    ] = False,
    view: View = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Measure a campaign: every step of the plan, each reading stored before the next motion."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    config, numbers = read_cell(cell)
    goal = None if until is None else GoalRule(until, numbers, config, catalogue)
    base_dir = cell.absolute().parent
    if rehearse:
        from hilcal.drivers.simulated.rehearsal import NOTHING, as_told

        # Refuses what cannot be hidden before anything is planned.
        as_told(config, config.simulation.hide or NOTHING, catalogue)
    with ExitStack() as stack:
        if resume:
            if append:
                raise InputError("--append begins a further plan, --resume goes on; give one")
            if plan is not None:
                raise InputError("--plan with --resume: the plan is in the campaign; leave it out")
            campaign = stack.enter_context(CampaignFile.open(output, check_revisions=False))
            check_same_cell(campaign, config, base_dir)
            made = RunLog(campaign).plans[0]
        elif append:
            campaign, further = _append(t, stack, output, plan, config, numbers, base_dir)
            made = RunLog(campaign).plans[0]
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
                from hilcal.drivers.simulated.rehearsal import case_of_plan, simulated_cell

                choice = config.simulation.hide or NOTHING
                seed = config.simulation.seed
                secret = case_of_plan(config, made, choice, seed, catalogue, base_dir)
                simulated = simulated_cell(secret, seed, base_dir)
                config = stack.enter_context(simulated).config
        if append:
            RunLog(campaign).append(further)
        elif not resume:
            campaign = stack.enter_context(create_run(output, config, base_dir, made))
        planned = len(RunLog(campaign).plan.steps) * len(numbers.all_targets)
        more = (*_given("--rehearse", rehearse), *_given("--until", until))
        more = (*more, *_given("--view", view))
        for path in effects_from or ():
            more = (*more, "--effects-from", str(path))
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
        made = make_checked(cell, config, POSES, config.simulation.seed, catalogue, say)
    t.show(plan_facts(made.summary))
    seed = config.simulation.seed
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


def _given(option: str, value: str | bool | None) -> tuple[str, ...]:
    """Return an option as it stands in a command line, nothing where it was not given."""
    if value is None or isinstance(value, bool):
        return (option,) if value else ()
    return option, value


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


def _append(
    t: Terminal,
    stack: ExitStack,
    output: Path,
    plan: Path | None,
    config: CellConfig,
    cell: Cell,
    base_dir: Path,
) -> tuple[CampaignFile, Plan]:
    """Open a campaign, and return it with a further plan that has been checked."""
    if plan is None:
        raise InputError("--append needs the further plan: give it with --plan PLAN")
    campaign = stack.enter_context(CampaignFile.open(output, check_revisions=False))
    check_same_cell(campaign, config, base_dir)
    further = RunLog(campaign).with_new_names(load_plan(plan))
    refuse(dry_checked(t, cell, config, further), str(plan))
    return campaign, further


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

    Raises:
        DeviceError: a device failed; the arm stands, and what was measured is stored.
        InputError: the plan does not pass.
        KeyboardInterrupt: somebody stopped it; the same holds.
    """
    log = RunLog(campaign)
    stored = log.readings()
    if goal is not None and stored is not None and goal(stored, last=True).met and _is_home(log):
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
        watcher: Watcher = stack.enter_context(watching(t.progress, len(log.plan.steps)))
        if viewer is not None:
            viewer.measuring(campaign.path.name, cell, log)
            watcher = Several((watcher, viewer))
        log.event("devices", {"answers": [answer_json(answer) for answer in answers]})
        clock = Clock(config.simulation.clock)
        live = LiveModel(cell, config)
        run_plan(rig, cell, config, log.plan, log, clock, watcher, live, goal=goal, epoch=epoch)
    estimate_noise(t, config, cell, campaign)
    return campaign.n_readings


def estimate_noise(t: Terminal, config: CellConfig, cell: Cell, campaign: CampaignFile) -> None:
    """Estimate, store and say the noise of measured readings that nothing states."""
    from hilcal.identification.noise_estimate import NOISE, measured_noise
    from hilcal.numbers import sentence
    from hilcal.present.registration import covariance_words

    log = RunLog(campaign)
    found = measured_noise(campaign.readings(), cell, config)
    if found is not None:
        log.event(NOISE, asdict(found))
        t.notice(sentence(covariance_words("instrument", found)))
    elif log.last(NOISE) is not None:  # of fewer readings, which these do not bear out
        log.event(NOISE, {"factors": None})


def _is_home(log: RunLog) -> bool:
    """Whether the last session came to its end: the arm is home and nothing hangs."""
    kinds = [e["kind"] for e in log.events() if e["kind"] != "noise"]
    return kinds[-1:] == ["finished"]


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
