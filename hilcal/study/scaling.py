"""What `none`, `gu` and `gc` do to the same data, by Monte-Carlo.

The whitening of `hilcal.readings.whitening` is applied to simulated readings of an arm under known
loads. The noise is drawn per reading; deflections are formed as in a campaign, loaded minus
unloaded; errors of the estimates are set against the Cramér–Rao bound, and the stated 95 %
intervals are counted.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass
from functools import partial

import numpy as np
from rich import box
from rich.table import Table
from rich.text import Text
from scipy import stats
from scipy.linalg import solve_triangular

from hilcal.engine.engine import ALONE, Advance, Engine
from hilcal.errors import InputError
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import SCALINGS, Scaling, Whitening, whitening
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import load_arm
from hilcal.study.scaling_design import StudyDesign, bound, make_design, make_readings
from hilcal.types import Floats

LEVEL = 0.95
CORRELATIONS = (0.0, 0.3, 0.6, 0.9, 0.99)
# Name, and what a length in m and an angle in rad are multiplied by.
UNITS: tuple[tuple[str, float, float], ...] = (
    ("m, rad", 1.0, 1.0),
    ("mm, rad", 1e3, 1.0),
    ("m, mrad", 1.0, 1e3),
)


@dataclass(frozen=True, slots=True)
class StudyCell:
    """One scaling of one experiment; `_mc` are standard uncertainties of the Monte-Carlo."""

    scaling: Scaling  # "none", "gu" or "gc"
    correlation: float  # share ρ of each element's variance that is common to the elements
    unit: str  # units that the deflections were written in
    shared_unloaded: bool  # whether the loads of a pose share one unloaded reading
    error_over_bound: float
    """root mean square over runs and parameters of the error of a parameter in units of its bound,
    sqrt(F⁻¹_jj); 1 where the bound is attained."""
    error_over_bound_mc: float  # of it
    coverage: float  # share of the stated 95 % intervals that hold the true parameter
    coverage_mc: float  # of it
    variance_factor: float | None
    """mean χ²/dof of the whitened residual; None for `none`, where it has no meaning."""
    parameter_error_over_bound: tuple[float, ...]  # (n,) the same per parameter
    parameter_coverage: tuple[float, ...]  # (n,) the same per parameter
    unit_shift: float
    """largest change of any estimate in any run against the first unit, in units of the bound."""


@dataclass(frozen=True, slots=True)
class ScalingStudy:
    """The study's cells and what they were made of."""

    arm: str  # name of the arm
    runs: int  # Monte-Carlo runs per cell
    poses: int  # number of poses
    loads: int  # wrenches per pose
    typical_correlation: float
    """the ρ whose mean square correlation is that of the arm and the tracker as specified."""
    cells: tuple[StudyCell, ...]
    """every scaling, correlation, unit and way of sharing the unloaded reading."""

    def of(self, scaling: Scaling, unit: str, shared_unloaded: bool) -> tuple[StudyCell, ...]:
        """Cells of one curve, by growing correlation."""
        key = (scaling, unit, shared_unloaded)
        found = [c for c in self.cells if (c.scaling, c.unit, c.shared_unloaded) == key]
        return tuple(sorted(found, key=lambda c: c.correlation))

    def to_json(self) -> dict[str, object]:
        """Return the study as plain values, with a summary per scaling."""
        summary = {}
        for scaling in SCALINGS:
            mine = [c for c in self.cells if c.scaling == scaling]
            summary[scaling] = {
                "error_over_bound_min": min(c.error_over_bound for c in mine),
                "error_over_bound_max": max(c.error_over_bound for c in mine),
                "coverage_min": min(c.coverage for c in mine),
                "coverage_max": max(c.coverage for c in mine),
                "unit_shift_max": max(c.unit_shift for c in mine),
            }
        return asdict(self) | {"level": LEVEL, "summary": summary}


def scaling_study(
    rng: np.random.Generator,
    runs: int = 2000,
    correlations: Sequence[float] = CORRELATIONS,
    *,
    arm: Arm | None = None,
    poses: int = 30,
    engine: Engine = ALONE,
    advance: Advance | None = None,
) -> ScalingStudy:
    """Simulate the identification of joint compliances with every scaling.

    Each correlation is an experiment of its own, with unloaded readings shared or not: that is what
    the engine computes side by side, `experiments` of them.

    Args:
        rng: source of poses and noise.
        runs: Monte-Carlo runs; all scalings and units see the same noise.
        correlations: shares ρ of variance that the six elements have in common, each in [0, 1).
        arm: the arm; None for the UR10e.
        engine: what the experiments are computed on.
        advance: told 1 for each experiment that is done.
    """
    check(runs, correlations, poses)
    design = make_design(rng, arm or load_arm("ur10e"), poses)
    asked = _experiments(rng, design, correlations, runs)
    done = engine.map(partial(_cells, design=design, runs=runs), asked, advance=advance)
    return ScalingStudy(
        arm=design.arm.name,
        runs=runs,
        poses=poses,
        loads=len(design.wrenches),
        typical_correlation=_off_diagonal(design.specified) / _off_diagonal(design.common),
        cells=tuple(cell for cells in done for cell in cells),
    )


