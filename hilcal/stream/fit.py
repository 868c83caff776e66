"""A model fitted to a stream: Gauss-Newton in which each step is one pass.

A pass reads each chunk once, predicts it, whitens residual and Jacobian, and reduces them to one
triangle per fold, whose products are those of the rows. Replaced is what needs all readings:

- registration, starting model and starting values are those of a sample of at most `SAMPLE`
  readings, spread evenly;
- tenths of the stream, in its order, are left out in place of poses: the errors of readings that
  follow each other are not independent;
- readings beyond the limit of a gross error are set aside once, after a first fit.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, TypeVar

import numpy as np
from scipy.stats import chi2

from hilcal.cell import Cell
from hilcal.effects.catalogue import Catalogue
from hilcal.effects.options import Options
from hilcal.engine.engine import Advance, Engine
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried import CarriedPrior, coordinates_of
from hilcal.identification.fit import Estimates, Fit, fit
from hilcal.identification.fit_document import finite
from hilcal.identification.folds import FOLDS
from hilcal.identification.full_covariance import joint_factors, with_joint_scatter
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
from hilcal.identification.least_trimmed_squares import bulk, limit
from hilcal.identification.priors import prior_of, scales_of
from hilcal.identification.residual import ErrorBlock, WithVarianceFactor, residual
from hilcal.identification.uncertainty import (
    MISFIT_CHANCE,
    identifiable_parameters,
    in_ordinary_magnitudes,
    name_directions,
)
from hilcal.model.model import Model, Prediction
from hilcal.readings.covariance import WHOLE, with_scatter
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.normal_equations import NormalEquations, Triangle, combined
from hilcal.tables import columns
from hilcal.tables.parquet_stream import ReadingStream
from hilcal.types import Bools, Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class PassTask:
    """What a worker needs to know."""

    stream: ReadingStream
    model: Model  # that is fitted; its cell is registered
    joint_std: Floats  # (n,) scatter that is added to the covariances, rad; zero for none
    outliers: Mapping[int, Ints]
    """Rows that are set aside, counted from 0 in the stream, ascending, by row group."""


@dataclass(frozen=True, slots=True, eq=False)
class Reduced:
    """What a row group gives to a step."""

    triangles: dict[int, Floats]
    """(P + 1, P + 1) of the columns of all parameters and of the residual, by fold."""
    rank: int  # number of whitened rows that carry information


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """What a row group gives to the errors; of the fit, and predicted without its fold."""

    sums: Floats  # (2, 3) sums of the distance, of its square, of the whitened squares
    most: Floats  # (2,) largest distance, m
    floor: float  # sum of the traces of the covariances, m²
    rank: int  # number of whitened rows that carry information
    far: Ints  # rows beyond the limit, counted from 0 in the stream, ascending
    distance2: Floats  # their squared Mahalanobis distances


@dataclass(frozen=True, slots=True, eq=False)
class _Chunk:
    rows: Ints
    readings: Readings
    fold: Ints
    w: Whitening
    prediction: Prediction
    raw: Floats
    kept: Bools


def reduce_group(group: int, work: PassTask, theta: Floats) -> Reduced:
    """Reduce the whitened rows of a row group at parameters (P,)."""
    every, size = np.arange(work.model.size), work.model.size + 1
    found: dict[int, Triangle] = {}
    rank = 0
    for c in _chunks(group, work, theta):
        rows = whitened_jacobian(work.model, c.prediction, theta, c.w, every)
        right = c.w.whiten(c.raw).reshape(-1)
        kept = np.repeat(c.kept, c.w.m)
        for fold in np.unique(c.fold):
            mine = kept & np.repeat(c.fold == fold, c.w.m)
            some = slice(None) if mine.all() else mine
            found.setdefault(int(fold), Triangle(size)).add(rows[some], right[some])
        full = np.count_nonzero(np.any(c.w.buckets[0].factor != 0, axis=-1), axis=-1)
        rank += int(full[c.kept].sum())
    return Reduced({fold: t.r for fold, t in found.items()}, rank)


def errors_of_group(
    group: int, work: PassTask, theta: Floats, change: Floats, far: float
) -> Errors:
    """Return the errors of a row group at parameters (P,).

    `change` (F, P) is what leaving out each fold does to them; readings beyond the squared
    Mahalanobis distance `far` are named.
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
        beyond = distance2 > far
        rows.append(c.rows[beyond])
        distances.append(distance2[beyond])
    return Errors(sums, most, floor, rank, np.concatenate(rows), np.concatenate(distances))


def sample_group(group: int, work: PassTask, step: int) -> Readings | None:
    """Return every `step`-th reading of the stream that lies in a row group, None for none.

    All its rows are read, and what cannot be right is refused before anything is computed.
    """
    found = []
    row = work.stream.first_row(group)
    for readings in work.stream.chunks(group):
        rows = np.arange(row, row + len(readings))
        chosen = rows % step == 0
        if chosen.any():
            found.append(replace(readings[chosen], pose=rows[chosen]))
        row += len(readings)
    return Readings.joined(found) if found else None


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
"""Readings that registration, starting model and starting values are taken from; a choice: enough
for every effect of the catalogue, and a fit of a second."""
NAMED = 10  # Gross errors that are named; a choice
OUTLIER_ROUNDS = 2  # Searches for gross errors, each followed by a new fit; a choice
MAX_OUTLIER_SHARE = 0.05  # Most readings that are set aside, as a share; a choice: more is a misfit

