"""Contrasts of repeated readings: what is left when all that the state explains is taken out.

Readings of one pose under one load are repeats. Whatever the model misses is equal in them,
so with W the whitening of the measurements (loaded readings share their unloaded one) and C
the columns that say which class of repeats a measurement is of,

    y = N Nᵀ W r,   Nᵀ W C = 0,   Nᵀ N = I     ⇒     Nᵀ y ~ N(0, f I)

with f the factor by which the stated covariance is wrong. What differs between repeats, the
side of approach, time, temperatures and small differences of the load, moves joints and target
to first order; those columns are taken out as well.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.identification.fit import Fit
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Bucket, Whitening, whitening
from hilcal.regression.connected import connected, groups_within
from hilcal.types import Floats, Ints

SAME_ANGLE = 1e-6
"""Commanded joints of repeats agree within this, rad."""
SAME_LOAD = 0.05
"""Wrenches of repeats agree within this share of the campaign's largest."""
ROUNDING = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class RepeatGroup:
    """Repeats that share something.

    Attributes:
        rows: (r,) whitened rows.
        explained: (r, k) orthonormal columns of what their classes explain; their contrasts are
            what is orthogonal to these, and of no basis, which would have r numbers for each.
    """

    rows: Ints
    explained: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Contrasts:
    """All contrasts of a fit's repeats, each as its whitened rows.

    Attributes:
        readings: the fitted readings, repeats with their mean covariance.
        whitening: of those.
        blocks: by shared class.
        y: (r,) the part of the residual in the contrasts, free of nuisance, of all blocks' rows.
        nuisance: (r, k) orthonormal, the part in them of what differed between repeats.
        bias: factor by which estimated covariances make ‖y‖² too large.
        moves: (N, m, n) motion of each reading by each joint, sensor axes.
    """

    readings: Readings
    whitening: Whitening
    blocks: tuple[RepeatGroup, ...]
    y: Floats
    nuisance: Floats
    bias: float
    moves: Floats

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        explained = sum(b.explained.shape[1] for b in self.blocks)
        return int(len(self.y) - explained - self.nuisance.shape[1])

    def free(self, x: Floats) -> Floats:
        """Return the part of rows (r, ...) in the contrasts, free of nuisance."""
        x = _unexplained(self.blocks, x)
        return np.asarray(x - self.nuisance @ (self.nuisance.T @ x))

    def slopes(self, x: Floats) -> Floats:
        """(N, m, S) derivative of ½‖y‖² by a change of each reading, rows x (r, S)."""
        w, m, width = self.whitening, self.whitening.m, x.shape[1]
        white = np.zeros((len(w) * m, width))
        white[np.concatenate([b.rows for b in self.blocks])] = x
        out = np.zeros((len(self.readings), m, width))
        start = 0
        for b in w.buckets:
            stop = start + b.loaded.size * m
            own = white[start:stop].reshape(len(b.loaded), -1, width)
            back = (np.swapaxes(b.factor, 1, 2) @ own).reshape(*b.loaded.shape, m, width)
            out[b.loaded] = back
            if b.reference.shape[1]:
                out[b.reference] = -np.einsum("lu,glms->gums", b.weights, back)
            start = stop
        return out


def classes(readings: Readings) -> Ints:
    """(N,) class of each reading: same joints, same load by name and wrench, same target."""
    s = readings.states
    size = np.repeat(
        [
            np.linalg.norm(s.wrench[:, part], axis=1).max(initial=0.0)
            for part in (slice(3), slice(3, 6))
        ],
        3,
    )
    wrench = s.wrench / np.where(size > 0, SAME_LOAD * size, 1.0)
    named = 10.0 * np.stack([readings.load, readings.target], axis=1)
    points = np.concatenate([s.q / SAME_ANGLE, wrench, named], axis=1)
    return groups_within(points, 1.0)


def contrasts(fit: Fit) -> Contrasts | None:
    """Contrasts of the repeats of a fit; None where nothing was repeated."""
    kept = fit.readings[~fit.outlier]
    kind = classes(kept)
    if len(np.unique(kind)) == len(kind):
        return None
    readings, bias = _pooled(kept, kind)
    w = whitening(readings, fit.mode, "gc")
    blocks = _blocks(w, kind)
    if not blocks:
        return None
    solution = fit.solution
    moves = motion(
        fit.model.cell,
        solution.prediction.observation,
        solution.prediction.situation.chain,
        solution.prediction.deviation,
        w.m,
    ).drives
    rows = np.concatenate([b.rows for b in blocks])
    y = _unexplained(blocks, w.whiten(fit.raw).reshape(-1)[rows])
    other = w.whiten(w.raw(_differences(fit, readings, kind, moves)))[rows]
    nuisance = _orthonormal(_unexplained(blocks, other))
    return Contrasts(readings, w, blocks, y - nuisance @ (nuisance.T @ y), nuisance, bias, moves)


def _pooled(readings: Readings, kind: Ints) -> tuple[Readings, float]:
    """Give repeats their mean covariance; and the bias that is left where it was estimated.

    Variances estimated from ν degrees of freedom scatter by 2/ν in their logarithm, which the
    repeats show, and E[V̂⁻¹] = V⁻¹ ν/(ν − m − 1).
    """
    v, m = readings.covariance, readings.m
    count = np.bincount(kind)
    mean = np.zeros((len(count), m, m))
    np.add.at(mean, kind, v)
    mean /= count[:, None, None]
    variance = np.maximum(np.diagonal(v, axis1=1, axis2=2), 1e-300)
    spread = np.log(variance)
    centre = np.zeros((len(count), m))
    np.add.at(centre, kind, spread)
    spread = spread - (centre / count[:, None])[kind]
    per = float(np.sum(spread**2)) / (m * max(int(np.sum(count - 1)), 1))
    repeats = float(np.sum(count[count > 1])) / max(int(np.sum(count > 1)), 1)
    off = min(per / 2 * (m + 1) / repeats, 0.5)
    return replace(readings, covariance=mean[kind]), 1.0 / (1.0 - off)


