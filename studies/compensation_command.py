"""`python -m studies compensation`: corrections by the model at poses that were never fitted.

A real series is split. One part is fitted, from the arm's type only, and the resulting calibration
corrects the other part. The correction is nominal − predicted, so the remaining error is
measured − predicted, in base axes of the fit. It is within its band if it is within the radius of
95 % of errors with the covariance Σ + V, Σ of the calibration and V of the instrument.
"""

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import BAND, ToolPoses, band
from hilcal.cell import Cell
from hilcal.cli.options import Json, OneJob, Scheduler, one_by_default
from hilcal.cli.terminal import terminal
from hilcal.engine import open_engine
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.library import read_table
from hilcal.numbers import length
from hilcal.present.progress import counting
from hilcal.readings.readings import Readings
from hilcal.refinement import refine
from hilcal.robot.catalogue import configs_dir
from hilcal.types import Bools, Floats
from studies.records import Figure, Keep, keep

WANTED_M = 75e-6
"""Largest accepted mean of the remaining error; the project's goal for this arm."""
WANTED_BAND = (0.90, 0.97)
"""Accepted share of poses within their 95 % band; the project's goal."""
FINAL, PLAIN = "as refine ends", "before the arm's scatter was estimated"
HALF = 0.5
ENVIRONMENT = ("time", "load_time", "air_temperature", "joint_temperature", "approach")


@dataclass(frozen=True, slots=True)
class SplitErrors:
    """Remaining errors of a calibration at poses that were not fitted.

    Attributes:
        split: name of the split.
        model: revision of the calibration, `FINAL` or `PLAIN`.
        scatter: whether the calibration has an estimated scatter of the arm.
        poses: number of poses.
        before_m: mean error of the nominal arm, with only the frames fitted.
        mean_m: mean remaining error.
        worst_m: largest remaining error.
        inside: share of poses within their band.
        beyond: share of poses that the calibration calls outside of the measured range.
        beyond_mean_m: mean remaining error at these poses.
        beyond_inside: share of these poses within their band.
        near_mean_m: mean remaining error at all other poses.
        near_inside: share of all other poses within their band.
        verdict: of the refinement.
    """

    split: str
    model: str
    scatter: bool
    poses: int
    before_m: float
    mean_m: float
    worst_m: float
    inside: float
    beyond: float
    beyond_mean_m: float | None
    beyond_inside: float | None
    near_mean_m: float | None
    near_inside: float | None
    verdict: str


def compensation(
    series: Annotated[list[Path], typer.Argument(metavar="F.csv...", help="Series of the UR10.")],
    splits: Annotated[int, typer.Option("--splits", help="Random parts of each series.")] = 3,
    share: Annotated[
        float,
        typer.Option(
            "--share", min=0.1, max=0.9, help="Of the poses that is fitted; half: the first, too."
        ),
    ] = HALF,
    folder: Annotated[
        Path | None,
        typer.Option("--calibrations", metavar="DIR", help="Keep them there; use what is there."),
    ] = None,
    jobs: OneJob = None,
    scheduler: Scheduler = None,
    keep_file: Keep = None,
    as_json: Json = False,
) -> None:
    """Fit one part of a real series, and correct the other part."""
    t = terminal(as_json)
    if folder is not None:
        folder.mkdir(parents=True, exist_ok=True)
    cases = [(path, k) for path in series for k in range(splits + (share == HALF))]
    run = partial(_split, splits=splits, share=share, folder=folder)
    with (
        open_engine(*one_by_default(jobs, scheduler)) as engine,
        counting(t.progress, "splits", len(cases)) as advance,
    ):
        done = engine.map(run, cases, advance=advance)
    figures: list[Figure] = []
    document: list[dict[str, object]] = []
    for path in series:
        results = [x for (p, _), split in zip(cases, done, strict=True) if p == path for x in split]
        figures += _figures(path.parent.name, results)
        document.append({"series": path.parent.name, "splits": [asdict(x) for x in results]})
    for f in figures:
        t.show(f"{f.what}: {f.measured}")
    part = "" if share == HALF else f", {100 * share:.0f} % fitted"
    keep(keep_file, f"A real UR10: corrections at poses that were not fitted{part}", figures)
    t.document({"series": document})


def _split(
    case: tuple[Path, int], splits: int, share: float, folder: Path | None
) -> list[SplitErrors]:
    """Fit the k-th part of a series, and correct the other poses."""
    path, k = case
    cell = Cell.load(configs_dir() / "cells" / "ipa_ur10.toml")
    readings = read_table(path, cell, "ipa-ur10")
    name, fitted = list(_parts(len(readings), splits, share))[k]
    stem = f"{path.parent.name}-{name}".replace(" ", "-")
    calibrations = _calibrations(cell, readings[fitted], folder, stem)
    before = _before(cell, readings[fitted], readings[~fitted])
    return [_left(name, which, c, readings[~fitted], before) for which, c in calibrations.items()]


def _parts(count: int, splits: int, share: float) -> Iterator[tuple[str, Bools]]:
    """Yield names and fitted rows (N,) of the splits."""
    fitted = int(share * count)
    for seed in range(1, splits + 1):
        rows = np.zeros(count, dtype=np.bool_)
        rows[np.random.default_rng(seed).permutation(count)[:fitted]] = True
        yield f"random {'half' if share == HALF else f'{100 * share:.0f} %'} {seed}", rows
    if share == HALF:
        yield "first half", np.arange(count) < fitted


