"""`python -m studies discover-real`: laws of two series of a real UR10, each tried on the other."""

from dataclasses import dataclass
from itertools import permutations
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.diagnosis.residual_regression import residual_regression
from hilcal.discovery.discovery import Discovery, discover
from hilcal.discovery.law import effect_class
from hilcal.engine import open_engine
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.library import read_table
from hilcal.numbers import length, percent
from hilcal.present.diagnosis import coefficient
from hilcal.present.progress import counting
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep


@dataclass(frozen=True, slots=True, eq=False)
class DiscoverySeries:
    """Result of a series.

    Attributes:
        name: of its folder.
        fit: the fit after refinement, with the stated noise, without an estimated scatter.
        regression: share of the misfit predicted by a regression on everything recorded.
        discovery: the search for a law.
    """

    name: str
    fit: Fit
    regression: float
    discovery: Discovery


def discover_real(
    series: Annotated[
        list[Path],
        typer.Argument(metavar="F.csv F.csv", help="measurements_joint_configurations.csv, …"),
    ],
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Search a law for what refinement leaves of the IPA UR10's series; try it on the other one."""
    t = terminal(as_json)
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "series", len(series)) as advance,
    ):
        done = engine.map(_searched, series, advance=advance)
    figures = [f for s in done for f in _of_series(s)]
    figures += [_carried(a, b) for a, b in permutations(done, 2) if a.discovery.laws]
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "What is left of a real UR10", figures)
    t.document({"figures": [{"what": f.what, "measured": f.measured} for f in figures]})


def _searched(path: Path) -> DiscoverySeries:
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = read_table(path, cell, "ipa-ur10")
    last = refine(baseline(cell, readings, "absolute"), readings, "absolute").fit
    stated = fit(last.model, last.readings.as_stated(), last.mode, start=last.theta)
    law = discover(stated)
    return DiscoverySeries(
        path.parent.name, stated, residual_regression(linearise(stated)).share, law
    )


def _of_series(s: DiscoverySeries) -> list[Figure]:
    before = s.fit.holdout.mean_m
    out = [
        Figure(
            f"{s.name}: left by {' + '.join(s.fit.model.names)}",
            f"{length(before)} mean of poses left out, variance factor "
            f"{s.fit.variance_factor:.2f} of the stated noise",
        ),
        Figure(
            f"{s.name}: share of the misfit that a regression of everything recorded predicts",
            percent(s.regression),
        ),
    ]
    d = s.discovery
    if not d.laws or d.after is None:
        return [*out, Figure(f"{s.name}: law", f"none ({d.reason})")]
    law = d.laws[0]
    values = ", ".join(f"{c.name} = {coefficient(c)}" for c in law.parameters)
    after = d.after.holdout.mean_m
    share = (
        f"{percent(law.holdout_share)} of the misfit on poses left out; without them searches find "
        f"laws that explain {percent(d.searched_share)}"
    )
    return [
        *out,
        Figure(f"{s.name}: law", f"{law.formula}, with {values}"),
        Figure(f"{s.name}: what it explains", f"{share}; {length(before)} → {length(after)}"),
    ]


def _carried(a: DiscoverySeries, b: DiscoverySeries) -> Figure:
    """Share of the other series' misfit that the law of one series explains, without a refit."""
    law = a.discovery.laws[0]
    linear, w = linearise(b.fit), b.fit.whitening
    states = b.fit.solution.prediction.situation.states
    effect = effect_class(a.discovery.source, law.name)(b.fit.model.cell, states)
    values = np.array([c.value for c in law.parameters])
    prediction, theta = b.fit.solution.prediction, b.fit.theta
    moved = b.fit.model.jacobian_of((effect,), prediction, theta, w.m) @ values
    predicted = w.whiten(w.raw(moved)).reshape(-1)
    free = linear.project_out(predicted)
    along = float(predicted @ linear.residual)
    gain = 2.0 * along - float(predicted @ free)
    cosine = along / max(float(np.sqrt((predicted @ free) * linear.rss)), 1e-300)
    return Figure(
        f"law of {a.name}, coefficients as found there, on {b.name}",
        f"explains {100 * gain / (linear.rss - b.fit.dof):.1f} % of the misfit; correlation with "
        f"the residual {cosine:.2f}",
    )