def _blocks(w: Whitening, kind: Ints) -> tuple[RepeatGroup, ...]:
    """Contrasts by groups of measurements that have classes in common."""
    m = w.m
    # Class of a measurement: of its loaded reading, and of the unloaded ones it is taken from.
    label = []
    groups: list[Group] = []
    first = 0
    for b in w.buckets:
        of = kind[b.loaded]
        if b.reference.shape[1]:
            of_reference, apart = kind[b.reference][:, None, :], b.weights == 0
            low = np.where(apart, len(kind), of_reference).min(axis=2)
            high = np.where(apart, -1, of_reference).max(axis=2)
            ends = np.stack([low, high], axis=2)
        else:
            ends = np.zeros((*of.shape, 2), dtype=of.dtype)
        label.append(np.concatenate([of[:, :, None], ends], axis=2).reshape(-1, 3))
        size = b.loaded.shape[1]
        for g in range(len(b.loaded)):
            groups.append((first + g * size + np.arange(size), b, g))
        first += b.loaded.size
    number = np.unique(np.concatenate(label), axis=0, return_inverse=True)[1].reshape(-1)
    owner = np.repeat(np.arange(len(groups)), [len(rows) for rows, _, _ in groups])
    # Groups are joined where they share a class of measurements or, through an unloaded
    # reading of several groups, an error; the latter does not occur (see `whitening`).
    total = len(groups) + int(number.max()) + 1
    joined = connected(owner, len(groups) + number, total)[: len(groups)]
    out = []
    for rows in np.split(
        np.argsort(joined, kind="stable"), np.flatnonzero(np.diff(np.sort(joined))) + 1
    ):
        found = _block([groups[k] for k in rows], number, m)
        if found is not None:
            out.append(found)
    return tuple(out)


Group = tuple[Ints, Bucket, int]
"""Rows of the measurements, and their bucket and place in it."""


def _block(groups: list[Group], number: Ints, m: int) -> RepeatGroup | None:
    measured = np.concatenate([rows for rows, _, _ in groups])
    column = np.unique(number[measured], return_inverse=True)[1].reshape(-1)
    if column.max() + 1 == len(measured):
        return None
    # What each class explains: the whitened columns of its measurements, added.
    member = np.zeros((len(measured) * m, int(column.max()) + 1, m))
    at = 0
    for rows, b, g in groups:
        span = slice(at * m, (at + len(rows)) * m)
        for k, each in enumerate(np.split(b.factor[g], len(rows), axis=1)):
            member[span, column[at + k]] += each
        at += len(rows)
    rows = (measured[:, None] * m + np.arange(m)).reshape(-1)
    seen = np.concatenate([np.any(b.factor[g] != 0, axis=1) for _, b, g in groups])
    u, s, _ = np.linalg.svd(member.reshape(len(member), -1)[seen], full_matrices=False)
    rank = int(np.sum(s > ROUNDING * s.max(initial=0.0)))
    return None if rank == len(u) else RepeatGroup(rows[seen], u[:, :rank])


def _unexplained(blocks: tuple[RepeatGroup, ...], x: Floats) -> Floats:
    """Return rows (r, ...) of all blocks less what the classes explain."""
    out, at = x.copy(), 0
    for b in blocks:
        own = out[at : at + len(b.rows)]
        own -= b.explained @ (b.explained.T @ own)
        at += len(b.rows)
    return out


def _differences(fit: Fit, readings: Readings, kind: Ints, moves: Floats) -> Floats:
    """(N, m, P) motions by what differs between repeats, first order; 1 mrad or 1 mm each."""
    s, situation = readings.states, fit.solution.prediction.situation
    count = np.maximum(np.bincount(kind), 1)
    axes = np.zeros((*moves.shape[:2], 3))
    axes[:, :3] = fit.solution.prediction.observation.axes
    both = 1e-3 * np.concatenate([moves, axes], axis=2)
    joint = 1e-3 * moves
    out = []

    def add(motions: Floats, values: Floats) -> None:
        mean = np.zeros((len(count), values.shape[1]))
        np.add.at(mean, kind, values)
        away = values - (mean / count[:, None])[kind]
        size = np.abs(away).max(axis=0)
        away = np.where(
            size > 1e-6 * np.abs(values).max(axis=0), away / np.where(size > 0, size, 1), 0
        )
        out.append(motions * away[:, None, :])

    n = moves.shape[2]
    add(joint, situation.torque)
    for wide in (s.approach, s.joint_temperature):
        if wide is not None:
            add(joint, wide)
    for values, motions in ((s.time, both), (s.air_temperature, both), (s.load_time, joint)):
        if values is not None:
            factor = situation.torque if motions is joint else np.ones((len(values), n + 3))
            add(motions, factor * values[:, None])
    found = np.concatenate(out, axis=2)
    return found[:, :, np.any(found, axis=(0, 1))]


def _orthonormal(x: Floats) -> Floats:
    """Orthonormal basis of the visible columns of x (c, P)."""
    if x.shape[1] == 0:
        return np.zeros((len(x), 0))
    u, s, _ = np.linalg.svd(x, full_matrices=False)
    return np.asarray(u[:, s > 1e-2])
