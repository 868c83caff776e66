"""`python -m studies few-poses`: a few poses of a real arm, refined, and the others predicted.

Random poses of a public series are refined as by `hilcal refine`, from the arm's type only; the
last fit predicts 500 others, with bands. `SKETCH_MM` is the error of the sketch of a mixed model
for the same draws, mean of ten; its effects are geometry, gear waves and compliance. With
`--planned` the poses are chosen by criterion I among all poses that are not predicted.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import typer
from scipy.stats import chi2

from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.design.choice import EFFORT, objective_of
from hilcal.design.information import problem
from hilcal.design.nominal_model import nominal_model
from hilcal.design.optimum import best_design
from hilcal.design.planner import without_undetermined
from hilcal.design.predicted import prediction_poses
from hilcal.engine import open_engine
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit
from hilcal.identification.noise.arm_scatter import with_arm_scatter
from hilcal.identification.prediction.predictive import predictive
from hilcal.library import read_table
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Floats, Ints
from hilcal.whole_file import replace_file
from studies.records import Figure, Keep, keep

TEST = 500
BAND = (0.90, 0.98)
"""Accepted share of predicted poses within their 95 % band."""
PROBABLE = 0.05
"""p-value below which an effect of the background counts as ambiguous."""
SKETCH_MM = {
    "Series_B": {20: 0.385, 30: 0.269, 60: 0.181, 120: 0.132},
    "Series_C": {20: 0.358, 30: 0.257, 60: 0.158, 120: 0.120},
    "jacobi_ur5": {20: 0.114, 30: 0.095, 60: 0.072, 120: 0.061},
}
"""Mean error of the sketch, mm, by series and number of poses, fed with these very draws."""
UR5 = """
[robot]
model = "ur5"
[tool]
mass_kg = 0.5
com_m = [0.0, 0.0, 0.03]
[tracker]
frame = "tracker"
"""
"""The cell of the UR5; of its tool and tracker only the tracker's type is published."""


@dataclass(frozen=True, slots=True)
class FewPosesCase:
    """Fitted poses of a series.

    Attributes:
        path: of the series.
        poses: number of fitted poses.
        draw: number of the draw.
        attitudes: whether attitudes are fitted, too.
        planned: whether the planner chooses the poses.
    """

    path: Path
    poses: int
    draw: int
    attitudes: bool
    planned: bool


@dataclass(frozen=True, slots=True)
class FewPosesResult:
    """Result of a case.

    Attributes:
        series: name of its folder.
        poses: number of fitted poses.
        draw: number of the draw.
        mean_m: mean error of predicted positions.
        inside: share of these within their 95 % band.
        named: named effects of the last model.
        verdict: of the last model.
        suspects: suspected effects of the last model.
    """

    series: str
    poses: int
    draw: int
    mean_m: float
    inside: float
    named: tuple[str, ...]
    verdict: str
    suspects: tuple[str, ...]


