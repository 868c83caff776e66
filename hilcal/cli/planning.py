"""`plan`, `next`: choose poses, loads and their order; `check`: examine devices and a plan."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Literal

import numpy as np

from hilcal import numbers
from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell
from hilcal.cli import fitting
from hilcal.cli.options import POSES, check_output, check_seed, command
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.design.choice import CRITERIA, criterion_name
from hilcal.design.next import PairPower, SeparatingPlan
from hilcal.design.nominal_model import check_effects
from hilcal.design.planner import PlanRequest, plan_readings
from hilcal.design.summary import CheckedPlan, about, checked, refusal, summarise
from hilcal.diagnosis.diagnosis import MOST_IN_DOUBT
from hilcal.diagnosis.verdict import diagnose
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.identification.fit_document import with_nulls
from hilcal.measuring.connect import ConnectionResult, connect, reported_kinematics, with_kinematics
from hilcal.measuring.route import DryRun, dry_run
from hilcal.present.campaign import check_report
from hilcal.present.plan import (
    adding_lines,
    brief_plan,
    next_report,
    plan_report,
    plan_screen,
    poses_report,
)
from hilcal.present.progress import Say, working
from hilcal.procedure.next_plan import Doubt, doubt_to_settle, fit_without, next_plan
from hilcal.procedure.procedure import with_origin
from hilcal.procedure.state import reference_in
from hilcal.store.plan import FORMAT, Plan, load_plan
from hilcal.store.run_log import PLAN
from hilcal.tables.write import ORDER, plan_csv
from hilcal.whole_file import replace_file


def write(
    t: Terminal,
    cell: Cell,
    checked_plan: CheckedPlan,
    output: Path,
    csv: Path | None,
    record: Path | None,
    powers: tuple[PairPower, ...] = (),
) -> None:
    """Write a plan: as a file, and optionally as a table and as a recording."""
    config = cell.configured()
    checked_plan.save(output)
    if csv is not None:
        pulls = {load.name: load.wrench(cell.gravity) for load in config.loads}
        replace_file(csv, plan_csv(checked_plan.plan, pulls, cell.arm.units))
    if record is not None:
        from hilcal.present.viewer.plan import record_plan

        with working(t.progress) as say:
            say(f"recording {record}")
            record_plan(cell, checked_plan.plan, checked_plan.summary, record, powers)


def _check_outputs(output: Path, csv: Path | None, record: Path | None) -> None:
    check_output(output, "-o", "a plan", FORMAT)
    check_output(csv, "--csv", "the table of a plan", ORDER)
    fitting.check_record(record)


@command(f"""
    poses | --poses | Number of poses, default {POSES}; each is read unloaded and under every load
        that is possible there.
    readings | --readings | Number of readings, repeats not counted, instead of --poses: poses and
        loads are chosen by their information.
    criterion | --criterion {"|".join(CRITERIA)} | The optimality criterion.
    after | --after RUN.hilcal | Plan what is best to measure in addition to this campaign.
    unloaded_first | --unloaded-first | Plan all unloaded readings before those under load, for run
        --until; a drift then costs more information.
    """)
def plan(
    t: Terminal, catalogue: Catalogue, cell: Path, output: Path, poses: int | None = None,
    readings: int | None = None, criterion: str | None = None, after: Path | None = None,
    revision: int | None = None, prior: fitting.PriorOptions = fitting.NO_PRIOR, seed: int = 0,
    unloaded_first: bool = False, quick: bool = False, csv: Path | None = None,
    record: Path | None = None, details: bool = False,
) -> None:  # fmt: skip
    """Choose poses, loads and their order, with a proven lower bound of the efficiency."""
    _check_outputs(output, csv, record)
    if revision is not None and after is None:
        raise InputError("--revision belongs to a campaign; give the campaign with --after")
    if prior.prior is not None and after is not None:
        raise InputError("--after has the prior of its revision; leave out --prior")
    carried = prior.load(catalogue)
    robot_cell = Cell.load(cell)
    unloaded: Literal["around", "first"] = "first" if unloaded_first else "around"
    if criterion is not None and criterion_name(criterion) not in CRITERIA:
        raise InputError(f"--criterion {criterion!r} is unknown; valid: {', '.join(CRITERIA)}")
    if poses is not None and readings is not None:
        raise InputError("--poses and --readings are two sizes of a plan; give one of them")
    size = POSES if poses is None else poses
    request = PlanRequest(size, readings, criterion, unloaded=unloaded)
    with working(t.progress) as say:
        fitted, reference, appendable = None, None, False
        if after is not None:
            with Campaign.open(after, catalogue, read_only=True) as run:
                fitted, reference = fitting.fit_of(t, run, say, revision)[1], reference_in(run.file)
                appendable = run.file.about(PLAN) is not None
            config = robot_cell.configured()
            if "readings" not in config.planning.model_fields_set:
                config = config.with_keys("planning", readings=fitted.mode)
                robot_cell = robot_cell.with_config(config)
        rng = np.random.default_rng(check_seed(seed))
        chosen = plan_readings(
            robot_cell, request, rng, fitted, say, catalogue, carried, reference=reference
        )
        plan_ = replace(chosen.ordered.plan, about=about(chosen))
        compare = (details or t.json) and not quick  # no other output shows the comparison
        summary = summarise(
            chosen, robot_cell.configured(), rng, say, compare=compare, curve=not quick
        )
        say("checking every motion in a dry run")
        checked_plan = checked(robot_cell, plan_, summary)
    write(t, robot_cell, checked_plan, output, csv, record)
    t.show(plan_report(checked_plan.summary) if details else plan_screen(checked_plan.summary))
    t.show(f"The plan is in {output}; you may edit the file. Every limit was checked.")
    if after is not None:
        _show_adding(t, after, output, cell, appendable)
    t.document({**checked_plan.to_dict(), "plan": str(output)})


@command("""
    save_calibration | --save-calibration F.toml | Write the kinematics that the arm's controller
        reports, for [robot] calibration.
    factory | --factory F.hilcal | Compare the arm with its factory calibration: measure a few
        readings without a load into F.hilcal, or use those that it holds.
    yes | --yes -y | With --factory: move the arm without asking.
    """)
def check(
    t: Terminal, catalogue: Catalogue, cell: Path, plan: Path | None = None,
    save_calibration: Path | None = None, factory: Path | None = None, yes: bool = False,
) -> None:  # fmt: skip
    """Connect to every device and report its state; nothing moves without --factory."""
    if save_calibration is not None and save_calibration.suffix.lower() != ".toml":
        raise InputError(f"--save-calibration {save_calibration}; valid: a name that ends in .toml")
    if save_calibration is not None and save_calibration.exists():
        raise InputError(f"{save_calibration}: the file exists; choose another name")
    robot_cell = Cell.load(cell)
    try:
        check_effects(robot_cell, catalogue)
    except InputError as error:
        raise InputError(f"{cell.name}: {error}") from None
    dry = None
    if plan is not None:
        dry = dry_checked(t, robot_cell, load_plan(plan))
    try:
        answers = with_kinematics(answers_of(t, robot_cell.configured()), robot_cell)
    except InputError:  # the cell names no device: report the plan alone
        if dry is None or not dry.problems:
            raise
        answers = ()
    t.show(check_report(answers, dry))
    if save_calibration is not None:
        kinematics = reported_kinematics(answers)
        if kinematics is None:
            raise DeviceError("arm: it does not report its kinematics; nothing is written")
        replace_file(save_calibration, kinematics.to_toml(), must_be_new=True)
        t.show(f"The kinematics of the arm's controller are in {save_calibration}.")
    failed: HilcalError | None = None
    factory_result = None
    if factory is not None and (factory.exists() or not any(a.problems for a in answers)):
        from hilcal.cli.running import factory_check  # imports this module

        factory_result = factory_check(t, cell, catalogue, answers, factory, yes)
    if names := ", ".join(a.device for a in answers if a.problems):
        failed = DeviceError(f"not ready: {names}; see above")
    elif dry is not None:
        failed = refusal(dry, str(plan))
    t.document(
        None,
        failed,
        ok=not any(a.problems for a in answers) and not (dry and dry.problems),
        devices=[answer_json(a) for a in answers],
        plan=None if dry is None else asdict(dry),
        **{} if factory_result is None else {"factory": factory_result},
    )


def answers_of(t: Terminal, config: CellConfig) -> tuple[ConnectionResult, ...]:
    """Return the report of every device; nothing moves."""
    with working(t.progress) as say:
        say("connecting to every device")
        rig, answers = connect(config)
        if rig is not None:
            rig.close()
    return answers


def dry_checked(t: Terminal, cell: Cell, plan: Plan) -> DryRun:
    """Return the dry run of a plan; shows progress, since a long plan takes seconds."""
    with working(t.progress) as say:
        say("checking every motion in a dry run")
        return dry_run(cell, plan)


def make_plan(
    cell: Cell,
    poses: int,
    seed: int,
    catalogue: Catalogue,
    say: Say = lambda text: None,
) -> Plan:
    """Return a plan; each pose is read unloaded and under every load possible there."""
    rng = np.random.default_rng(check_seed(seed))
    return with_origin(plan_readings(cell, PlanRequest(poses), rng, None, say, catalogue))


def answer_json(answer: ConnectionResult) -> dict[str, object]:
    """Return the state of a device as a JSON document."""
    report = answer.report
    return {
        "device": answer.device,
        "driver": answer.driver,
        "answers": report is not None,
        "name": "" if report is None else report.name,
        "facts": {} if report is None else dict(report.facts),
        "fields": {} if report is None else with_nulls(dict(report.fields)),
        "problems": list(answer.problems),
    }


def refuse_unready(answers: tuple[ConnectionResult, ...]) -> None:
    """Refuse to run with devices that are not ready."""
    if lines := [problem for answer in answers for problem in answer.problems]:
        raise DeviceError("; ".join(lines))


@command("""
    poses | --poses | Size of the plan: as many readings as this number of poses takes under every
        load, default 20; number of new poses if the misfit depends on the pose alone.
    suspects | --suspects A,B | Separate these effects instead of the diagnosed suspects.
    cell | --cell CELL.toml | Configuration of the cell, if its loads have changed.
    """)
def next_(
    t: Terminal, catalogue: Catalogue, run: Path, output: Path, poses: int | None = None,
    suspects: str | None = None, cell: Path | None = None, seed: int = 0, quick: bool = False,
    csv: Path | None = None, revision: int | None = None,
    prior: fitting.PriorOptions = fitting.NO_PRIOR, record: Path | None = None,
    details: bool = False,
) -> None:  # fmt: skip
    """Plan the measurements that separate the leading suspects; exit 4 if none are in doubt."""
    _check_outputs(output, csv, record)
    carried = prior.load(catalogue)
    rng = np.random.default_rng(check_seed(seed))
    if poses is not None and poses < 1:
        raise InputError(f"--poses {poses}; valid: a whole number from 1")
    with Campaign.open(run, catalogue, read_only=True) as o, working(t.progress) as say:
        changed = None if cell is None else Cell.load(cell)
        named = _named(suspects, catalogue)
        number, newest = fitting.fit_of(t, o, say, revision)
        o.require_gc(number, newest.scaling, "next")
        if carried is not None:
            say("fitting with the prior")
            newest = fitting.fitted_with(carried, o, newest)
        if named is not None:
            doubt = Doubt(fit_without(newest, named, say), named, None)
        else:
            say("diagnosing" if number is None else f"diagnosing revision {number}")
            doubt = doubt_to_settle(o, diagnose(newest, o.history(number), say), say)
        compare = (details or t.json) and not quick
        planned = next_plan(o, doubt, poses, rng, say, cell=changed, compare=compare)
        robot_cell = o.cell if changed is None else changed
    chosen, checked_plan, effects = planned.separating, planned.checked, doubt.suspects
    write(t, robot_cell, checked_plan, output, csv, record, chosen.powers)
    t.show(f"In doubt: {numbers.names(effects, 'or')}.\n")
    report = next_report if doubt.pose_alone is None else poses_report
    t.show(report(chosen, checked_plan.summary.poses, checked_plan.summary.readings, details))
    t.show(plan_report(checked_plan.summary) if details else brief_plan(checked_plan.summary))
    _show_adding(t, run, output, cell, planned.appendable, f"The plan is in {output}. ")
    t.document(
        checked_plan.to_dict(), plan=str(output), suspects=list(effects), **separates(chosen)
    )


def _show_adding(
    t: Terminal, run: Path, plan: Path, cell: Path | None, appendable: bool, where: str = ""
) -> None:
    """Print the commands that add the readings of a further plan to a campaign."""
    how, *commands = adding_lines(run, plan, cell, appendable)
    t.show(where + how)
    for line in commands:
        t.command(line)


def separates(chosen: SeparatingPlan) -> dict[str, object]:
    """Return the pairs of effects for JSON; "separates" is with the planned readings."""
    return {
        "separates": [[t.effect, t.rival, t.power_planned] for t in chosen.powers],
        "separates_now": [[t.effect, t.rival, t.power_now] for t in chosen.powers],
        "inseparable": [[t.effect, t.rival] for t in chosen.powers if t.not_separable],
        "difference": chosen.shares,
        "notes": list(chosen.notes),
    }


def _named(text: str | None, catalogue: Catalogue) -> tuple[str, ...] | None:
    effects = fitting.effects_of_option(text, catalogue, "--suspects")
    if effects is None:
        return None
    for name in (name for name, options in effects.items() if options):
        raise InputError(f"--suspects: {name} takes no options here; valid: {name}")
    if not 2 <= len(effects) <= MOST_IN_DOUBT:
        raise InputError(f"--suspects has {len(effects)} names; valid: 2 to {MOST_IN_DOUBT}")
    return tuple(effects)
