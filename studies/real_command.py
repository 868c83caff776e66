"""`python -m studies real`: the public series of a real UR10, from the import to the last model."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.identification.baseline import baseline
from hilcal.library import read_table
from hilcal.numbers import length
from hilcal.present.progress import counting
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep


@dataclass(frozen=True, slots=True)
class RefinedSeries:
    """Result of the refinement of a series.

    Attributes:
        series: name of its folder.
        readings: number of readings.
        mean_m: mean error of poses left out, of the baseline and of the last model.
        model: effects of the last model.
        verdict: of the last model.
        seconds: duration.
    """

    series: str
    readings: int
    mean_m: tuple[float, float]
    model: tuple[str, ...]
    verdict: str
    seconds: float


def real(
    series: Annotated[
        list[Path],
        typer.Argument(metavar="F.csv...", help="measurements_joint_configurations.csv."),
    ],
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Refine series of the IPA UR10 accuracy data; the cell knows the arm's type only.

    One process refines one series after the other, each on all processors.
    """
    t = terminal(as_json)
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "series", len(series)) as advance,
    ):
        done = engine.map(refined, series, advance=advance)
    figures = []
    for r in done:
        first, last = map(length, r.mean_m)
        figures += [
            Figure(
                f"{r.series}, {r.readings} readings: mean error of poses left out",
                f"{first} → {last} ({r.seconds:.0f} s)",
            ),
            Figure(f"{r.series}: last model, verdict", f"{' + '.join(r.model)}: {r.verdict}"),
        ]
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "A real UR10 under a laser tracker", figures)
    names = ("series", "mean_m", "model", "verdict")
    t.document({"series": [{name: getattr(r, name) for name in names} for r in done]})


def refined(path: Path) -> RefinedSeries:
    """Read a series and refine its model."""
    start = time.monotonic()
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = read_table(path, cell, "ipa-ur10")
    r = refine(baseline(cell, readings, "absolute"), readings, "absolute")
    first, last = (f.holdout.mean_m for f in (r.steps[0].fit, r.fit))
    return RefinedSeries(
        path.parent.name, len(readings), (first, last), r.fit.model.names, r.verdict,
        time.monotonic() - start,
    )  # fmt: skip