def check(runs: int, correlations: Sequence[float] = CORRELATIONS, poses: int = 30) -> None:
    """Refuse a study that cannot be, before workers are started for it; see `scaling_study`."""
    if runs < 2:
        raise InputError(f"runs = {runs}: a Monte-Carlo study needs 2 or more")
    if poses < 2:
        raise InputError(f"poses = {poses}: the regression needs 2 or more")
    if not len(correlations):
        raise InputError("correlations: none given; give one or more in [0, 1)")
    for rho in correlations:
        if not 0 <= rho < 1:
            raise InputError(f"correlation {rho:g}: must be in [0, 1)")


def experiments(correlations: Sequence[float] = CORRELATIONS) -> int:
    """Return how many experiments a study of these correlations has."""
    return 2 * len(correlations)


@dataclass(frozen=True, slots=True, eq=False)
class _Experiment:
    """Correlation ρ, whether unloaded readings are shared, and the generator of the noise."""

    rho: float
    shared: bool
    rng: np.random.Generator


def _experiments(
    rng: np.random.Generator, design: StudyDesign, correlations: Sequence[float], runs: int
) -> list[_Experiment]:
    """Give each experiment the generator as it is when those before have drawn their noise.

    So each can be computed by itself, and the random numbers are those of all in one sequence.
    """
    out = []
    for shared in (False, True):
        for rho in correlations:
            out.append(_Experiment(float(rho), shared, deepcopy(rng)))
            _drawn(rng, make_readings(design, design.covariance(float(rho)), shared), runs)
    return out


