"""What `plan` and `next` have in common: their options, the check of a plan, its files."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.acquire.dry_run import DryRun, dry_run
from hilcal.cell import Cell
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.data.plan import Plan
from hilcal.data.plan_csv import plan_csv
from hilcal.errors import InputError
from hilcal.plan.summary import PlanSummary
from hilcal.report.progress import working

POSES = 20

Output = Annotated[
    Path, typer.Option("-o", "--output", metavar="PLAN", help="The plan file to make.")
]
Poses = Annotated[
    int, typer.Option("--poses", help="As many readings as so many poses take under every load.")
]
Seed = Annotated[int, typer.Option("--seed", help="Of the random candidates.")]
Quick = Annotated[
    bool, typer.Option("--quick", help="Without comparing criteria and numbers of poses.")
]
Csv = Annotated[
    Path | None, typer.Option("--csv", metavar="F.csv", help="The plan as a table, too.")
]


@dataclass(frozen=True, slots=True, eq=False)
class CheckedPlan:
    """A plan whose dry run passed, and its summary."""

    plan: Plan
    dry: DryRun
    summary: PlanSummary


def generator(seed: int) -> np.random.Generator:
    """Return the generator of a seed.

    Raises:
        InputError: a negative seed.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    return np.random.default_rng(seed)


def checked(cell: Cell, config: CellConfig, plan: Plan, summary: PlanSummary) -> CheckedPlan:
    """Check a plan in a dry run, whose remarks come first in the summary.

    Raises:
        InputError: a plan that may not be run.
    """
    dry = dry_run(cell, config, plan)
    refuse(dry, "the plan")
    remarks = tuple(dict.fromkeys((*dry.remarks, *summary.remarks)))
    return CheckedPlan(plan, dry, replace(summary, remarks=remarks))


def refuse(dry: DryRun, what: str) -> None:
    """Refuse a plan that did not pass.

    Raises:
        InputError: says the first problem, and how many more there are.
    """
    if dry.problems:
        more = len(dry.problems) - 1
        others = f" (and {more} more: hilcal check --plan shows all)" if more else ""
        raise InputError(f"{what} cannot be run: {dry.problems[0]}{others}")


def write(
    t: Terminal,
    cell: Cell,
    config: CellConfig,
    made: CheckedPlan,
    output: Path,
    csv: Path | None,
    record: Path | None,
) -> None:
    """Write a plan: as a file, and where asked as a table and as a recording."""
    _write(output, made.plan.to_json() + "\n")
    if csv is not None:
        pulls = {load.name: load.wrench(cell.gravity) for load in config.loads}
        _write(csv, plan_csv(made.plan, pulls))
    if record is not None:
        from hilcal.report.viewer.plan_stream import record_plan  # loads the viewer, which lasts

        with working(t.progress) as say:
            say(f"recording {record}")
            record_plan(cell, config, made.plan, made.summary, record)


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None
