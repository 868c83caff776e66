"""`effects` and `study`: what the program knows, and studies of its own mathematics."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from hilcal.cell import cell_from_config
from hilcal.cli.terminal import Json, terminal
from hilcal.config import CellConfig, Robot
from hilcal.data.readings import States
from hilcal.effects.catalogue import catalogue
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError
from hilcal.report import text
from hilcal.report.progress import working

ROBOT = "ur10e"


def effects(as_json: Json = False) -> None:
    """List the effects that a model can have."""
    t = terminal(as_json)
    made = [_example(kind) for kind in catalogue().values()]
    out = text.table("effect", "parameters", "unit", "needs", "law", left=(0, 2, 3, 4))
    for e in made:
        units = list(dict.fromkeys(p.unit for p in e.parameters))
        out.add_row(e.name, str(len(e.parameters)), ", ".join(units), ", ".join(e.needs), e.summary)
    t.show(out)
    t.show(
        Text(
            f"parameters: of a {ROBOT} with 30 poses; needs: columns that the readings must have.",
            style="dim",
        )
    )
    t.document({"effects": [_document(e) for e in made]})


def _document(e: Effect) -> dict[str, object]:
    shown = [{"name": p.name, "unit": p.unit, "meaning": p.meaning} for p in e.parameters]
    return {
        "name": e.name,
        "law": e.summary,
        "elastic": e.elastic,
        "needs": list(e.needs),
        "options": list(e.option_names),
        "parameters": shown,
    }


def _example(kind: type[Effect]) -> Effect:
    """Build an effect for an example arm and states that hold every column."""
    cell = cell_from_config(CellConfig(robot=Robot(model=ROBOT)))
    n, count = cell.arm.n, 30
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (count, n))
    line = np.arange(float(count))
    states = States(
        q=q,
        wrench=np.zeros((count, 6)),
        time=line,
        load_time=line,
        air_temperature=line,
        joint_temperature=np.zeros((count, n)),
        approach=np.ones((count, n)),
    )
    return kind(cell, states)


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
