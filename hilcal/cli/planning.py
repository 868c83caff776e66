"""`plan`: choose poses, loads and order; `check`: who answers, and may this plan be run."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Literal

from hilcal.campaign.campaign import Campaign
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.files import check_record, fit_of
from hilcal.cli.options import (
    POSES,
    CellFile,
    Csv,
    Details,
    Drift,
    EffectsFrom,
    Json,
    Output,
    PlanFile,
    Poses,
    Prior,
    PriorOf,
    Quick,
    Record,
    Revision,
    Seed,
    catalogue_with,
    option,
)
from hilcal.cli.plan_output import generator, write
from hilcal.cli.prior import PriorOptions
from hilcal.cli.terminal import Terminal, terminal
from hilcal.config import CellConfig, load_config
from hilcal.design.checked_plan import CheckedPlan, checked, refusal
from hilcal.design.choice import CRITERIA, canonical
from hilcal.design.nominal_model import check_effects
from hilcal.design.planner import Planned, Request, make
from hilcal.design.summary import about, remarks, summarise
from hilcal.effects.catalogue import Catalogue
from hilcal.errors import DeviceError, HilcalError, InputError
from hilcal.identification.fit import Fit
from hilcal.identification.fit_document import plain
from hilcal.measuring.connect import ConnectionResult, connect
from hilcal.measuring.dry_run import DryRun, dry_run
from hilcal.present.plan import plan_report, plan_screen
from hilcal.present.progress import Say, working
from hilcal.present.running import check_report
from hilcal.store.plan import Plan, load_plan


def plan(
    cell: CellFile,
    output: Output,
    poses: Poses = POSES,
    readings: Annotated[
        int | None,
        option(
            "--readings",
            "Or so many readings, repeats not counted, at as many poses and under those loads "
            "that tell most.",
        ),
    ] = None,
    criterion: Annotated[
        str | None, option(f"--criterion {'|'.join(CRITERIA)}", "The optimality criterion.")
    ] = None,
    after: Annotated[
        Path | None, option("--after RUN.hilcal", "Plan on from what it knows already.")
    ] = None,
    revision: Revision = None,
    prior: Prior = None,
    prior_of: PriorOf = "arm",
    drift: Drift = None,
    seed: Seed = 0,
    unloaded_first: Annotated[
        bool,
        option(
            "--unloaded-first",
            "All unloaded readings before the loads: for run --until; a drift costs more.",
        ),
    ] = False,
    quick: Quick = False,
    csv: Csv = None,
    record: Record = None,
    details: Details = False,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Choose poses, loads and their order, with a proof of how near to the best they are."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    check_record(record)
    if revision is not None and after is None:
        raise InputError("--revision is one of a campaign; give the campaign with --after")
    if prior is not None and after is not None:
        raise InputError("--after has the prior of its revision; leave out --prior")
    carried = PriorOptions(prior, prior_of, drift).load(catalogue)
    config, numbers = read_cell(cell)
    unloaded: Literal["around", "first"] = "first" if unloaded_first else "around"
    wanted = Request(poses, readings, _criterion(criterion), unloaded=unloaded)
    with working(t.progress) as say:
        known = None if after is None else _known(t, after, revision, catalogue, say)
        rng = generator(seed)
        chosen = make(numbers, config, wanted, rng, known, say, catalogue, carried)
        plan_ = replace(chosen.ordered.plan, about=about(chosen))
        summary = summarise(chosen, config, rng, say, compare=not quick, curve=not quick)
        say("checking every motion in a dry run")
        made = checked(numbers, config, plan_, summary)
    write(t, numbers, config, made, output, csv, record)
    t.show(plan_report(made.summary) if details else plan_screen(made.summary))
    t.show(f"The plan is in {output}: a file that you may edit. Every limit was checked.")
    t.document({**made.to_dict(), "plan": str(output)})


def _criterion(name: str | None) -> str | None:
    """Check a criterion.

    Raises:
        InputError: lists the valid ones.
    """
    if name is not None and canonical(name) not in CRITERIA:
        raise InputError(f"--criterion {name!r} is unknown; valid: {', '.join(CRITERIA)}")
    return name


def _known(t: Terminal, path: Path, revision: int | None, catalogue: Catalogue, say: Say) -> Fit:
    """Return the fit of a campaign that is in use."""
    with Campaign.open(path, catalogue, read_only=True) as run:
        return fit_of(t, run, say, revision)[1]


def check(
    cell: CellFile,
    plan: PlanFile = None,
    effects_from: EffectsFrom = None,
    as_json: Json = False,
) -> None:
    """Connect to every device and report its state; nothing moves."""
    t, catalogue = terminal(as_json), catalogue_with(effects_from)
    config, numbers = read_cell(cell)
    try:
        check_effects(numbers, config, catalogue)
    except InputError as error:
        raise InputError(f"{cell.name}: {error}") from None
    dry = None
    if plan is not None:
        dry = dry_checked(t, numbers, config, load_plan(plan))
    with working(t.progress) as say:
        say("connecting to every device")
        rig, answers = connect(config)
        if rig is not None:
            rig.close()
    t.show(check_report(answers, dry))
    failed: HilcalError | None = None
    if names := ", ".join(a.device for a in answers if a.problems):
        failed = DeviceError(f"not ready: {names}; see above")
    elif dry is not None:
        failed = refusal(dry, str(plan))
    t.document(
        {
            "ok": not any(a.problems for a in answers) and not (dry and dry.problems),
            "devices": [answer_json(a) for a in answers],
            "plan": None if dry is None else asdict(dry),
        },
        failed,
    )


def dry_checked(t: Terminal, cell: Cell, config: CellConfig, plan: Plan) -> DryRun:
    """Return the dry run of a plan, which takes seconds where it is long."""
    with working(t.progress) as say:
        say("checking every motion in a dry run")
        return dry_run(cell, config, plan)


def read_cell(path: Path) -> tuple[CellConfig, Cell]:
    """Return the configuration in a file, and the cell as numbers."""
    config = load_config(path)
    return config, cell_from_config(config, path.absolute().parent)


def make_plan(
    cell: Cell,
    config: CellConfig,
    poses: int,
    seed: int,
    catalogue: Catalogue,
    say: Say = lambda words: None,
) -> Plan:
    """Return a plan of so many poses, each read unloaded and under every load that it bears."""
    return _with_origin(make(cell, config, Request(poses), generator(seed), None, say, catalogue))


def make_checked(
    cell: Cell, config: CellConfig, poses: int, seed: int, catalogue: Catalogue, say: Say
) -> CheckedPlan:
    """Return the same plan with its dry run, its summary, and what other numbers of poses give."""
    rng = generator(seed)
    chosen = make(cell, config, Request(poses), rng, None, say, catalogue)
    summary = summarise(chosen, config, rng, say, compare=False)
    say("checking every motion in a dry run")
    return checked(cell, config, _with_origin(chosen), summary)


def _with_origin(chosen: Planned) -> Plan:
    """Return a plan that says where it is from."""
    return replace(chosen.ordered.plan, about={**about(chosen), "remarks": list(remarks(chosen))})


def answer_json(answer: ConnectionResult) -> dict[str, object]:
    """Return the state of a device as a JSON document."""
    report = answer.report
    return {
        "device": answer.device,
        "driver": answer.driver,
        "answers": report is not None,
        "name": "" if report is None else report.name,
        "facts": {} if report is None else dict(report.facts),
        "fields": {} if report is None else plain(dict(report.fields)),
        "problems": list(answer.problems),
    }


def refuse_unready(answers: tuple[ConnectionResult, ...]) -> None:
    """Refuse to run with devices that are not ready.

    Raises:
        DeviceError: lists all problems.
    """
    if lines := [problem for answer in answers for problem in answer.problems]:
        raise DeviceError("; ".join(lines))
