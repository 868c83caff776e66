"""`python -m studies real`: the public series of a real UR10, from the import to the last model."""

import time
from pathlib import Path
from typing import Annotated

import typer

from hilcal.cell import Cell
from hilcal.cli.terminal import Json, terminal
from hilcal.identify.baseline import baseline
from hilcal.library import read_table
from hilcal.refine import refine
from hilcal.report.numbers import length
from hilcal.report.progress import working
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep


def real(
    series: Annotated[
        list[Path],
        typer.Argument(metavar="F.csv...", help="measurements_joint_configurations.csv."),
    ],
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Refine series of the IPA UR10 accuracy data; the cell knows the arm's type only."""
    t = terminal(as_json)
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    figures, document = [], []
    for path in series:
        begun = time.monotonic()
        with working(t.progress) as say:
            say(f"reading {path}")
            readings = read_table(path, cell, "ipa-ur10")
            found = refine(baseline(cell, readings, "absolute"), readings, "absolute", say)
        first, last = found.steps[0].fit, found.fit
        errors = [length(f.holdout.mean_m) for f in (first, last)]
        model = " + ".join(last.model.names)
        seconds = time.monotonic() - begun
        figures += [
            Figure(
                f"{path.parent.name}, {len(readings)} readings: mean error of poses left out",
                f"{errors[0]} → {errors[1]} ({seconds:.0f} s)",
            ),
            Figure(f"{path.parent.name}: last model, verdict", f"{model}: {found.verdict}"),
        ]
        document.append(
            {
                "series": path.parent.name,
                "mean_m": [f.holdout.mean_m for f in (first, last)],
                "model": list(last.model.names),
                "verdict": found.verdict,
            }
        )
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "A real UR10 under a laser tracker", figures)
    t.document({"series": document})
