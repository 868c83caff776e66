"""`python -m studies few-poses`: few poses of a real arm fitted with all effects at once."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from scipy.stats import chi2

from hilcal.cell import Cell
from hilcal.cli.terminal import Json, terminal
from hilcal.data.readings import Readings
from hilcal.identify.baseline import baseline
from hilcal.identify.mixed_fit import mixed_fit
from hilcal.library import read_table
from hilcal.mixed.evidence import evidence
from hilcal.report.progress import counting
from hilcal.robot.catalogue import configs_dir
from studies.records import Figure, Keep, keep

TEST = 500
NAMED = 0.01


@dataclass(frozen=True, slots=True)
class Drawn:
    """Some poses of a series.

    Attributes:
        mean_m: mean error of positions at other poses.
        inside: share of them within the stated 95 % region.
        named: families with evidence at `NAMED`.
    """

    mean_m: float
    inside: float
    named: tuple[str, ...]


def few_poses(
    series: Annotated[list[Path], typer.Argument(metavar="F.csv...", help="As of `real`.")],
    poses: Annotated[str, typer.Option("--poses", help="Numbers that are fitted.")] = "20,30,60",
    draws: Annotated[int, typer.Option("--draws", help="Random draws of each number.")] = 4,
    attitudes: Annotated[bool, typer.Option("--attitudes", help="Fit attitudes, too.")] = False,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Fit few random poses of IPA UR10 series, and predict 500 others."""
    t = terminal(as_json)
    counts = [int(n) for n in poses.split(",")]
    figures, cases = [], []
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    with counting(t.progress, "fits", len(series) * len(counts) * draws) as advance:
        for path in series:
            readings = read_table(path, cell, "ipa-ur10")
            if not attitudes:
                readings = _positions(readings)
            for n in counts:
                found = []
                for draw in range(draws):
                    found.append(_drawn(cell, readings, n, draw))
                    advance(1)
                figures.append(_figure(path.parent.name, n, found))
                cases += [
                    {"series": path.parent.name, "poses": n, "mean_m": f.mean_m,
                     "inside": f.inside, "named": f.named} for f in found
                ]  # fmt: skip
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    keep(keep_file, "Few poses of a real UR10, all effects at once", figures)
    t.document({"cases": cases})


def _positions(readings: Readings) -> Readings:
    value, covariance = readings.value[:, :3], readings.covariance[:, :3, :3]
    return replace(readings, value=value, covariance=covariance)


def _drawn(cell: Cell, readings: Readings, count: int, draw: int) -> Drawn:
    order = np.random.default_rng(3 + draw).permutation(len(readings))
    test, some = readings[order[len(order) // 2 :][:TEST]], readings[order[:count]]
    rng = np.random.default_rng(draw)
    fit = mixed_fit(baseline(cell, some, "absolute"), some, "absolute", rng)
    position, spread = fit.predict(test.states, 3)
    off = test.value[:, :3] - position
    total = spread + fit.noise(test)[:, :3, :3]
    square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(total), off)
    log_std = fit.variances.log_std
    found = {
        name: evidence(fit.problem, k, rng, log_std).p_value
        for k, name in enumerate(fit.problem.families.names)
    }
    return Drawn(
        float(np.linalg.norm(off, axis=1).mean()),
        float(np.mean(square < chi2.ppf(0.95, 3))),
        tuple(name for name, p in found.items() if p < NAMED),
    )


def _figure(series: str, poses: int, found: list[Drawn]) -> Figure:
    named = [name for f in found for name in f.named]
    often = sorted(set(named), key=lambda name: (-named.count(name), name))
    words = ", ".join(f"{name} {named.count(name)}" for name in often) or "nothing"
    mean = 1e3 * float(np.mean([f.mean_m for f in found]))
    inside = 100 * float(np.mean([f.inside for f in found]))
    return Figure(
        f"{series}, {poses} poses: mean error at 500 others, within the stated 95 %; named",
        f"{mean:.3f} mm, {inside:.0f} %; in {len(found)} draws: {words}",
    )