def _drawn(rng: np.random.Generator, readings: Readings, runs: int) -> Floats:
    """(N, 6, R) standard normal numbers: for every element of N readings in R runs."""
    return rng.standard_normal((len(readings), 6, runs))


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Errors of all runs (n, R), half widths of their intervals, mean χ²/dof."""

    error: Floats
    half_width: Floats
    variance_factor: float | None


def _cells(of: _Experiment, design: StudyDesign, runs: int) -> list[StudyCell]:
    """All scalings and units on the same noise."""
    rho, shared = of.rho, of.shared
    covariance = design.covariance(rho)
    limit = np.sqrt(np.diagonal(bound(design, covariance, shared)))[:, None]
    readings = make_readings(design, covariance, shared)
    # A copy, so that the same experiment can be computed again, as after a worker's death.
    noise = np.linalg.cholesky(covariance)[readings.pose] @ _drawn(deepcopy(of.rng), readings, runs)
    cells = []
    for scaling in SCALINGS:
        first: Floats | None = None
        for unit, length, angle in UNITS:
            u = np.array([length] * 3 + [angle] * 3)
            scaled = make_readings(design, u[:, None] * covariance * u, shared)
            w = whitening(scaled, "deflection", scaling)
            # Row 0 of the loads is "none", so measurement d belongs to wrench load - 1.
            blocks = design.observation[scaled.pose[w.reading], scaled.load[w.reading] - 1]
            fit = _fit(w, u[:, None] * blocks, w.raw(u[:, None] * noise))
            first = fit.error if first is None else first
            shift = float(np.abs((fit.error - first) / limit).max())
            cells.append(_cell(fit, limit, scaling, rho, unit, shared, shift))
    return cells


def _fit(w: Whitening, blocks: Floats, noise: Floats) -> _Fit:
    """Least squares of the scaled regression for all runs at once.

    Args:
        noise: (D, 6, R) errors of the deflections.
    """
    a = w.whiten(blocks).reshape(-1, blocks.shape[-1])
    e = w.whiten(noise).reshape(-1, noise.shape[-1])
    q, r = np.linalg.qr(a)
    projected = q.T @ e
    error = solve_triangular(r, projected)
    spread = np.linalg.norm(solve_triangular(r, np.eye(len(r))), axis=1)[:, None]
    dof = w.rank - len(r)
    factor = (np.sum(e * e, axis=0) - np.sum(projected * projected, axis=0)) / dof
    if w.scaling == "none":  # no noise is stated: the residual's own variance
        half = stats.t.ppf((1 + LEVEL) / 2, dof) * spread * np.sqrt(factor)
        return _Fit(error, half, None)
    half = np.broadcast_to(stats.norm.ppf((1 + LEVEL) / 2) * spread, error.shape)
    return _Fit(error, half, float(factor.mean()))


def _cell(
    fit: _Fit, limit: Floats, scaling: Scaling, rho: float, unit: str, shared: bool, shift: float
) -> StudyCell:
    """Figures of one cell, with the Monte-Carlo's own uncertainty from the runs' spread."""
    square = (fit.error / limit) ** 2
    per_run = square.mean(axis=0)
    rms = float(np.sqrt(per_run.mean()))
    inside = np.abs(fit.error) <= fit.half_width
    inside_run = inside.mean(axis=0)
    root = np.sqrt(len(per_run))
    return StudyCell(
        scaling=scaling,
        correlation=rho,
        unit=unit,
        shared_unloaded=shared,
        error_over_bound=rms,
        error_over_bound_mc=float(per_run.std(ddof=1) / root / (2 * rms)),
        coverage=float(inside_run.mean()),
        coverage_mc=float(inside_run.std(ddof=1) / root),
        variance_factor=fit.variance_factor,
        parameter_error_over_bound=tuple(np.sqrt(square.mean(axis=1)).tolist()),
        parameter_coverage=tuple(inside.mean(axis=1).tolist()),
        unit_shift=shift,
    )


def _off_diagonal(correlation: Floats) -> float:
    """Root mean square of the correlations between different elements."""
    k = correlation.shape[-1]
    off = correlation[..., ~np.eye(k, dtype=bool)]
    return float(np.sqrt(np.mean(off**2)))


BOUND_TOLERANCE = 0.03
COVERAGE_BAND = (0.94, 0.96)
# What is shown: the units matter to `none` alone.
CURVES: tuple[tuple[Scaling, str], ...] = (
    *(("none", unit) for unit, _, _ in UNITS),
    ("gu", UNITS[0][0]),
    ("gc", UNITS[0][0]),
)
UNLOADED = {False: "own", True: "shared"}


def title(study: ScalingStudy) -> str:
    """One line that says what was simulated."""
    return (
        f"Joint compliances of a {study.arm}: {study.poses} poses x {study.loads} loads, "
        f"{study.runs} Monte-Carlo runs"
    )


def largest_shift(study: ScalingStudy, *scalings: Scaling) -> float:
    """Largest change of an estimate with the units, in units of the bound."""
    return max(c.unit_shift for c in study.cells if c.scaling in scalings)


def table(study: ScalingStudy) -> Table:
    """Error over bound and coverage per scaling: one row per correlation."""
    out = Table(
        title=title(study), caption=_caption(study), box=box.SIMPLE_HEAD, caption_justify="left"
    )
    out.add_column("unloaded\nreading")
    out.add_column("corr.\nrho", justify="right")
    for scaling, unit in CURVES:
        out.add_column(f"{scaling}\n{unit if scaling == 'none' else 'any unit'}", justify="right")
    for shared, word in UNLOADED.items():
        curves = [study.of(scaling, unit, shared) for scaling, unit in CURVES]
        for k, row in enumerate(zip(*curves, strict=True)):
            out.add_row(
                word if k == 0 else "",
                f"{row[0].correlation:g}",
                *(_entry(cell) for cell in row),
                end_section=k == len(curves[0]) - 1,
            )
    return out


def _entry(cell: StudyCell) -> Text:
    """Error and coverage, green where they are as they should be."""
    low, high = COVERAGE_BAND
    fits = abs(cell.error_over_bound - 1) <= BOUND_TOLERANCE
    covers = low <= cell.coverage <= high
    return Text.assemble(
        (f"{cell.error_over_bound:.2f}x", "green" if fits else "red"),
        " ",
        (f"{100 * cell.coverage:.1f}%", "green" if covers else "red"),
    )


def _caption(study: ScalingStudy) -> str:
    """How to read the table."""
    error = max(c.error_over_bound_mc / c.error_over_bound for c in study.cells)
    coverage = max(c.coverage_mc for c in study.cells)
    return (
        "Each entry: error of the estimated compliances, as a multiple of the smallest that is "
        "possible (Cramér–Rao bound), and the share of the stated 95 % intervals that hold the "
        "true value. It should say 1.00x 95.0%.\n"
        "corr.: share of the noise variance that the six elements of a reading have in common; "
        f"{study.typical_correlation:.2f} is what the arm's repeatability and the tracker specify. "
        "own: each load has its own unloaded reading; shared: the loads of a pose share one, so "
        "that their deflections are correlated as well.\n"
        f"Changing units moves an estimate by up to {largest_shift(study, 'none'):.0f} standard "
        f"uncertainties with none, and by {largest_shift(study, 'gu', 'gc'):.0e} with gu and gc. "
        f"Monte-Carlo standard uncertainty: below {100 * error:.1f} % of an error, "
        f"{100 * coverage:.1f} % in coverage."
    )
