"""Options of `plan` and `next`, and the files that they write."""

from pathlib import Path

import numpy as np

from hilcal.cell import Cell
from hilcal.cli.terminal import Terminal
from hilcal.config import CellConfig
from hilcal.design.checked_plan import CheckedPlan
from hilcal.design.next import PairPower
from hilcal.errors import InputError
from hilcal.present.progress import working
from hilcal.tables.write import plan_csv
from hilcal.whole_file import replace_file


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
