"""`study scaling`: what the scalings none, gu and gc do to the same data."""

from typing import Annotated

import numpy as np

from hilcal.cli.options import Json, OneWorker, Scheduler, one_by_default, option
from hilcal.cli.terminal import terminal
from hilcal.engine.engine import open_engine
from hilcal.errors import InputError
from hilcal.present.progress import counting


def scaling(
    runs: Annotated[int, option("--runs", "Monte-Carlo runs.")] = 2000,
    seed: Annotated[int, option("--seed", "Of the random numbers.")] = 1,
    workers: OneWorker = None,
    scheduler: Scheduler = None,
    as_json: Json = False,
) -> None:
    """Show what the scalings none, gu and gc do to the same data."""
    from hilcal.study.scaling import check, experiments, scaling_study
    from hilcal.study.scaling_table import table

    t = terminal(as_json)
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    check(runs)
    what = f"experiments of {runs} campaigns, each with every scaling"
    with (
        open_engine(*one_by_default(workers, scheduler)) as engine,
        counting(t.progress, what, experiments()) as advance,
    ):
        rng = np.random.default_rng(seed)
        study = scaling_study(rng, runs, engine=engine, advance=advance)
    t.show(table(study))
    t.document(study.to_json())