Counting = Callable[[str, int], AbstractContextManager[Advance]]


def _unseen(what: str, total: int) -> AbstractContextManager[Advance]:
    return nullcontext(lambda step: None)


@dataclass(frozen=True, slots=True, eq=False)
class _StreamPoint(NewtonPoint):
    """A point with the triangle of all parameters' columns and the residual, by fold."""

    folds: Mapping[int, Floats]
    triangle: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Stream(NewtonProblem[_StreamPoint]):
    """Readings of a stream; a point takes one pass."""

    same_rows: ClassVar[bool] = False

    work: PassTask
    engine: Engine
    counting: Counting = _unseen
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
        """Return a function of each row group: one pass."""
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
    sample: Fit  # the fit of the sample that it started from
    theta: Floats  # (P,) parameters
    covariance: Floats  # (P, P) of the parameters, widened where the residual is larger than noise
    std: Floats  # (P,) standard uncertainties; infinite where not identifiable
    identifiable: Bools  # (P,) which parameters the data determine
    estimated: Bools  # (P,) which were not held at zero
    null: tuple[str, ...]  # names of the unidentifiable directions
    inflated: bool  # whether the residual is larger than noise
    readings: int  # number of readings of the stream
    chi2: float  # whitened sum of squares
    dof: float  # degrees of freedom
    rank: int  # number of directions that the data determine
    condition: tuple[float, float]
    """condition number of the whitened columns, in physical units and scaled."""
    error: ErrorBlock  # error block of the fit
    holdout: ErrorBlock  # the same, each tenth of the stream predicted without it
    noise_floor: float  # rms position error by the stated noise alone, m
    outliers: int  # number of readings set aside as gross errors
    named: tuple[tuple[int, float], ...]
    """(row in the file, from 1; Mahalanobis distance) of the worst of them."""
    passes: int  # passes over the stream
    converged: bool  # whether the last step was negligible

    @property
    def parameters(self) -> Estimates:
        """The parameters with their standard uncertainties, those of dropped groups left out."""
        return Estimates.of(self.model, self.theta, self.std, self.identifiable, self.estimated)


