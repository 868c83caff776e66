"""Task-variable scaling: the one place where noise enters.

A scaling matrix G multiplies both sides of A c = ΔX so that the errors G ε become
independent, of unit spread, and pure numbers. G is block diagonal: one block per reading
(absolute) or per pose group (deflections of one pose share their unloaded reading). Where several
targets were read in one arrival of the arm, they share its scatter F_i F_jᵀ (`Readings.common`):
absolute readings have one block per arrival, deflections one per pose and cycle, all targets
together. The blocks are kept stacked by size; nothing of size (readings)² exists. Noise that is
correlated along the order of the readings (`Readings.serial`) makes blocks of runs of them, up to
`RUN` measurements; the correlation across the ends of a run is neglected. Their S is Cholesky's
factor: the whitened rows of a measurement are its innovation, which earlier ones do not predict.

    none   G = I
    gu     G = diag(1/M_ik), M_ik the standard deviation of element k of measurement i
    gc     G = blockdiag(S_i⁻¹), V_i = S_i S_iᵀ
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from hilcal import limits
from hilcal.errors import InputError
from hilcal.readings.covariance import measurement_covariance, single_covariance
from hilcal.readings.readings import Readings, in_groups, numbered
from hilcal.robot import se3
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints

Group = tuple[Ints, Ints, Floats]  # measured (G, L), unloaded (G, U), weights (L, U)


def arrival_groups(readings: Readings) -> list[Group]:
    """Group the readings that share the scatter of an arrival; else each is alone."""
    count = len(readings)
    arrival = np.arange(count) if readings.common is None else readings.arrivals
    order, starts, sizes = in_groups(arrival)
    if len(starts) == count:
        order = np.arange(count)
    groups = []
    for size in np.unique(sizes):
        rows = order[starts[sizes == size][:, None] + np.arange(size)]
        limits.check_shared(int(size), readings.m, len(rows))
        none = np.empty((len(rows), 0), dtype=np.int64)
        groups.append((rows, none, np.zeros((size, 0))))
    return groups


def deflection_groups(readings: Readings) -> list[Group]:
    """Group loaded readings with the unloaded ones of their pose, cycle, target and observer.

    Targets that share the scatter of an arrival are in one group. A loaded reading whose target was
    not read unloaded in its pose and cycle makes no deflection.
    """
    if len(readings) and readings.unloaded.all():
        raise InputError("readings = deflection: there is no loaded reading; use absolute")
    if not (with_unloaded := has_unloaded(readings)).all():
        row = int(np.argmin(with_unloaded))
        name = readings.pose_names[readings.pose[row]]
        raise InputError(
            f"pose {name}, cycle {readings.cycle[row]}: no unloaded reading (load = none), which "
            "a deflection needs; measure it, or use --readings absolute"
        )
    rows = np.flatnonzero(has_unloaded(readings, readings.line))
    unloaded, target = readings.unloaded[rows], readings.line[rows]
    lines = [target] * (readings.common is None)
    group = numbered(readings.pose[rows], readings.cycle[rows], *lines)
    order, starts, sizes = in_groups(group, target, ~unloaded)
    count = np.add.reduceat(unloaded[order].astype(np.int64), starts)
    alike = np.zeros_like(starts)
    if readings.common is not None:
        kinds: dict[bytes, int] = {}
        for i, targets in enumerate(np.split(target[order], starts[1:])):
            alike[i] = kinds.setdefault(targets.tobytes(), len(kinds))
    shapes = np.stack([sizes, count, alike], axis=1)
    groups = []
    for shape in np.unique(shapes, axis=0):
        size, u = int(shape[0]), int(shape[1])
        if size == u:
            continue
        k = order[starts[np.all(shapes == shape, axis=1)][:, None] + np.arange(size)]
        limits.check_shared(size - u, readings.m, len(k))
        limits.check_numbers(f"{size - u} loaded times {u} unloaded readings", (size - u) * u)
        same = target[k[0, u:], None] == target[k[0, :u]]
        groups.append((rows[k[:, u:]], rows[k[:, :u]], same / same.sum(axis=1, keepdims=True)))
    if not groups:
        raise InputError(
            "readings = deflection: no target was read both loaded and unloaded in one pose and "
            "cycle; use absolute"
        )
    return groups


def runs(readings: Readings, groups: Sequence[Group], most: int) -> list[Group]:
    """Join whole groups to runs of about `most` measurements along `Readings.along`."""
    singles = [
        (loaded, reference, weights)
        for of_shape, references, weights in groups
        for loaded, reference in zip(of_shape, references, strict=True)
    ]
    t = np.arange(len(readings)) if readings.along is None else readings.along
    first = np.argsort([t[loaded].min() for loaded, _, _ in singles], kind="stable")
    sizes = np.cumsum([len(singles[k][0]) for k in first])
    count = -(-int(sizes[-1]) // most)
    run_of = (sizes - 1) * count // int(sizes[-1])
    joined = []
    for run in range(count):
        parts = [singles[k] for k in first[run_of == run]]
        if not parts:
            continue
        loaded = np.concatenate([p[0] for p in parts])
        order = np.argsort(t[loaded], kind="stable")
        weights = block_diag(*(p[2] for p in parts))[order]
        reference = np.concatenate([p[1] for p in parts])
        joined.append((loaded[order][None], reference[None], weights))
    return joined


def has_unloaded(readings: Readings, *also: Ints) -> Bools:
    """Return (N,) which readings have an unloaded one, or are one, in their pose and cycle.

    `also` are further numbers (N,) in which the two must agree.
    """
    group = numbered(readings.pose, readings.cycle, *also)
    group_has_unloaded = np.zeros(int(group.max()) + 1, dtype=bool)
    group_has_unloaded[group[readings.unloaded]] = True
    return np.asarray(group_has_unloaded[group])


Scaling = Literal["none", "gu", "gc"]
Mode = Literal["deflection", "absolute"]
SCALINGS: tuple[Scaling, ...] = ("none", "gu", "gc")
MODES: tuple[Mode, ...] = ("deflection", "absolute")
RANK_TOLERANCE = 1e-10
NUMBERS_AT_ONCE = 1_000_000  # numbers that are whitened in one step; a choice by memory
RUN = 200  # measurements in a run of correlated noise; a choice: of fewer all is exact


def whitening_matrix(covariance: Floats, scaling: Scaling = "gc") -> Floats:
    """Whitening matrices S⁻¹ (..., k, k) of covariances (..., k, k).

    For `gc`, V = D C D with D the standard deviations and C = U Λ Uᵀ the correlation matrix;
    S = D U Λ^½, so that S Sᵀ = V and S⁻¹ ε does not depend on the units of ε. (The
    eigenvectors of V itself would turn with the units; every S with S Sᵀ = V gives the same
    estimate.)

    Rule for rank-deficient V: an element of zero variance, or a direction whose eigenvalue
    of C is below 1e-10 of the largest, has no stated noise to weigh it by. It is left out:
    its row of S⁻¹ is zero, and does not count as a degree of freedom.
    """
    k = covariance.shape[-1]
    if scaling == "none":
        return np.broadcast_to(np.eye(k), covariance.shape)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    positive = variance > 0
    per_std = np.where(positive, 1.0, 0.0) / np.sqrt(np.where(positive, variance, 1.0))
    if scaling == "gu":
        return np.asarray(per_std[..., None] * np.eye(k))
    correlation = covariance * per_std[..., :, None] * per_std[..., None, :]
    values, vectors = np.linalg.eigh((correlation + np.swapaxes(correlation, -1, -2)) / 2)
    regular = values > RANK_TOLERANCE * values[..., -1:]
    per_root = np.where(regular, 1.0, 0.0) / np.sqrt(np.where(regular, values, 1.0))
    rows = per_root[..., :, None] * np.swapaxes(vectors, -1, -2)
    return np.asarray(rows * per_std[..., None, :])


@dataclass(frozen=True, slots=True, eq=False)
class Bucket:
    """G groups of one shape: L measurements each, and the U unloaded readings they share."""

    loaded: Ints  # (G, L) rows of the readings
    reference: Ints  # (G, U) rows of the unloaded readings; U = 0 for absolute readings
    factor: Floats  # (G, L·m, L·m) scaling matrices
    weights: Floats  # (L, U) of the unloaded ones in the mean to be subtracted

    def difference(self, x: Floats) -> Floats:
        """(G·L, ...) loaded minus the mean of the unloaded of x (N, ...)."""
        loaded = x[self.loaded]
        if self.reference.shape[1]:
            unloaded = x[self.reference]
            if np.all(self.weights == self.weights[:1]):  # the same mean for all
                loaded -= unloaded.mean(axis=1)[:, None]
            else:
                loaded -= np.einsum("lu,gu...->gl...", self.weights, unloaded)
        return loaded.reshape(self.loaded.size, *x.shape[1:])


@dataclass(frozen=True, slots=True, eq=False)
class Whitening(Brief):
    """The scaled regression: from readings to stacked whitened rows."""

    mode: Mode  # "absolute" or "deflection"
    scaling: Scaling  # "none", "gu" or "gc"
    m: int  # elements per reading
    buckets: tuple[Bucket, ...]  # groups by shape
    reading: Ints  # (D,) row of the reading behind each measurement, in the stacked order
    covariance: Floats  # (D, m, m) covariance of each measurement by itself
    group: Ints  # (D,) pose of each measurement
    rank: int  # number of whitened rows that carry information

    def __len__(self) -> int:
        return len(self.reading)

    def raw(self, x: Floats) -> Floats:
        """Measurements (D, m, ...) from values at the readings (N, m, ...)."""
        if self.mode == "absolute":
            alone = len(self.buckets) == 1 and self.buckets[0].loaded.shape[1] == 1
            return x if alone else x[self.reading]  # in their own order where none share an error
        return np.concatenate([b.difference(x) for b in self.buckets])

    def whiten(self, raw: Floats, overwrite: bool = False) -> Floats:
        """Whitened rows (D·m, ...) of measurements (D, m, ...); in their memory if `overwrite`."""
        flat = raw.reshape(len(raw) * self.m, math.prod(raw.shape[2:]))
        out = flat if overwrite else np.empty_like(flat)
        start = 0
        for b in self.buckets:
            groups, size = b.factor.shape[:2]
            at_once = max(1, NUMBERS_AT_ONCE // max(size * flat.shape[1], 1))
            for first in range(0, groups, at_once):
                factor = b.factor[first : first + at_once]
                rows = slice(start, start + len(factor) * size)
                block = flat[rows].reshape(len(factor), size, flat.shape[1])
                out[rows] = (factor @ block).reshape(len(factor) * size, flat.shape[1])
                start = rows.stop
        return out.reshape(len(flat), *raw.shape[2:])

    def whiten_readings(self, x: Floats, overwrite: bool = False) -> Floats:
        """Whitened rows (D·m, ...) of values at the readings (N, m, ...)."""
        return self.whiten(self.raw(x), overwrite)

    def rows_of(self, measurements: Ints) -> Ints:
        """Repeat a number per measurement (D,) for each of its rows (D·m,)."""
        return np.repeat(measurements, self.m)


def whitening(readings: Readings, mode: Mode, scaling: Scaling = "gc") -> Whitening:
    """Prepare the scaling of the readings in one mode."""
    if not len(readings):
        raise InputError("there are no readings to fit; measure or import some")
    v, m = readings.covariance, readings.m
    buckets = []
    rank = 0
    groups = (deflection_groups if mode == "deflection" else arrival_groups)(readings)
    serial = readings.serial is not None and scaling == "gc"
    for loaded, reference, weights in runs(readings, groups, RUN) if serial else groups:
        limits.check_shared(loaded.shape[1], m, len(loaded))
        covariance = measurement_covariance(readings, loaded, reference, weights)
        factor = _innovations(covariance) if serial else whitening_matrix(covariance, scaling)
        if scaling == "none" and readings.scalar.any():  # leaves out elements that are not read
            read = np.diagonal(covariance, axis1=1, axis2=2) > 0
            factor = factor * read[:, :, None]
        rank += int(np.count_nonzero(factor.any(axis=-1)))
        buckets.append(Bucket(loaded, reference, np.ascontiguousarray(factor), weights))
    reading = np.concatenate([b.loaded.ravel() for b in buckets])
    single = np.concatenate(
        [single_covariance(v, b.loaded, b.reference, b.weights).reshape(-1, m, m) for b in buckets]
    )
    pose = readings.pose[reading]
    return Whitening(mode, scaling, m, tuple(buckets), reading, single, pose, rank)


def _innovations(covariance: Floats) -> Floats:
    """S⁻¹ (1, k, k) of a run, S = D L, L Lᵀ = C + ε 1, ε = 1e-10 for a rank-deficient C."""
    std = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    positive = std > 0
    per_std = np.where(positive, 1.0, 0.0) / np.where(positive, std, 1.0)
    c = covariance * per_std[:, :, None] * per_std[:, None, :]
    c += np.where(positive, RANK_TOLERANCE, 1.0)[:, :, None] * np.eye(c.shape[1])
    lower = np.linalg.cholesky(c)[0]
    inverse = solve_triangular(lower, np.diag(per_std[0]), lower=True, check_finite=False)
    return np.asarray(inverse[None])


def measured_values(readings: Readings, w: Whitening) -> Floats:
    """Measurements (D, m): values, or deflections (rotation part: Log(R_l R_uᵀ))."""
    raw = w.raw(readings.value).copy()
    if w.m == 6 and w.mode == "deflection":
        raw[:, 3:] = relative_rotation(se3.rotation(readings.value[:, 3:]), w)
    return raw


def relative_rotation(r: Floats, w: Whitening) -> Floats:
    """Rotation vectors (D, 3) of the loaded against the mean unloaded attitudes."""
    out = []
    for b in w.buckets:
        turn = np.empty((*b.loaded.shape, 3))
        for weights in np.unique(b.weights, axis=0):
            alike = np.all(b.weights == weights, axis=1)
            reference = b.reference[:, weights > 0]
            first = r[reference[:, :1]]
            relative = se3.rotation_vector(r[reference] @ np.swapaxes(first, -1, -2))
            mean = se3.rotation(relative.mean(axis=1, keepdims=True)) @ first
            turn[:, alike] = se3.rotation_vector(r[b.loaded[:, alike]] @ np.swapaxes(mean, -1, -2))
        out.append(turn.reshape(-1, 3))
    return np.concatenate(out)


def covariance_blocks(readings: Readings, w: Whitening) -> list[Floats]:
    """Return the covariance (G, L·m, L·m) of the measurements of each bucket of a scaling."""
    return [measurement_covariance(readings, b.loaded, b.reference, b.weights) for b in w.buckets]


def usual_mode(readings: Readings, planned: Mode = "deflection") -> Mode:
    """Deflections, unless planned otherwise, where every loaded reading has an unloaded one."""
    if planned == "absolute" or readings.unloaded.all():
        return "absolute"
    return "deflection" if has_unloaded(readings).all() else "absolute"
