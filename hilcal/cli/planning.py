"""`plan`: choose poses and loads; `check`: who answers, and may this plan be run."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.acquire.connect import Answer, connect
from hilcal.acquire.dry_run import DryRun, dry_run
from hilcal.cell import Cell, cell_from_config
from hilcal.cli.terminal import Json, terminal
from hilcal.config import CellConfig, load_config
from hilcal.data.plan import Plan, load_plan
from hilcal.errors import DeviceError, InputError
from hilcal.plan.spread import spread_plan
from hilcal.report import text_run
from hilcal.report.progress import working

POSES = 20

CellFile = Annotated[Path, typer.Argument(metavar="CELL.toml", help="The cell.")]
PlanFile = Annotated[
    Path | None, typer.Option("--plan", metavar="PLAN", help="The plan, see hilcal plan.")
]


def plan(
    cell: CellFile,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="PLAN", help="The plan file to make.")
    ],
    poses: Annotated[int, typer.Option("--poses", help="Poses beside the reference.")] = POSES,
    seed: Annotated[int, typer.Option("--seed", help="Of the random candidates.")] = 0,
    as_json: Json = False,
) -> None:
    """Choose poses for every load of the cell, and check that they can be run."""
    t = terminal(as_json)
    config, numbers = read_cell(cell)
    with working(t.progress) as say:
        say("choosing poses")
        made = make_plan(numbers, config, poses, seed)
        say("going through it in thought")
        dry = dry_run(numbers, config, made)
    refuse(dry, "the plan")
    try:
        output.write_text(made.to_json() + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{output}: cannot be written ({error.strerror})") from None
    t.show(text_run.plan_report(made, dry, output))
    t.document({**plan_json(made, dry), "plan": str(output)})


def check(cell: CellFile, plan: PlanFile = None, as_json: Json = False) -> None:
    """Connect to every device and say who answers; nothing moves."""
    t = terminal(as_json)
    config, numbers = read_cell(cell)
    dry = None
    if plan is not None:
        dry = dry_run(numbers, config, load_plan(plan))
    with working(t.progress) as say:
        say("asking every device")
        rig, answers = connect(config)
        if rig is not None:
            rig.close()
    t.show(text_run.check_report(answers, dry))
    t.document(
        {
            "ok": not any(a.problems for a in answers) and not (dry and dry.problems),
            "devices": [answer_json(a) for a in answers],
            "plan": None if dry is None else asdict(dry),
        }
    )
    if failed := [a for a in answers if a.problems]:
        names = ", ".join(a.device for a in failed)
        raise DeviceError(f"not ready: {names}; see above")
    if dry is not None:
        refuse(dry, str(plan))


def read_cell(path: Path) -> tuple[CellConfig, Cell]:
    """Return the configuration in a file, and the cell as numbers."""
    config = load_config(path)
    return config, cell_from_config(config, path.absolute().parent)


def make_plan(cell: Cell, config: CellConfig, poses: int, seed: int) -> Plan:
    """Return a plan of so many poses under every load of the cell."""
    if poses < 1:
        raise InputError(f"--poses {poses}; valid: a whole number from 1")
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    repeats = min(poses, max(2, poses // 10))
    return spread_plan(cell, config, poses, np.random.default_rng(seed), repeats=repeats)


def refuse(dry: DryRun, what: str) -> None:
    """Refuse a plan that did not pass.

    Raises:
        InputError: says the first problem, and how many more there are.
    """
    if dry.problems:
        more = len(dry.problems) - 1
        others = f" (and {more} more: hilcal check --plan shows all)" if more else ""
        raise InputError(f"{what} cannot be run: {dry.problems[0]}{others}")


def plan_json(made: Plan, dry: DryRun) -> dict[str, object]:
    """Return what the JSON document says of a plan."""
    return {
        "poses": len(made.pose_names),
        "readings": len(made.steps),
        "criterion": "spread",
        "efficiency": None,
        "predicted_std": {},
        "loads": list(made.loads),
        "load_changes": dry.load_changes,
        "motions": dry.motions,
        "duration_s": dry.duration,
        "remarks": list(dry.remarks),
    }


def answer_json(answer: Answer) -> dict[str, object]:
    """Return what became of a device as a JSON document says it."""
    report = answer.report
    return {
        "device": answer.device,
        "driver": answer.driver,
        "answers": report is not None,
        "name": "" if report is None else report.name,
        "facts": {} if report is None else dict(report.facts),
        "problems": list(answer.problems),
    }


def refuse_unready(answers: tuple[Answer, ...]) -> None:
    """Refuse to run with devices that are not ready.

    Raises:
        DeviceError: says everything that hinders.
    """
    if lines := [problem for answer in answers for problem in answer.problems]:
        raise DeviceError("; ".join(lines))
