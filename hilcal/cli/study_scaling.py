"""`study scaling`: what the scalings none, gu and gc do to the same data."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.terminal import Json, terminal
from hilcal.errors import InputError
from hilcal.report.progress import working


def scaling(
    runs: Annotated[int, typer.Option("--runs", help="Monte-Carlo runs.")] = 2000,
    seed: Annotated[int, typer.Option("--seed", help="Of the random numbers.")] = 1,
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE.svg", help="Draw it, too.")
    ] = None,
    as_json: Json = False,
) -> None:
    """Show what the scalings none, gu and gc do to the same data."""
    from hilcal.study import picture as pictures
    from hilcal.study.scaling import scaling_study
    from hilcal.study.scaling_table import table

    t = terminal(as_json)
    if seed < 0:
        raise InputError(f"--seed {seed}; valid: a whole number, 0 or more")
    if picture is not None and picture.suffix.lower() != ".svg":
        raise InputError(f"--picture {picture}: it is an SVG file; end its name in .svg")
    with working(t.progress) as say:
        say(f"simulating {runs} campaigns, each with every scaling")
        study = scaling_study(np.random.default_rng(seed), runs)
    if picture is not None:
        pictures.picture(study, picture)
        t.notice(f"drew {picture}")
    t.show(table(study))
    t.document(study.to_json())
