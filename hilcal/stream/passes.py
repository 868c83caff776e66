"""One pass over a stream: what each row group gives, on whichever worker reads it.

A pass reads each chunk once, predicts it, whitens residual and Jacobian, and reduces them to one
triangle per fold. Folds are tenths of the stream, in its order: the errors of readings that follow
each other are not independent.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from hilcal.identification.folds import FOLDS
from hilcal.identification.full_covariance import joint_factors
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.residual import residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.covariance import with_scatter
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.normal_equations import Triangle
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
    readings: int  # number of readings that they are of
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
    count = rank = 0
    for c in _chunks(group, work, theta):
        rows = whitened_jacobian(work.model, c.prediction, theta, c.w, every)
        right = c.w.whiten(c.raw).reshape(-1)
        kept = np.repeat(c.kept, c.w.m)
        for fold in np.unique(c.fold):
            mine = kept & np.repeat(c.fold == fold, c.w.m)
            some = slice(None) if mine.all() else mine
            found.setdefault(int(fold), Triangle(size)).add(rows[some], right[some])
        count += int(c.kept.sum())
        rank += _rank(c)
    return Reduced({fold: t.r for fold, t in found.items()}, count, rank)


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


def _rank(c: _Chunk) -> int:
    """Number of whitened rows of the readings that are not set aside."""
    full = np.count_nonzero(np.any(c.w.buckets[0].factor != 0, axis=-1), axis=-1)
    return int(full[c.kept].sum())
