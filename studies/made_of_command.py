"""`python -m studies made-of`: sizes of all effects of a real arm, by sixty of its poses.

Random positions of a public series, the first draw of `few-poses`, are refined as by `few-poses`.
The sizes of all families of effects are recorded for the chart of the page on naming and
predicting.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cli.options import Json
from hilcal.cli.terminal import terminal
from hilcal.errors import CannotAnswerError
from hilcal.identification.background import family_sizes
from hilcal.identification.baseline import baseline
from hilcal.refinement import refine
from studies.few_poses_command import series_of
from studies.records import Figure, Keep, keep

DRAW = 3
"""Seed of the first draw of `few-poses`."""


def made_of(
    series: Annotated[Path, typer.Argument(metavar="F.csv", help="As of `few-poses`.")],
    poses: Annotated[int, typer.Option("--poses", help="Random positions fitted.")] = 60,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Estimate the sizes of all families of effects of a real arm."""
    t = terminal(as_json)
    cell, readings = series_of(series)
    value, covariance = readings.value[:, :3], readings.covariance[:, :3, :3]
    readings = replace(readings, value=value, covariance=covariance)
    chosen = readings[np.random.default_rng(DRAW).permutation(len(readings))[:poses]]
    fitted = refine(baseline(cell, chosen, "absolute"), chosen, "absolute").fit
    sizes = [s.to_json() for s in family_sizes(fitted)]
    if not sizes:
        raise CannotAnswerError(f"{series}: {poses} positions give no background")
    ratio = {str(s["name"]): float(s["std"]) / float(s["ordinary"]) for s in sizes}  # type: ignore[arg-type]
    low, high = min(ratio, key=lambda n: ratio[n]), max(ratio, key=lambda n: ratio[n])
    figures = [
        Figure("families of effects whose size was estimated", str(len(sizes))),
        Figure("smallest, by that of an ordinary arm", f"{low}, {ratio[low]:.2f}"),
        Figure("largest", f"{high}, {ratio[high]:.2f}"),
    ]
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    title = f"What a real arm is made of, by {poses} positions"
    keep(keep_file, title, figures, {"sizes": sizes})
    t.document({"sizes": sizes})
