"""Options of `plan` and `next`, and the files that they write."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cell import Cell
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.design.checked_plan import CheckedPlan
from hilcal.design.next import PairPower
from hilcal.errors import InputError
from hilcal.present.progress import working
from hilcal.tables.plan_csv import plan_csv
from hilcal.whole_file import replace_file

POSES = 20

Output = Annotated[
    Path, typer.Option("-o", "--output", metavar="PLAN", help="The plan file to make.")
]
Poses = Annotated[
    int,
    typer.Option(
        "--poses",
        help="So many poses, each read unloaded and under every load that it bears.",
    ),
]
Seed = Annotated[int, typer.Option("--seed", help="Of the random candidates.")]
Quick = Annotated[
    bool, typer.Option("--quick", help="Without comparing criteria and numbers of poses.")
]
Csv = Annotated[
    Path | None, typer.Option("--csv", metavar="F.csv", help="The plan as a table, too.")
]


def generator(seed: int) -> np.random.Generator:
    """Return the generator of a seed.

    Raises:
        InputError: a negative seed.
    """
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    return np.random.default_rng(seed)


def write(
    t: Terminal,
    cell: Cell,
    config: CellConfig,
    made: CheckedPlan,
    output: Path,
    csv: Path | None,
    record: Path | None,
    powers: tuple[PairPower, ...] = (),
) -> None:
    """Write a plan: as a file, and where asked as a table and as a recording."""
    made.save(output)
    if csv is not None:
        pulls = {load.name: load.wrench(cell.gravity) for load in config.loads}
        replace_file(csv, plan_csv(made.plan, pulls))
    if record is not None:
        from hilcal.present.viewer.plan_stream import record_plan

        with working(t.progress) as say:
            say(f"recording {record}")
            record_plan(cell, config, made.plan, made.summary, record, powers)
