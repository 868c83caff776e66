"""Task-variable scaling: the one place where noise enters.

A scaling matrix G multiplies both sides of A c = ΔX so that the errors G ε become
independent, of unit spread, and pure numbers. G is block diagonal: one block per reading
(absolute) or per pose group (deflections of one pose share their unloaded reading). The
blocks are kept stacked by size; nothing of size (readings)² exists.

    none   G = I
    gu     G = diag(1/M_ik), M_ik the standard deviation of element k of measurement i
    gc     G = blockdiag(S_i⁻¹), V_i = S_i S_iᵀ
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.data.readings import Readings
from hilcal.errors import InputError
from hilcal.robot import se3
from hilcal.types import Floats, Ints

Scaling = Literal["none", "gu", "gc"]
Mode = Literal["deflection", "absolute"]
SCALINGS: tuple[Scaling, ...] = ("none", "gu", "gc")
MODES: tuple[Mode, ...] = ("deflection", "absolute")
RANK_TOLERANCE = 1e-10


def inverse_root(covariance: Floats, scaling: Scaling = "gc") -> Floats:
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
    seen = variance > 0
    per_std = np.where(seen, 1.0, 0.0) / np.sqrt(np.where(seen, variance, 1.0))
    if scaling == "gu":
        return np.asarray(per_std[..., None] * np.eye(k))
    correlation = covariance * per_std[..., :, None] * per_std[..., None, :]
    values, vectors = np.linalg.eigh((correlation + np.swapaxes(correlation, -1, -2)) / 2)
    kept = values > RANK_TOLERANCE * values[..., -1:]
    per_root = np.where(kept, 1.0, 0.0) / np.sqrt(np.where(kept, values, 1.0))
    rows = per_root[..., :, None] * np.swapaxes(vectors, -1, -2)
    return np.asarray(rows * per_std[..., None, :])


@dataclass(frozen=True, slots=True, eq=False)
class Bucket:
    """G groups of one shape: L loaded readings each, and the U unloaded ones they share.

    Attributes:
        loaded: (G, L) rows of the readings.
        reference: (G, U) rows of the unloaded readings; U = 0 for absolute readings.
        factor: (G, L·m, L·m) scaling matrices.
    """

    loaded: Ints
    reference: Ints
    factor: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Whitening:
    """The scaled regression: from readings to stacked whitened rows.

    Attributes:
        mode: "absolute" or "deflection".
        scaling: "none", "gu" or "gc".
        m: elements per reading.
        buckets: groups by shape.
        reading: (D,) row of the reading behind each measurement, in the stacked order.
        covariance: (D, m, m) covariance of each measurement by itself.
        group: (D,) pose of each measurement.
        rank: number of whitened rows that carry information.
    """

    mode: Mode
    scaling: Scaling
    m: int
    buckets: tuple[Bucket, ...]
    reading: Ints
    covariance: Floats
    group: Ints
    rank: int

    def __len__(self) -> int:
        """Return the number of measurements D (readings or deflections)."""
        return len(self.reading)

    def raw(self, x: Floats) -> Floats:
        """Measurements (D, m, ...) from values at the readings (N, m, ...)."""
        if self.mode == "absolute":
            return x
        parts = [_difference(b, x).reshape(b.loaded.size, *x.shape[1:]) for b in self.buckets]
        return np.concatenate(parts)

    def whiten(self, raw: Floats) -> Floats:
        """Whitened rows (D·m, P) of measurements (D, m) or (D, m, P)."""
        tail = raw.shape[2:]
        width = int(np.prod(tail))
        flat = raw.reshape(len(raw) * self.m, width)
        out = np.empty_like(flat)
        start = 0
        for b in self.buckets:
            groups, size = len(b.loaded), b.factor.shape[-1]
            stop = start + groups * size
            block = flat[start:stop].reshape(groups, size, width)
            np.matmul(b.factor, block, out=out[start:stop].reshape(groups, size, width))
            start = stop
        return out.reshape(len(out), *tail)

    def rows_of(self, measurements: Ints) -> Ints:
        """Repeat a number per measurement (D,) for each of its rows (D·m,)."""
        return np.repeat(measurements, self.m)


def whitening(readings: Readings, mode: Mode, scaling: Scaling = "gc") -> Whitening:
    """Prepare the scaling of the readings in one mode.

    Raises:
        InputError: where there are no readings; in deflection mode, where a pose has no
            unloaded reading or there is no loaded reading at all.
    """
    if not len(readings):
        raise InputError("there are no readings to fit; measure or import some")
    v, m = readings.covariance, readings.m
    buckets = []
    rank = 0
    for loaded, reference in _groups(readings, mode):
        covariance = _group_covariance(v, loaded, reference)
        factor = inverse_root(covariance, scaling)
        rank += int(np.count_nonzero(np.any(factor != 0, axis=-1)))
        buckets.append(Bucket(loaded, reference, np.ascontiguousarray(factor)))
    reading = np.concatenate([b.loaded.ravel() for b in buckets])
    own = np.concatenate(
        [
            (v[b.loaded] + _reference_covariance(v, b.reference)[:, None]).reshape(-1, m, m)
            for b in buckets
        ]
    )
    return Whitening(mode, scaling, m, tuple(buckets), reading, own, readings.pose[reading], rank)


def measured(readings: Readings, w: Whitening) -> Floats:
    """What was measured (D, m): values, or deflections (rotation part: Log(R_l R_uᵀ))."""
    raw = w.raw(readings.value).copy()
    if w.m == 6 and w.mode == "deflection":
        raw[:, 3:] = relative_rotation(se3.rotation(readings.value[:, 3:]), w)
    return raw


def relative_rotation(r: Floats, w: Whitening) -> Floats:
    """Rotation vectors (D, 3) of the loaded against the mean unloaded attitudes."""
    out = []
    for b in w.buckets:
        first = r[b.reference[:, :1]]
        apart = se3.rotation_vector(r[b.reference] @ np.swapaxes(first, -1, -2))
        mean = se3.rotation(apart.mean(axis=1, keepdims=True)) @ first
        out.append(se3.rotation_vector(r[b.loaded] @ np.swapaxes(mean, -1, -2)).reshape(-1, 3))
    return np.concatenate(out)


def _groups(readings: Readings, mode: Mode) -> list[tuple[Ints, Ints]]:
    """Rows of loaded and unloaded readings, groups of equal shape stacked."""
    count = len(readings)
    if mode == "absolute":
        return [(np.arange(count)[:, None], np.empty((count, 0), dtype=np.int64))]
    if count and readings.unloaded.all():
        raise InputError("readings = deflection: there is no loaded reading; use absolute")
    keys = np.stack([readings.pose, readings.cycle], axis=1)
    _, group = np.unique(keys, axis=0, return_inverse=True)
    group = group.reshape(-1)
    order = np.lexsort((~readings.unloaded, group))
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    ends = np.append(starts[1:], count)
    unloaded = np.add.reduceat(readings.unloaded[order].astype(np.int64), starts)
    sizes = ends - starts
    lacking = (unloaded == 0) & (sizes > 0)
    if lacking.any():
        row = order[starts[np.flatnonzero(lacking)[0]]]
        name = readings.pose_names[readings.pose[row]]
        raise InputError(
            f"pose {name}, cycle {readings.cycle[row]}: no unloaded reading (load = none), which "
            "a deflection needs; measure it, or use --readings absolute"
        )
    shapes = np.stack([sizes, unloaded], axis=1)
    found = []
    for size, u in np.unique(shapes, axis=0):
        if size == u:
            continue
        mine = starts[(shapes[:, 0] == size) & (shapes[:, 1] == u)]
        rows = order[mine[:, None] + np.arange(size)]
        found.append((rows[:, u:], rows[:, :u]))
    return found


def _difference(b: Bucket, x: Floats) -> Floats:
    """(G, L, ...) loaded minus the mean of the unloaded."""
    loaded = x[b.loaded]
    if b.reference.shape[1] == 0:
        return loaded
    return np.asarray(loaded - x[b.reference].mean(axis=1)[:, None])


def _reference_covariance(v: Floats, reference: Ints) -> Floats:
    """(G, m, m) covariance of the mean of the unloaded readings."""
    count = reference.shape[1]
    if count == 0:
        return np.zeros((len(reference), *v.shape[1:]))
    return np.asarray(v[reference].sum(axis=1) / count**2)


def _group_covariance(v: Floats, loaded: Ints, reference: Ints) -> Floats:
    """(G, L·m, L·m) covariance of the deflections of each group.

    Block (i, j) is δ_ij V_i + V_u: the unloaded reading's error is in all of them.
    """
    groups, count = loaded.shape
    m = v.shape[-1]
    shared = _reference_covariance(v, reference)
    out = np.broadcast_to(shared[:, None, :, None, :], (groups, count, m, count, m)).copy()
    each = np.arange(count)
    out[:, each, :, each, :] += np.moveaxis(v[loaded], 1, 0)
    return out.reshape(groups, count * m, count * m)


def usual_mode(readings: Readings) -> Mode:
    """Deflections where every loaded reading has an unloaded one in its pose and cycle."""
    unloaded = readings.unloaded
    if unloaded.all():
        return "absolute"
    key = np.stack([readings.pose, readings.cycle], axis=1)
    _, group = np.unique(key, axis=0, return_inverse=True)
    group = group.reshape(-1)
    has = np.zeros(int(group.max()) + 1, dtype=bool)
    has[group[unloaded]] = True
    return "deflection" if has[group[~unloaded]].all() else "absolute"