def _calibrations(
    cell: Cell, readings: Readings, folder: Path | None, stem: str
) -> Mapping[str, Calibration]:
    """Calibrations of the last revision, and of the last revision without the arm's scatter."""
    ends = {FINAL: ".json", PLAIN: "-plain.json"}
    paths = {which: folder / f"{stem}{end}" for which, end in ends.items()} if folder else {}
    if paths and paths[FINAL].exists():
        return {which: Calibration.load(p) for which, p in paths.items() if p.exists()}
    path = refine(baseline(cell, readings, "absolute"), readings, "absolute")
    fits = {FINAL: path.fit}
    if path.fit.readings.arm_scatter is not None:
        fits[PLAIN] = [s.fit for s in path.steps if s.fit.readings.arm_scatter is None][-1]
    out = {which: Calibration.of(f, {"verdict": path.verdict}) for which, f in fits.items()}
    for which, path_ in paths.items():
        if which in out:
            out[which].save(path_)
    return out


def _before(cell: Cell, fitted: Readings, tested: Readings) -> Floats:
    """(N,) errors of the nominal arm at tested poses, with only the frames fitted."""
    frames = fit(baseline(cell, fitted, "absolute"), fitted, "absolute")
    predicted = frames.predict(tested.states).position
    return np.asarray(np.linalg.norm(tested.value[:, :3] - predicted, axis=1))


def _left(name: str, which: str, c: Calibration, tested: Readings, before: Floats) -> SplitErrors:
    recorded = {k: v for k in ENVIRONMENT if (v := getattr(tested.states, k)) is not None}
    p = c.predict(tested.states.q, tested.states.wrench, recorded=recorded)
    errors, inside = judged(c, p, tested)
    beyond = np.zeros(len(errors), dtype=np.bool_)
    for o in p.outside:
        beyond |= o.points
    far, near = (
        (float(errors[x].mean()), float(inside[x].mean())) if x.any() else (None, None)
        for x in (beyond, ~beyond)
    )
    return SplitErrors(
        split=name,
        model=which,
        scatter=c.scatter.source == "estimated",
        poses=len(errors),
        before_m=float(before.mean()),
        mean_m=float(errors.mean()),
        worst_m=float(errors.max()),
        inside=float(inside.mean()),
        beyond=float(beyond.mean()),
        beyond_mean_m=far[0],
        beyond_inside=far[1],
        near_mean_m=near[0],
        near_inside=near[1],
        verdict=str(c.source["verdict"]),
    )


def judged(c: Calibration, p: ToolPoses, tested: Readings) -> tuple[Floats, Bools]:
    """Return the remaining errors (N,), m, and whether they are within their band.

    Args:
        c: the calibration.
        p: its predictions in the states of the readings, with uncertainties.
        tested: N readings.

    Raises:
        InputError: the uncertainties were left out.
    """
    if p.covariance is None:
        raise InputError("the poses were predicted without their uncertainty")
    base = c.base_in_tracker()
    turn = base[:3, :3]
    measured = (tested.value[:, :3] - base[:3, 3]) @ turn
    errors = np.linalg.norm(measured - p.position, axis=1)
    instrument = turn.T @ tested.covariance[:, :3, :3] @ turn
    return np.asarray(errors), np.asarray(errors <= band(p.covariance + instrument))


def _figures(series: str, results: list[SplitErrors]) -> Iterator[Figure]:
    """Yield mean and worst over the random halves, and the first half alone."""
    low, high = WANTED_BAND
    kinds = dict.fromkeys(x.split.rstrip("0123456789 ") for x in results)
    for kind in kinds:
        for which in (FINAL, PLAIN):
            parts = [x for x in results if x.model == which and x.split.startswith(kind)]
            if not parts:
                continue
            final = which == FINAL
            title = f"{series}, {kind} fitted, {which}"
            if final:
                title += f" (scatter estimated in {sum(x.scatter for x in parts)} of {len(parts)})"
            errors, shares = [x.mean_m for x in parts], [x.inside for x in parts]
            before = float(np.mean([x.before_m for x in parts]))
            yield Figure(
                f"{title}: mean error before → left, worst split",
                f"{length(before)} → {length(float(np.mean(errors)))}, {length(max(errors))}; "
                f"largest of a pose {length(max(x.worst_m for x in parts))}",
                f"≤ {length(WANTED_M)}" if final else "",
                max(errors) <= WANTED_M if final else None,
            )
            yield Figure(
                f"{title}: poses within their {100 * BAND:.0f} % band, mean (least to most)",
                f"{100 * np.mean(shares):.1f} % ({100 * min(shares):.1f} to "
                f"{100 * max(shares):.1f} %)",
                f"{100 * low:.0f} to {100 * high:.0f} %" if final else "",
                all(low <= s <= high for s in shares) if final else None,
            )
            if final and any(x.beyond for x in parts):
                yield Figure(f"{title}: refused as outside of what was measured", _beyond(parts))
            if final:
                yield Figure(f"{title}: verdicts", ", ".join(x.verdict for x in parts))


def _beyond(parts: list[SplitErrors]) -> str:
    """Describe the remaining error at poses that the program refuses, and at all others."""
    share = 100 * np.mean([x.beyond for x in parts])
    clauses = [f"{share:.1f} % of poses"]
    for place, errors, inside in (
        ("left there", "beyond_mean_m", "beyond_inside"),
        ("at the others", "near_mean_m", "near_inside"),
    ):
        values = [getattr(x, errors) for x in parts if getattr(x, errors) is not None]
        shares = [getattr(x, inside) for x in parts if getattr(x, inside) is not None]
        if values:
            clauses.append(
                f"{place} {length(float(np.mean(values)))}, {100 * np.mean(shares):.1f} % in band"
            )
    return "; ".join(clauses)