def fit_stream(
    stream: ReadingStream,
    cell: Cell,
    engine: Engine,
    effects: Mapping[str, Options] | None = None,
    catalogue: Catalogue | None = None,
    prior: CarriedPrior | None = None,
    counting: Counting = _unseen,
) -> StreamFit:
    """Fit a model to a stream of absolute readings.

    Args:
        effects: options by effect, besides unknown frames; the baseline where None.
        counting: shows how far a pass is, as `present.progress.counting` does.

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
    far = limit(readings.m, len(stream), bulk(first.mahalanobis2, readings.m))
    for search in range(OUTLIER_ROUNDS + 1):
        found = _solved(problem, theta)
        theta = found.point.theta
        errors = found.errors(far)
        aside = {k: e.far for k, e in enumerate(errors) if len(e.far)}
        count, known = _count(aside), _count(problem.work.outliers)
        if count in (0, known) or count > MAX_OUTLIER_SHARE * len(stream):
            break
        if search < OUTLIER_ROUNDS:
            problem = replace(problem, work=replace(problem.work, outliers=aside))
    return found.result(first, errors)


def _scatter(stream: ReadingStream, cell: Cell) -> Floats:
    """(n,) scatter of the arm that is added to the covariances, rad; zero where they have it."""
    config = cell.configured()
    stated = columns.covariance_columns(3)[0] in stream.columns
    whole = stream.covers == WHOLE or (stated and config.repeatability.in_tables)
    return np.zeros(cell.arm.n) if whole else config.repeatability.per_joint(cell.arm.n)


def _sample(work: PassTask, engine: Engine, counting: Counting) -> Readings:
    step = -(-len(work.stream) // SAMPLE)
    run = partial(sample_group, work=work, step=step)
    parts = _over(work.stream, run, engine, counting, 1)
    found = Readings.joined([part for part in parts if part is not None])
    names = tuple(f"row {k + 1}" for k in found.pose)
    return replace(found, pose=np.arange(len(found)), pose_names=names)


def _count(rows: Mapping[int, Ints]) -> int:
    return sum(len(found) for found in rows.values())


@dataclass(frozen=True, slots=True, eq=False)
class _StreamMinimum:
    """The minimum, and the normal equations there: of all, and without each fold."""

    problem: _Stream
    point: _StreamPoint
    by: Regularisation
    converged: bool
    equations: NormalEquations
    change: Floats

    def errors(self, far: float) -> tuple[Errors, ...]:
        """Return the errors of each row group, and the readings beyond a squared distance."""
        of = self.problem
        run = partial(
            errors_of_group, work=of.work, theta=self.point.theta, change=self.change, far=far
        )
        return of.over(run)

    def result(self, first: Fit, errors: tuple[Errors, ...]) -> StreamFit:
        """Return what is known of the fit."""
        of, model, by, point = self.problem, self.problem.model, self.by, self.point
        basis, space, groups = self.equations.basis, of.coordinates, prior_of(of.model)[1]
        transform, scale = space.transform(basis.transform), scales_of(model)
        covariance = transform @ self.equations.inverse(by.beta) @ transform.T
        covariance[space.index, space.index] += space.rest / by.beta
        formal = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        spent = spent_parameters(self.equations, by.beta, groups)
        dof = max(point.elements - spent, 1.0)
        inflated = bool(chi2.sf(point.rss, dof) < MISFIT_CHANCE)
        std = formal
        if inflated:
            change = self.change[list(point.folds)]
            count, off = len(change), change - change.mean(axis=0)
            jackknife = np.sqrt((count - 1) / count * np.sum(off**2, axis=0))
            std = np.maximum(formal * np.sqrt(point.rss / dof), jackknife)
        null = in_ordinary_magnitudes(space, basis.null, scale)
        carried = space.carried(len(scale))
        seen = identifiable_parameters(basis, by.prior, carried, scale, std, null)
        wider = std / np.where(formal > 0, formal, 1.0)
        sums, count = sum(e.sums for e in errors), len(of.work.stream)
        rank, most = sum(e.rank for e in errors), np.max([e.most for e in errors], axis=0)
        blocks = [
            ErrorBlock(
                rms_m=float(np.sqrt(s[1] / count)),
                mean_m=float(s[0] / count),
                max_m=float(m),
                rms_sigma=float(np.sqrt(s[2] / max(rank, 1))),
            )
            for s, m in zip(np.asarray(sums), most, strict=True)
        ]
        aside = of.work.outliers
        worst = [
            (int(row) + 1, float(np.sqrt(d2)))
            for k, e in enumerate(errors)
            for row, d2 in zip(e.far, e.distance2, strict=True)
            if k in aside and row in aside[k]
        ]
        return StreamFit(
            model=model,
            sample=first,
            theta=point.theta,
            covariance=wider[:, None] * covariance * wider,
            std=np.where(seen, std, np.inf),
            identifiable=seen,
            estimated=(by.prior != 0) | carried,
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
            outliers=_count(aside),
            named=tuple(sorted(worst, key=lambda one: -one[1])[:NAMED]),
            passes=1 + len(of.passed),
            converged=self.converged,
        )


def _solved(problem: _Stream, theta: Floats) -> _StreamMinimum:
    """Return the minimum from parameters (P,) on."""
    space = problem.coordinates
    found = minimum(problem, space.of_theta(theta), None)
    point, by, converged = found.point, found.by, found.converged
    if point.elements <= by.basis.structural:
        raise CannotAnswerError(
            f"{point.elements} measured elements for {by.basis.structural} parameters: nothing is "
            "left to judge the model by"
        )
    live = np.flatnonzero(by.prior > 0)
    basis = over_all_parameters(by.basis, live, len(theta))
    z = prior_coordinates(basis, point.y, by.prior)

    def equations_of(triangle: Floats) -> NormalEquations:
        rows = by.basis.rows(space.columns(triangle[:, :-1])[:, live])
        return NormalEquations(basis, rows.T @ rows, rows.T @ (triangle[:, -1] + rows @ z))

    equations, size = equations_of(point.triangle), len(theta) + 1
    change = np.zeros((FOLDS, len(theta)))
    transform, now = space.transform(basis.transform), equations.solve(by.beta)
    for fold in point.folds:
        rest = combined((r for k, r in point.folds.items() if k != fold), size)
        change[fold] = transform @ (equations_of(rest).solve(by.beta) - now)
    return _StreamMinimum(problem, point, by, converged, equations, change)


def to_json(fit: StreamFit) -> dict[str, object]:
    """Keys of the contract, and what a stream has beside them.

    `error.holdout`: each tenth of the stream, predicted without it.
    """
    low, high = fit.variance_factor_interval
    return {
        "model": list(fit.model.names),
        "readings": "absolute",
        "scaling": "gc",
        "n_readings": fit.readings,
        "dof": fit.dof,
        "rank": fit.rank,
        "converged": fit.converged,
        "passes": fit.passes,
        "condition": {"unscaled": finite(fit.condition[0]), "scaled": finite(fit.condition[1])},
        "parameters": fit.parameters.to_dicts(),
        "unidentifiable": list(fit.null),
        "inflated": fit.inflated,
        "variance_factor": fit.variance_factor,
        "variance_factor_interval": [low, high],
        "error": {"fit": fit.error.to_json(), "holdout": fit.holdout.to_json()},
        "noise_floor_m": fit.noise_floor,
        "n_outliers": fit.outliers,
        "outliers": [{"row": row, "sigma": sigma} for row, sigma in fit.named],
    }
