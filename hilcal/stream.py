"""A model fitted to a stream: Gauss-Newton in which each step is one pass.

A pass reads each chunk once, predicts it, whitens residual and Jacobian, and reduces them to one
triangle R per fold, RᵀR = AᵀA for the rows A. The following steps differ from those of a fit in
memory, as they would need all readings at once:

- Registration, starting model and starting values are those of a sample of at most `SAMPLE`
  readings, spread evenly.
- Tenths of the stream, in its order, are left out instead of poses, as the errors of consecutive
  readings depend on each other.
- Gross errors are set aside after a fit, in at most `OUTLIER_ROUNDS` rounds.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.engine import Counting, Engine, uncounted
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.carried_prior import (
    CarriedPrior,
    coordinates_of,
    prior_of,
    scales_of,
)
from hilcal.identification.fit import Estimates, Fit, fit
from hilcal.identification.fit_document import finite_or_null
from hilcal.identification.folds import FOLDS
from hilcal.identification.gauss_newton import (
    LinearProblem,
    NewtonPoint,
    NewtonProblem,
    Regularisation,
    linear_problem,
    minimum,
    over_all_parameters,
    prior_coordinates,
    spent_parameters,
    whitened_jacobian,
)
from hilcal.identification.noise.full_covariance import joint_factors, with_joint_scatter
from hilcal.identification.outliers.least_trimmed_squares import bulk_scale, rejection_limit
from hilcal.identification.residual import ErrorBlock, WithVarianceFactor, residual
from hilcal.identification.uncertainty import (
    MISFIT_LEVEL,
    identifiable_parameters,
    in_ordinary_magnitudes,
    name_directions,
)
from hilcal.model.model import Model, Prediction
from hilcal.readings.covariance import INSTRUMENT_AND_ARM, with_scatter
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.normal_equations import NormalEquations, Triangle, combined
from hilcal.tables import columns
from hilcal.tables.parquet_stream import ReadingStream
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class PassTask:
    """The input of a worker for a pass."""

    stream: ReadingStream
    model: Model  # in the registered cell
    joint_std: Floats  # (n,) scatter that is added to the covariances, rad; zero for none
    outliers: Mapping[int, Ints]
    """Rows that are set aside, counted from 0 in the stream, ascending, by row group."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """The contribution of a row group to a step."""

    triangles: dict[int, Floats]
    """(P + 1, P + 1) of the columns of all parameters and of the residual, by fold."""
    rank: int  # number of whitened rows that carry information


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """The contribution of a row group to the errors of the fit (0) and without its fold (1)."""

    sums: Floats  # (2, 3) sums of the distance, of its square, of the whitened squares
    max_m: Floats  # (2,) largest distance, m
    floor: float  # sum of the traces of the covariances, m²
    rank: int  # number of whitened rows that carry information
    far_rows: Ints  # rows beyond the limit, counted from 0 in the stream, ascending
    distance2: Floats  # their squared Mahalanobis distances


@dataclass(frozen=True, slots=True, eq=False)
class _Chunk:
    rows: Ints
    readings: Readings
    fold: Ints
    w: Whitening
    prediction: Prediction
    raw: Floats
    inlier: Bools


def reduce_group(group: int, work: PassTask, theta: Floats) -> Reduced:
    """Reduce the whitened rows of a row group at parameters (P,)."""
    every, size = np.arange(work.model.size), work.model.size + 1
    triangles: dict[int, Triangle] = {}
    rank = 0
    for c in _chunks(group, work, theta):
        rows = whitened_jacobian(work.model, c.prediction, theta, c.w, every)
        right = c.w.whiten(c.raw).reshape(-1)
        for fold in np.unique(c.fold):
            in_fold = np.repeat(c.inlier & (c.fold == fold), c.w.m)
            some = slice(None) if in_fold.all() else in_fold
            triangles.setdefault(int(fold), Triangle(size)).add(rows[some], right[some])
        full = np.count_nonzero(np.any(c.w.buckets[0].factor != 0, axis=-1), axis=-1)
        rank += int(full[c.inlier].sum())
    return Reduced({fold: t.r for fold, t in triangles.items()}, rank)


def errors_of_group(
    group: int, work: PassTask, theta: Floats, change: Floats, limit: float
) -> Errors:
    """Return the errors of a row group at parameters (P,).

    `change` (F, P) is the change of the parameters by leaving out each fold; `limit` is the squared
    Mahalanobis distance beyond which rows are listed.
    """
    moved = np.flatnonzero(np.any(change != 0, axis=0))
    sums, most, floor, rank = np.zeros((2, 3)), np.zeros(2), 0.0, 0
    rows: list[Ints] = []
    distances: list[Floats] = []
    for c in _chunks(group, work, theta):
        jacobian = work.model.jacobian(c.prediction, theta, c.w.m, moved)
        left_out = c.raw - np.einsum("dmp,dp->dm", jacobian, change[c.fold][:, moved])
        for k, raw in enumerate((c.raw, left_out)):
            distance = np.linalg.norm(raw[:, :3], axis=1)
            sums[k] += distance.sum(), distance @ distance, np.sum(c.w.whiten(raw) ** 2)
            most[k] = max(most[k], distance.max(initial=0.0))
        floor += float(np.trace(c.readings.covariance[:, :3, :3], axis1=1, axis2=2).sum())
        rank += c.w.rank
        distance2 = np.sum(c.w.whiten(c.raw).reshape(c.raw.shape) ** 2, axis=1)
        beyond = distance2 > limit
        rows.append(c.rows[beyond])
        distances.append(distance2[beyond])
    return Errors(sums, most, floor, rank, np.concatenate(rows), np.concatenate(distances))


def sample_group(group: int, work: PassTask, step: int) -> Readings | None:
    """Return every `step`-th reading of the stream in a row group; None without one.

    The function reads all rows, so that invalid ones are refused before any computation.
    """
    sampled = []
    row = work.stream.first_row(group)
    for readings in work.stream.chunks(group):
        rows = np.arange(row, row + len(readings))
        chosen = rows % step == 0
        if chosen.any():
            sampled.append(replace(readings[chosen], pose=rows[chosen]))
        row += len(readings)
    return Readings.joined(sampled) if sampled else None


def _chunks(group: int, work: PassTask, theta: Floats) -> Iterator[_Chunk]:
    row, total = work.stream.first_row(group), len(work.stream)
    aside = work.outliers.get(group, np.zeros(0, dtype=np.int64))
    cell = work.model.cell
    for readings in work.stream.chunks(group):
        if work.joint_std.any():
            readings = with_scatter(readings, joint_factors(cell, readings, work.joint_std))
        rows = np.arange(row, row + len(readings))
        prediction = work.model.predict(readings.states, theta)
        w = whitening(readings, "absolute")
        raw = residual(readings, prediction, w)
        fold = rows * FOLDS // total
        yield _Chunk(rows, readings, fold, w, prediction, raw, ~np.isin(rows, aside))
        row += len(readings)


Result = TypeVar("Result")
SAMPLE = 2000
"""Most readings for registration, starting model and starting values; a choice: enough for every
effect of the catalogue, and a fit of a second."""
MAX_NAMED = 10  # most gross errors that are named; a choice
OUTLIER_ROUNDS = 2  # most searches for gross errors that are followed by a new fit; a choice
MAX_OUTLIER_SHARE = 0.05  # largest share of gross errors; a choice: more are a misfit of the model


@dataclass(frozen=True, slots=True, eq=False)
class _StreamPoint(NewtonPoint):
    """A point with the triangles of columns and residual, of all readings and by fold."""

    folds: Mapping[int, Floats]
    triangle: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Stream(NewtonProblem[_StreamPoint]):
    """The least-squares problem of a stream; each point takes one pass."""

    work: PassTask
    engine: Engine
    counting: Counting = uncounted
    passed: list[int] = field(default_factory=list)

    def at(self, y: Floats) -> _StreamPoint:
        theta = self.coordinates.theta(y)
        parts = self.over(partial(reduce_group, work=self.work, theta=theta))
        size = len(theta) + 1
        folds = {
            k: combined([part.triangles[k] for part in parts if k in part.triangles], size)
            for k in sorted({fold for part in parts for fold in part.triangles})
        }
        triangle = combined(folds.values(), size)
        rss = float(triangle[:, -1] @ triangle[:, -1])
        return _StreamPoint(y, theta, rss, sum(part.rank for part in parts), folds, triangle)

    def over(self, run: Callable[[int], Result]) -> tuple[Result, ...]:
        """Return the values of a function of each row group, in one pass."""
        self.passed.append(1)
        return _over(self.work.stream, run, self.engine, self.counting, 1 + len(self.passed))

    def linearise(self, point: _StreamPoint, prior: Floats) -> LinearProblem:
        live = np.flatnonzero(prior > 0)
        a = self.coordinates.columns(point.triangle[:, :-1])[:, live]
        white = point.triangle[:, -1]
        return linear_problem(point, prior, a, white, point.elements, 1.0, whitened=True)


def _over(
    stream: ReadingStream, run: Callable[[int], Result], engine: Engine, counting: Counting, k: int
) -> tuple[Result, ...]:
    groups = range(len(stream.rows))
    with counting(f"pass {k}, row groups", len(groups)) as advance:
        return engine.map(run, groups, advance=advance)


@dataclass(frozen=True, slots=True, eq=False)
class StreamFit(WithVarianceFactor):
    """A model fitted to a stream."""

    model: Model  # robot and effects
    sample: Fit  # fit of the sample, the starting point
    theta: Floats  # (P,) parameters
    covariance: Floats  # (P, P) of the parameters, widened if the residual is larger than noise
    std: Floats  # (P,) standard uncertainties; infinite if not identifiable
    identifiable: Bools  # (P,) whether the data determine a parameter
    estimated: Bools  # (P,) whether a parameter was not held at zero
    null: tuple[str, ...]  # names of the unidentifiable directions
    inflated: bool  # whether the residual is larger than noise
    readings: int  # number of readings of the stream
    chi2: float  # whitened sum of squares
    dof: float  # degrees of freedom
    rank: int  # number of directions that the data determine
    condition: tuple[float, float]
    """Condition number of the whitened columns, in physical units and scaled."""
    error: ErrorBlock  # of the fit
    holdout: ErrorBlock  # of each tenth of the stream, predicted without it
    noise_floor: float  # rms position error by the stated noise alone, m
    outliers: int  # number of readings set aside as gross errors
    named: tuple[tuple[int, float], ...]
    """(row in the file, from 1; Mahalanobis distance) of the worst gross errors."""
    passes: int  # over the stream
    converged: bool  # whether the last step was negligible

    @property
    def parameters(self) -> Estimates:
        """The parameters with their standard uncertainties, without those of dropped groups."""
        return Estimates.of(self.model, self.theta, self.std, self.identifiable, self.estimated)


def fit_stream(
    stream: ReadingStream,
    cell: Cell,
    engine: Engine,
    effects: Mapping[str, Options] | None = None,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
    counting: Counting = uncounted,
) -> StreamFit:
    """Fit a model to a stream of absolute readings.

    Args:
        effects: options by effect, in addition to unknown frames; None: the baseline.
        counting: shows the progress of a pass.

    Raises:
        CannotAnswerError: too few readings, or an unknown frame that they do not determine.
    """
    work = PassTask(stream, Model(cell, ()), _scatter(stream, cell), {})
    readings = with_joint_scatter(cell, _sample(work, engine, counting), work.joint_std)
    if effects is None:
        model = baseline(cell, readings, "absolute", catalogue, prior)
    else:
        model = with_effects(cell, readings, "absolute", effects, effects, catalogue, prior)
    first = fit(model, readings, "absolute")
    work = replace(work, model=replace(first.model, readings=None))
    problem = _Stream(work.model, coordinates_of(work.model), True, work, engine, counting)
    theta = first.theta
    far = rejection_limit(readings.m, len(stream), bulk_scale(first.mahalanobis2, readings.m))
    for search in range(OUTLIER_ROUNDS + 1):
        solved = _solved(problem, theta)
        theta = solved.point.theta
        errors = solved.errors(far)
        aside = {k: e.far_rows for k, e in enumerate(errors) if len(e.far_rows)}
        count, previous = (sum(map(len, x.values())) for x in (aside, problem.work.outliers))
        if count in (0, previous) or count > MAX_OUTLIER_SHARE * len(stream):
            break
        if search < OUTLIER_ROUNDS:
            problem = replace(problem, work=replace(problem.work, outliers=aside))
    return solved.result(first, errors)


def _scatter(stream: ReadingStream, cell: Cell) -> Floats:
    """Return the arm's scatter (n,) to add to the covariances, rad; zero if they include it."""
    config = cell.configured()
    stated = columns.covariance_columns(3)[0] in stream.columns
    included = stream.covers == INSTRUMENT_AND_ARM or (stated and config.repeatability.in_tables)
    return np.zeros(cell.arm.n) if included else config.repeatability.per_joint(cell.arm.n)


