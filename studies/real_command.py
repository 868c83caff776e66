"""`python -m studies real`: the public series of a real UR10, from the import to the last model."""

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.identification.baseline import baseline
from hilcal.library import read_table
from hilcal.numbers import length
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Ints
from studies.few_poses_command import share_in_band
from studies.records import Figure, Keep, keep

HALVES = ("a random half", "the first half")
SEED = 0  # of the random half


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
        halves: with `--halves`, mean error (m) at one half of the poses, predicted by a refinement
            of the other, and the share of its positions in their 95 % band: of a random half, and
            of the second half in the order of measuring.
    """

    series: str
    readings: int
    mean_m: tuple[float, float]
    model: tuple[str, ...]
    verdict: str
    seconds: float
    halves: tuple[tuple[float, float], ...] = ()


def real(
    series: Annotated[
        list[Path],
        typer.Argument(metavar="F.csv...", help="measurements_joint_configurations.csv."),
    ],
    halves: Annotated[
        bool, typer.Option("--halves", help="Also predict halves from a fit of the others.")
    ] = False,
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
        done = engine.map(partial(refined, halves=halves), series, advance=advance)
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
        for kind, (error, inside) in zip(HALVES, r.halves, strict=False):
            figures += [
                Figure(f"{r.series}, {kind}: mean error at the other half", length(error)),
                Figure(f"{r.series}, {kind}: in their 95 % band", f"{100 * inside:.1f}%"),
            ]
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "A real UR10 under a laser tracker", figures)
    names = ("series", "mean_m", "model", "verdict", "halves")
    t.document({"series": [{name: getattr(r, name) for name in names} for r in done]})


def refined(path: Path, halves: bool = False) -> RefinedSeries:
    """Read a series and refine its model, and with `halves` those of two halves."""
    start = time.monotonic()
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = read_table(path, cell, "ipa-ur10")
    r = refine(baseline(cell, readings, "absolute"), readings, "absolute")
    first, last = (f.holdout.mean_m for f in (r.steps[0].fit, r.fit))
    return RefinedSeries(
        path.parent.name, len(readings), (first, last), r.fit.model.names, r.verdict,
        time.monotonic() - start,
        tuple(_predicted(cell, readings, rows) for rows in _halves(len(readings)) if halves),
    )  # fmt: skip


def _halves(count: int) -> tuple[Ints, Ints]:
    """Rows of half of the readings: a random one, and the first in the order of measuring."""
    order = np.random.default_rng(SEED).permutation(count)
    return np.sort(order[: count // 2]), np.arange(count // 2)


def _predicted(cell: Cell, readings: Readings, rows: Ints) -> tuple[float, float]:
    """Refine some readings; return the mean error (m) of others, and their share in the band."""
    fitted, test = readings[rows], readings[np.setdiff1d(np.arange(len(readings)), rows)]
    last = refine(baseline(cell, fitted, "absolute"), fitted, "absolute").fit
    prediction = last.model.predict(test.states, last.theta)
    error = test.value[:, :3] - prediction.observation.position
    mean = float(np.mean(np.linalg.norm(error, axis=1)))
    return mean, share_in_band(last, test, error)