def few_poses(
    series: Annotated[
        list[Path],
        typer.Argument(metavar="F.csv...", help="As of `real`, or a series of jacobi_ur5."),
    ],
    poses: Annotated[str, typer.Option("--poses", help="Numbers that are fitted.")] = "20,30,60",
    draws: Annotated[int, typer.Option("--draws", help="Random draws of each number.")] = 10,
    attitudes: Annotated[bool, typer.Option("--attitudes", help="Fit attitudes, too.")] = False,
    planned: Annotated[bool, typer.Option("--planned", help="Choose them as a plan does.")] = False,
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Refine few random poses of real series, and predict 500 others."""
    t = terminal(as_json)
    counts = [int(n) for n in poses.split(",")]
    cases = [
        FewPosesCase(p, n, d, attitudes, planned)
        for p, n, d in product(series, counts, range(draws))
    ]
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "fits", len(cases)) as advance,
    ):
        done: Sequence[FewPosesResult] = engine.map(refined, cases, advance=advance)
    figures = []
    for path, n in product(series, counts):
        results = [f for f in done if (f.series, f.poses) == (path.parent.name, n)]
        figures += _figures(path.parent.name, n, results, attitudes=attitudes, planned=planned)
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    title = "Few poses of real arms, chosen by the planner" if planned else "Few poses of real arms"
    keep(keep_file, title, figures)
    t.document({"cases": [asdict(f) for f in done]})


def refined(case: FewPosesCase) -> FewPosesResult:
    """Refine the poses of a case, and predict others."""
    cell, readings = series_of(case.path)
    if not case.attitudes:
        value, covariance = readings.value[:, :3], readings.covariance[:, :3, :3]
        readings = replace(readings, value=value, covariance=covariance)
    order = np.random.default_rng(3 + case.draw).permutation(len(readings))
    tested = order[len(order) // 2 :][:TEST]
    available = np.setdiff1d(order, tested)
    chosen = _planned(cell, readings[available], case) if case.planned else order[: case.poses]
    test, some = readings[tested], readings[available[chosen] if case.planned else chosen]
    last = refine(baseline(cell, some, "absolute"), some, "absolute")
    f, d = last.fit, last.diagnosis
    error = test.value[:, :3] - f.model.predict(test.states, f.theta).observation.position
    return FewPosesResult(
        case.path.parent.name,
        case.poses,
        case.draw,
        float(np.linalg.norm(error, axis=1).mean()),
        share_in_band(f, test, error),
        tuple(n for n in f.model.named if n not in ("base_frame", "target_offset")),
        last.verdict,
        (*d.significant, *(b.effect for b in d.background if b.p_value < PROBABLE)),
    )


def share_in_band(fitted: Fit, test: Readings, error: Floats) -> float:
    """Return the share of test readings with errors (N, 3), m, within the 95 % band of a fit."""
    band = predictive(
        fitted.model, fitted.theta, fitted.solution.prior, fitted.readings[~fitted.outlier],
        "absolute", fitted.holdout.rms_sigma,
    )  # fmt: skip
    prediction = fitted.model.predict(test.states, fitted.theta)
    if fitted.readings.arm_scatter is not None:
        test = with_arm_scatter(fitted.model.cell, test, fitted.readings.arm_scatter)
    total = band.reading_covariance(prediction, whitening(test, "absolute", "gc"))[:, :3, :3]
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(total), error)
    return float(np.mean(square < chi2.ppf(0.95, 3)))


def _planned(cell: Cell, readings: Readings, case: FewPosesCase) -> Ints:
    """Return the readings that a plan for predictions at all of them chooses."""
    config = cell.configured()
    config = config.with_keys("planning", readings="absolute").model_copy(update={"loads": []})
    q, m = readings.states.q, readings.value.shape[1]
    design_problem, _ = without_undetermined(
        problem(nominal_model(cell.with_config(config), m), config, q)
    )
    work = prediction_poses(design_problem.nominal, config, q)
    objective = objective_of(design_problem, config, "I", work)
    design = best_design(
        objective, float(case.poses), np.random.default_rng(case.draw), effort=EFFORT
    )
    return np.flatnonzero(design.counts)


def series_of(path: Path) -> tuple[Cell, Readings]:
    """The cell and all readings of a series."""
    with path.open(encoding="utf-8") as stream:
        header = stream.readline()
    if "x_dif" not in header:
        cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
        return cell, read_table(path, cell, "ipa-ur10")
    table = pd.read_csv(path)
    plain = pd.DataFrame({"pose": [f"P{k + 1}" for k in range(len(table))], "load": "none"})
    for j in range(1, 7):
        plain[f"q{j}_rad"] = np.radians(table[f"joint_{j}"])
    for axis in "xyz":
        plain[f"{axis}_m"] = 1e-3 * (table[f"{axis}_t"] + table[f"{axis}_dif"])
    with tempfile.TemporaryDirectory() as folder:
        cell_file, table_file = Path(folder, "cell.toml"), Path(folder, "table.csv")
        replace_file(cell_file, UR5)
        rows = [plain.columns.tolist(), *plain.astype(str).to_numpy().tolist()]
        replace_file(table_file, "".join(f"{','.join(row)}\n" for row in rows))
        cell = Cell.load(cell_file)
        return cell, read_table(table_file, cell)


def _figures(
    series: str, poses: int, results: list[FewPosesResult], *, attitudes: bool, planned: bool
) -> list[Figure]:
    title = f"{series}, {poses} {'planned ' * planned}{'poses' if attitudes else 'positions'}"
    mean = 1e3 * float(np.mean([f.mean_m for f in results]))
    worst = 1e3 * max(f.mean_m for f in results)
    inside = float(np.mean([f.inside for f in results]))
    least = min(f.inside for f in results)
    most = SKETCH_MM.get(series, {}).get(poses)
    verdicts = [f.verdict for f in results]
    counted = ", ".join(f"{verdicts.count(v)} {v}" for v in dict.fromkeys(verdicts))
    named = [name for f in results for name in {*f.named, *f.suspects}]
    by_count = sorted(set(named), key=lambda name: (-named.count(name), name))
    effects = ", ".join(f"{name} {named.count(name)}" for name in by_count) or "nothing"
    return [
        Figure(
            f"{title}: mean error at {TEST} others, mean of {len(results)} draws (worst)",
            f"{mean:.3f} mm ({worst:.3f} mm)",
            "" if most is None else f"{most:.3f} mm, the sketch's",
            None if most is None else mean <= most,
        ),
        Figure(
            f"{title}: of them within their 95 % band (least draw)",
            f"{inside:.0%} ({least:.0%})",
            f"{BAND[0]:.0%} to {BAND[1]:.0%}",
            BAND[0] <= inside <= BAND[1],
        ),
        Figure(f"{title}: verdicts", counted),
        Figure(f"{title}: named, or among the ambiguous", effects),
    ]
