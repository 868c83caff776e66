"""`python -m studies scaling`: the figures of `hilcal study scaling`, kept for the results."""

from typing import Annotated

import numpy as np
import typer

from hilcal.cli.options import OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.present.progress import counting
from hilcal.readings.whitening import SCALINGS
from hilcal.study import check, n_experiments, scaling_study, table
from studies.records import Figure, Keep, keep


def scaling(
    runs: Annotated[int, typer.Option("--runs", help="Monte-Carlo runs.")] = 2000,
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
) -> None:
    """Show what the scalings none, gu and gc do to the same data."""
    t = terminal(False)
    check(runs)
    steps = f"experiments of {runs} campaigns, each with every scaling"
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, steps, n_experiments()) as advance,
    ):
        rng = np.random.default_rng(1)
        study = scaling_study(rng, runs, engine=engine, advance=advance)
    t.show(table(study))
    figures = []
    for name in SCALINGS:
        cells = [c for c in study.cells if c.scaling == name]
        ratios = [c.error_over_bound for c in cells]
        coverage = [100 * c.coverage for c in cells]
        figures += [
            Figure(
                f"{name}: error over the Cramér-Rao bound",
                f"{min(ratios):.2f} to {max(ratios):.2f}",
            ),
            Figure(
                f"{name}: coverage of 95 % intervals",
                f"{min(coverage):.1f} to {max(coverage):.1f} %",
            ),
        ]
    keep(keep_file, "What scaling does", figures)