def _sample(work: PassTask, engine: Engine, counting: Counting) -> Readings:
    step = -(-len(work.stream) // SAMPLE)
    run = partial(sample_group, work=work, step=step)
    parts = _over(work.stream, run, engine, counting, 1)
    sample = Readings.joined([part for part in parts if part is not None])
    names = tuple(f"row {k + 1}" for k in sample.pose)
    return replace(sample, pose=np.arange(len(sample)), pose_names=names)


@dataclass(frozen=True, slots=True, eq=False)
class _StreamMinimum:
    """The minimum of a problem, with its normal equations."""

    problem: _Stream
    point: _StreamPoint
    regularisation: Regularisation
    converged: bool
    equations: NormalEquations
    change: Floats  # (F, P) of the parameters by leaving out each fold

    def errors(self, far: float) -> tuple[Errors, ...]:
        """Return the errors of each row group; see `errors_of_group`."""
        work, theta = self.problem.work, self.point.theta
        run = partial(errors_of_group, work=work, theta=theta, change=self.change, limit=far)
        return self.problem.over(run)

    def result(self, first: Fit, errors: tuple[Errors, ...]) -> StreamFit:
        """Return the fit: parameters with uncertainties, errors and gross errors."""
        problem, model, point = self.problem, self.problem.model, self.point
        beta, prior = self.regularisation.beta, self.regularisation.prior
        basis, space, groups = self.equations.basis, problem.coordinates, prior_of(model)[1]
        transform, scale = space.transform(basis.transform), scales_of(model)
        covariance = transform @ self.equations.inverse(beta) @ transform.T
        covariance[space.index, space.index] += space.omitted_variance / beta
        formal = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        spent = spent_parameters(self.equations, beta, groups)
        dof = max(point.elements - spent, 1.0)
        inflated = bool(scipy.stats.chi2.sf(point.rss, dof) < MISFIT_LEVEL)
        std = formal
        if inflated:
            change = self.change[list(point.folds)]
            count, off = len(change), change - change.mean(axis=0)
            jackknife = np.sqrt((count - 1) / count * np.sum(off**2, axis=0))
            std = np.maximum(formal * np.sqrt(point.rss / dof), jackknife)
        null = in_ordinary_magnitudes(space, basis.null, scale)
        carried = space.carried(len(scale))
        identifiable = identifiable_parameters(basis, prior, carried, scale, std, null)
        wider = std / np.where(formal > 0, formal, 1.0)
        sums, count = sum(e.sums for e in errors), len(problem.work.stream)
        rank, most = sum(e.rank for e in errors), np.max([e.max_m for e in errors], axis=0)
        blocks = [
            ErrorBlock(
                rms_m=float(np.sqrt(s[1] / count)),
                mean_m=float(s[0] / count),
                max_m=float(m),
                rms_sigma=float(np.sqrt(s[2] / max(rank, 1))),
            )
            for s, m in zip(np.asarray(sums), most, strict=True)
        ]
        aside = problem.work.outliers
        worst = [
            (int(row) + 1, float(np.sqrt(d2)))
            for k, e in enumerate(errors)
            for row, d2 in zip(e.far_rows, e.distance2, strict=True)
            if k in aside and row in aside[k]
        ]
        return StreamFit(
            model=model,
            sample=first,
            theta=point.theta,
            covariance=wider[:, None] * covariance * wider,
            std=np.where(identifiable, std, np.inf),
            identifiable=identifiable,
            estimated=(prior != 0) | carried,
            null=name_directions(model, null),
            inflated=inflated,
            readings=count,
            chi2=point.rss,
            dof=dof,
            rank=int(basis.transform.shape[1]),
            condition=(basis.condition_unscaled, basis.condition_scaled),
            error=blocks[0],
            holdout=blocks[1],
            noise_floor=float(np.sqrt(sum(e.floor for e in errors) / count)),
            outliers=sum(map(len, aside.values())),
            named=tuple(sorted(worst, key=lambda row: -row[1])[:MAX_NAMED]),
            passes=1 + len(problem.passed),
            converged=self.converged,
        )


def _solved(problem: _Stream, theta: Floats) -> _StreamMinimum:
    """Return the minimum, starting from parameters (P,)."""
    space = problem.coordinates
    solution = minimum(problem, space.of_theta(theta), None)
    point, regularisation = solution.point, solution.regularisation
    live_basis, beta, prior = regularisation.basis, regularisation.beta, regularisation.prior
    if point.elements <= live_basis.structural:
        raise CannotAnswerError(
            f"{point.elements} measured elements for {live_basis.structural} parameters: nothing "
            "is left to judge the model by"
        )
    live = np.flatnonzero(prior > 0)
    basis = over_all_parameters(live_basis, live, len(theta))
    z = prior_coordinates(basis, point.y, prior)

    def equations_of(triangle: Floats) -> NormalEquations:
        rows = live_basis.rows(space.columns(triangle[:, :-1])[:, live])
        return NormalEquations(basis, rows.T @ rows, rows.T @ (triangle[:, -1] + rows @ z))

    equations, size = equations_of(point.triangle), len(theta) + 1
    change = np.zeros((FOLDS, len(theta)))
    transform, scaled = space.transform(basis.transform), equations.solve(beta)
    for fold in point.folds:
        others = combined((r for k, r in point.folds.items() if k != fold), size)
        change[fold] = transform @ (equations_of(others).solve(beta) - scaled)
    return _StreamMinimum(problem, point, regularisation, solution.converged, equations, change)


def to_json(fit: StreamFit) -> dict[str, object]:
    """Return the JSON document of a fit.

    `error.holdout`: each tenth of the stream, predicted without it.
    """
    return {
        "model": list(fit.model.names),
        "readings": "absolute",
        "scaling": "gc",
        "n_readings": fit.readings,
        "dof": fit.dof,
        "rank": fit.rank,
        "converged": fit.converged,
        "passes": fit.passes,
        "condition": {
            "unscaled": finite_or_null(fit.condition[0]),
            "scaled": finite_or_null(fit.condition[1]),
        },
        "parameters": fit.parameters.to_dicts(),
        "unidentifiable": list(fit.null),
        "inflated": fit.inflated,
        "variance_factor": fit.variance_factor,
        "variance_factor_interval": list(fit.variance_factor_interval),
        "error": {"fit": fit.error.to_json(), "holdout": fit.holdout.to_json()},
        "noise_floor_m": fit.noise_floor,
        "n_outliers": fit.outliers,
        "outliers": [{"row": row, "sigma": sigma} for row, sigma in fit.named],
    }
