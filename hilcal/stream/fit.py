"""A model fitted to a stream: Gauss-Newton in which each step is one pass.

The steps are those of readings in memory (`gauss_newton_steps`): the linear problem of a step has
the triangle of the whitened rows in place of the rows, whose products are the same. What needs all
readings at once is replaced:

- registration, starting model and starting values are those of a sample of at most `SAMPLE`
  readings, spread evenly;
- tenths of the stream are left out in place of poses;
- readings beyond the limit of a gross error are set aside once, after a first fit.
"""

from collections.abc import Callable, Mapping
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
from hilcal.identification.carried import CarriedPrior
from hilcal.identification.coordinates import coordinates_of
from hilcal.identification.estimates import Estimates
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import finite
from hilcal.identification.folds import FOLDS
from hilcal.identification.full_covariance import with_joint_scatter
from hilcal.identification.gauss_newton import over_all_parameters, prior_coordinates
from hilcal.identification.gauss_newton_steps import (
    NewtonPoint,
    NewtonProblem,
    linear_problem,
    minimum,
)
from hilcal.identification.least_trimmed_squares import bulk, limit
from hilcal.identification.priors import prior_of, scales_of
from hilcal.identification.regularisation import LinearProblem, Regularisation, spent_parameters
from hilcal.identification.residual import ErrorBlock
from hilcal.identification.uncertainty import (
    MISFIT_CHANCE,
    identifiable_parameters,
    in_ordinary_magnitudes,
    name_directions,
)
from hilcal.identification.variance_factor import WithVarianceFactor
from hilcal.model.model import Model
from hilcal.readings.covariance import WHOLE
from hilcal.readings.readings import Readings
from hilcal.regression.normal_equations import NormalEquations, combined
from hilcal.stream.passes import (
    Errors,
    PassTask,
    Reduced,
    errors_of_group,
    reduce_group,
    sample_group,
)
from hilcal.tables import columns
from hilcal.tables.parquet_stream import ReadingStream
from hilcal.types import Bools, Floats, Ints

Result = TypeVar("Result")
SAMPLE = 2000
"""Readings that registration, starting model and starting values are taken from; a choice: enough
for every effect of the catalogue, and a fit of a second."""
NAMED = 10
"""Gross errors that are named; a choice."""
OUTLIER_ROUNDS = 2
"""Searches for gross errors, each followed by a new fit; a choice."""
MAX_OUTLIER_SHARE = 0.05
"""Most readings that are set aside, as a share; a choice: more is a misfit."""

Counting = Callable[[str, int], AbstractContextManager[Advance]]


def _unseen(what: str, total: int) -> AbstractContextManager[Advance]:
    return nullcontext(lambda step: None)


@dataclass(frozen=True, slots=True, eq=False)
class _StreamPoint(NewtonPoint):
    """A point with the triangle of all parameters' columns and the residual, by fold."""

    folds: Mapping[int, Floats]
    triangle: Floats
    readings: int
    rank: int


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
        return _point(y, theta, self.over(partial(reduce_group, work=self.work, theta=theta)))

    def over(self, run: Callable[[int], Result]) -> tuple[Result, ...]:
        """Return a function of each row group: one pass."""
        self.passed.append(1)
        return _over(self.work.stream, run, self.engine, self.counting, 1 + len(self.passed))

    def linearise(self, point: _StreamPoint, prior: Floats) -> LinearProblem:
        live = np.flatnonzero(prior > 0)
        a = self.coordinates.columns(point.triangle[:, :-1])[:, live]
        white = point.triangle[:, -1]
        return linear_problem(point, prior, a, white, point.rank, 1.0, whitened=True)


def _over(
    stream: ReadingStream, run: Callable[[int], Result], engine: Engine, counting: Counting, k: int
) -> tuple[Result, ...]:
    groups = range(len(stream.rows))
    with counting(f"pass {k}, row groups", len(groups)) as advance:
        return engine.map(run, groups, advance=advance)


def _point(y: Floats, theta: Floats, parts: tuple[Reduced, ...]) -> _StreamPoint:
    size = len(theta) + 1
    numbers = sorted({fold for part in parts for fold in part.triangles})
    folds = {
        k: combined([part.triangles[k] for part in parts if k in part.triangles], size)
        for k in numbers
    }
    triangle = combined(folds.values(), size)
    rss = float(triangle[:, -1] @ triangle[:, -1])
    rank = sum(part.rank for part in parts)
    count = sum(part.readings for part in parts)
    return _StreamPoint(y, theta, rss, rank, folds, triangle, count, rank)


@dataclass(frozen=True, slots=True, eq=False)
class StreamFit(WithVarianceFactor):
    """A model fitted to a stream.

    Attributes:
        model: robot and effects.
        sample: the fit of the sample that it started from.
        theta: (P,) parameters.
        covariance: (P, P) of the parameters, widened where the residual is larger than noise.
        std: (P,) standard uncertainties; infinite where not identifiable.
        identifiable: (P,) which parameters the data determine.
        estimated: (P,) which were not held at zero.
        null: names of the unidentifiable directions.
        inflated: whether the residual is larger than noise.
        readings: number of readings of the stream.
        chi2: whitened sum of squares.
        dof: degrees of freedom.
        rank: number of directions that the data determine.
        condition: condition number of the whitened columns, in physical units and scaled.
        error: error block of the fit.
        holdout: the same, each tenth of the stream predicted without it.
        noise_floor: rms position error by the stated noise alone, m.
        outliers: number of readings set aside as gross errors.
        named: (row in the file, from 1; Mahalanobis distance) of the worst of them.
        passes: passes over the stream.
        converged: whether the last step was negligible.
    """

    model: Model
    sample: Fit
    theta: Floats
    covariance: Floats
    std: Floats
    identifiable: Bools
    estimated: Bools
    null: tuple[str, ...]
    inflated: bool
    readings: int
    chi2: float
    dof: float
    rank: int
    condition: tuple[float, float]
    error: ErrorBlock
    holdout: ErrorBlock
    noise_floor: float
    outliers: int
    named: tuple[tuple[int, float], ...]
    passes: int
    converged: bool

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
        stream: the readings.
        cell: the cell that they were measured in.
        engine: what the passes run on.
        effects: options by effect, besides unknown frames; the baseline where None.
        catalogue: the effects that a model can have; the installed ones unless given.
        prior: what another campaign taught of the arm.
        counting: shows how far a pass is, as `present.progress.counting` does.

    Raises:
        InputError: a row that cannot be right, or effects that cannot be.
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
        dof = max(point.rank - spent, 1.0)
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
    if point.rank <= by.basis.structural:
        raise CannotAnswerError(
            f"{point.rank} measured elements for {by.basis.structural} parameters: nothing is left "
            "to judge the model by"
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
