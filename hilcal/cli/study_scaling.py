"""`study scaling`: what the scalings none, gu and gc do to the same data."""

from typing import Annotated

import numpy as np
import typer

from hilcal.cli.terminal import Json, terminal
from hilcal.errors import InputError
from hilcal.report.progress import working


def scaling(
    runs: Annotated[int, typer.Option("--runs", help="Monte-Carlo runs.")] = 2000,
    seed: Annotated[int, typer.Option("--seed", help="Of the random numbers.")] = 1,
    as_json: Json = False,
) -> None:
    """Show what the scalings none, gu and gc do to the same data."""
    from hilcal.study.scaling import scaling_study
    from hilcal.study.scaling_table import table

    t = terminal(as_json)
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    with working(t.progress) as say:
        say(f"simulating {runs} campaigns, each with every scaling")
        study = scaling_study(np.random.default_rng(seed), runs)
    t.show(table(study))
    t.document(study.to_json())
