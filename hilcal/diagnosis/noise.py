"""Whether the stated noise is right: the scatter of repeats, where it is wrong, whose fault it is.

Readings of one pose under one load are repeats. Whatever the model misses is equal in them, so with
W the whitening of the measurements (loaded readings share their unloaded one) and C the columns
that say which class of repeats a measurement is of, the contrasts

    y = N Nᵀ W r,   Nᵀ W C = 0,   Nᵀ N = I     ⇒     Nᵀ y ~ N(0, f I),    f = ‖y‖² / dim y

show f, the factor by which the stated covariance is wrong (pure error); the rest of χ² is lack of
fit. What differs between repeats, the side of approach, time, temperatures and small differences of
the load, moves joints and target to first order; those columns are taken out as well.

A direction d_k of each reading k (along the beam, the motion by joint j, all elements of the
readings under one load) may scatter more or less than stated. With g_k the derivative of ½‖y‖² by
reading k,

    T = Σ_k ‖d_kᵀ g_k‖²,     score statistic T / ‖y‖²

which does not depend on a common factor. Its null distribution, and that of T for the factor in
this direction T / E[T], come from simulated contrasts, the same for all directions.

An effect is judged against the scatter as it is (F-tests), so a noise that is misjudged as a whole
names none. What remains is a χ² that is too large or too small:

- too small: no model makes residuals smaller than the noise; the statement is too large;
- too large, and repeats scatter as much: the statement is too small;
- too large, and repeats scatter less: the model misses something;
- too large, without enough repeats: the noise only where nothing at all predicts the residual;
  it cannot be known without repeats.
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.identification.fit import Fit
from hilcal.identification.residual import variance_interval
from hilcal.model.observe import motion
from hilcal.readings.readings import ArmScatter, Readings
from hilcal.readings.whitening import Bucket, Whitening, whitening
from hilcal.regression.connected import connected, groups_within
from hilcal.robot.arm import Arm
from hilcal.types import Floats, Ints

SAME_ANGLE = 1e-6  # commanded joints of repeats agree within this, rad
SAME_LOAD = 0.05  # wrenches of repeats agree within this share of the campaign's largest
ROUNDING = 1e-9
DRAWS = 600
AT_ONCE = 1 << 22  # numbers that are drawn at a time, 32 MB; a choice
CERTAIN = 0.003  # chance of naming any direction where the factor is the same in all of them
FEWEST_ALONG = 8.0  # degrees of freedom that a direction must have to be judged
FEWEST = 10  # degrees of freedom of pure error below which it is not used; a guess
MISFIT_ALARM = 0.0005
"""Chance of calling the variance factor wrong where it is right, each side."""
PREDICTABLE = 0.1
"""Share s of the misfit that must be predictable for the model to be to blame. The predictable part
is then a third of the rest in standard deviation, s / (1 - s) = 1/9: a standard uncertainty of less
than a third of the largest one need not be evaluated in detail (Eurachem/CITAC Guide CG 4,
*Quantifying uncertainty in analytical measurement*, 3rd ed. 2012)."""
RP_PER_RMS = 2.09
"""Pose repeatability RP = mean + 3 S of the distances from their centre (ISO 9283, 7.2.2), in units
of their rms, for an isotropic normal scatter."""
INDUSTRIAL = 1e-4
"""RP of industrial arms reaches from 0.02 to 0.1 mm in their data sheets; this where an arm's own
is not known, m."""
ELSEWHERE = 3.0
"""How many times RP an arm may scatter in a campaign; a choice. RP is measured warm, at five poses
in one cube, each approached from one side; a campaign goes everywhere, from all sides."""

Kind = Literal["axis", "joint", "load"]
NoiseReason = Literal["as_stated", "repeats", "too_large", "lack_of_fit", "predictable", "unknown"]
"""Why the noise is, or is not, to blame:

- as_stated: χ² is what chance allows;
- repeats: repeated readings scatter as much, or as little, as the residuals;
- too_large: the residuals are smaller than stated;
- lack_of_fit: repeated readings scatter less than the residuals;
- predictable: something predicts the residual on poses left out;
- unknown: nothing predicts it, and there are too few repeats to know.
"""


@dataclass(frozen=True, slots=True)
class NoiseWhere:
    """A direction in which the noise is not as stated."""

    kind: Kind  # "axis" of the instrument, motion by a "joint", or "load"
    name: str  # e.g. "along the beam", "joint 2", "10kg"
    factor: float  # variance factor in this direction, against the stated covariance
    interval: tuple[float, float]  # its 95 % confidence interval
    p_value: float  # that it differs from the others by chance, all directions counted


@dataclass(frozen=True, slots=True)
class PureError:
    """The scatter of repeats."""

    factor: float  # variance factor of the repeats, against the stated covariance
    interval: tuple[float, float]  # its 95 % confidence interval
    dof: int  # its degrees of freedom
    lack_of_fit_p: float  # p-value of what remains, against pure error
    where: NoiseWhere | None = None  # None where the covariance is everywhere as wrong, or right


@dataclass(frozen=True, slots=True)
class NoiseVerdict:
    """Whether the stated covariance is to blame for a variance factor."""

    reason: NoiseReason

    @property
    def misjudged(self) -> bool:
        """Whether the stated noise is to blame."""
        return self.reason in ("repeats", "too_large", "unknown")

    @property
    def off(self) -> bool:
        """Whether the variance factor is not what chance allows."""
        return self.reason != "as_stated"


def judge_noise(fit: Fit, repeats: PureError | None, predictable: bool) -> NoiseVerdict:
    """Judge the noise where no effect is missing; whether anything predicts the residual counts."""
    high = float(chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM
    low = float(chi2.cdf(fit.chi2, fit.dof)) < MISFIT_ALARM
    if not high and not low:
        return NoiseVerdict("as_stated")
    differ = repeats is not None and not repeats.interval[0] <= 1 <= repeats.interval[1]
    lacking = repeats is not None and repeats.lack_of_fit_p <= MISFIT_ALARM
    if differ and (low or not lacking):
        return NoiseVerdict("repeats")
    if low:
        return NoiseVerdict("too_large")
    if lacking:
        return NoiseVerdict("lack_of_fit")
    return NoiseVerdict("predictable" if predictable else "unknown")


def stated_repeatability(arm: Arm) -> float:
    """Return RP as the arm's maker states it, else that of industrial arms, m."""
    return INDUSTRIAL if arm.repeatability is None else arm.repeatability


def of_repeatability_size(scatter: ArmScatter, arm: Arm) -> bool:
    """Whether an arm like this may scatter so much."""
    return RP_PER_RMS * scatter.size_m <= ELSEWHERE * stated_repeatability(arm)


def instrument_instead(scatter: ArmScatter) -> bool:
    """Whether the readings prefer an instrument that is noisier than stated, beyond doubt."""
    return scatter.log_evidence < -SAME_EVIDENCE


def separated(scatter: ArmScatter) -> bool:
    """Whether the readings tell the arm's scatter from a noisier instrument."""
    return abs(scatter.log_evidence) > SAME_EVIDENCE


def pure_error(fit: Fit) -> PureError | None:
    """Compare repeats; None where there are too few."""
    c = contrasts(fit)
    if c is None or c.dof < FEWEST:
        return None
    total = float(c.y @ c.y) / c.bias
    rest = max(float(np.sum(c.whitening.whiten(fit.raw) ** 2)) / c.bias - total, 0.0)
    rest_dof, p = fit.dof - c.dof, 1.0
    if rest_dof > 0 and total > 0:
        p = float(f_distribution.sf((rest / rest_dof) / (total / c.dof), rest_dof, c.dof))
    off = [v for v in every_direction(fit, c) if v.p_value < CERTAIN and _agrees(v, c)]
    where = min(off, key=lambda v: v.p_value, default=None)
    return PureError(total / c.dof, variance_interval(total, c.dof), c.dof, p, where)


@dataclass(frozen=True, slots=True, eq=False)
class RepeatGroup:
    """Repeats that share something.

    Their contrasts are what is orthogonal to `explained`, and of no basis, which would have r
    numbers for each.
    """

    rows: Ints  # (r,) whitened rows
    explained: Floats  # (r, k) orthonormal columns of what their classes explain


@dataclass(frozen=True, slots=True, eq=False)
class Contrasts:
    """All contrasts of a fit's repeats, each as its whitened rows."""

    readings: Readings  # the fitted readings, repeats with their mean covariance
    whitening: Whitening  # of those
    blocks: tuple[RepeatGroup, ...]  # by shared class
    y: Floats  # (r,) the part of the residual in the contrasts, free of nuisance
    nuisance: Floats  # (r, k) orthonormal, the part in them of what differed between repeats
    bias: float  # factor by which estimated covariances make ‖y‖² too large
    moves: Floats  # (N, m, n) motion of each reading by each joint, sensor axes

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
    parts = s.wrench[:, :3], s.wrench[:, 3:]
    size = np.repeat([np.linalg.norm(part, axis=1).max(initial=0.0) for part in parts], 3)
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
    p = fit.solution.prediction
    chain = p.situation.chain
    moves = motion(fit.model.cell, p.observation, chain, p.deviation, w.m).drives
    rows = np.concatenate([b.rows for b in blocks])
    y = _unexplained(blocks, w.whiten(fit.raw).reshape(-1)[rows])
    other = w.whiten(w.raw(_differences(fit, readings, kind, moves)))[rows]
    u, s, _ = np.linalg.svd(_unexplained(blocks, other), full_matrices=False)
    nuisance = u[:, s > 1e-2]
    return Contrasts(readings, w, blocks, y - nuisance @ (nuisance.T @ y), nuisance, bias, moves)


def _class_mean(values: Floats, kind: Ints) -> Floats:
    """(N, ...) mean over the class of each reading, of values (N, ...)."""
    mean = np.zeros((int(kind.max()) + 1, *values.shape[1:]))
    np.add.at(mean, kind, values)
    count = np.maximum(np.bincount(kind), 1)
    return np.asarray((mean.T / count).T[kind])


def _pooled(readings: Readings, kind: Ints) -> tuple[Readings, float]:
    """Give repeats their mean covariance; and the bias that is left where it was estimated.

    Variances estimated from ν degrees of freedom scatter by 2/ν in their logarithm, which the
    repeats show, and E[V̂⁻¹] = V⁻¹ ν/(ν − m − 1).
    """
    v, m, count = readings.covariance, readings.m, np.bincount(kind)
    spread = np.log(np.maximum(np.diagonal(v, axis1=1, axis2=2), 1e-300))
    spread = spread - _class_mean(spread, kind)
    per = float(np.sum(spread**2)) / (m * max(int(np.sum(count - 1)), 1))
    repeats = float(np.sum(count[count > 1])) / max(int(np.sum(count > 1)), 1)
    off = min(per / 2 * (m + 1) / repeats, 0.5)
    return replace(readings, covariance=_class_mean(v, kind)), 1.0 / (1.0 - off)


Group = tuple[Ints, Bucket, int]
"""Rows of the measurements, and their bucket and place in it."""


def _blocks(w: Whitening, kind: Ints) -> tuple[RepeatGroup, ...]:
    """Contrasts by groups of measurements that have classes in common."""
    # Class of a measurement: of its loaded reading, and of the unloaded ones it is taken from.
    label = []
    groups: list[Group] = []
    first = 0
    for b in w.buckets:
        of = kind[b.loaded]
        ends = np.zeros((*of.shape, 2), dtype=of.dtype)
        if b.reference.shape[1]:
            of_reference, apart = kind[b.reference][:, None, :], b.weights == 0
            ends[:, :, 0] = np.where(apart, len(kind), of_reference).min(axis=2)
            ends[:, :, 1] = np.where(apart, -1, of_reference).max(axis=2)
        label.append(np.concatenate([of[:, :, None], ends], axis=2).reshape(-1, 3))
        size = b.loaded.shape[1]
        groups += [(first + g * size + np.arange(size), b, g) for g in range(len(b.loaded))]
        first += b.loaded.size
    number = np.unique(np.concatenate(label), axis=0, return_inverse=True)[1].reshape(-1)
    owner = np.repeat(np.arange(len(groups)), [len(rows) for rows, _, _ in groups])
    # Groups are joined where they share a class of measurements or, through an unloaded
    # reading of several groups, an error; the latter does not occur (see `whitening`).
    total = len(groups) + int(number.max()) + 1
    joined = connected(owner, len(groups) + number, total)[: len(groups)]
    ends = np.flatnonzero(np.diff(np.sort(joined))) + 1
    parts = np.split(np.argsort(joined, kind="stable"), ends)
    found = (_block([groups[k] for k in rows], number, w.m) for rows in parts)
    return tuple(block for block in found if block is not None)


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
    s, torque = readings.states, fit.solution.prediction.situation.torque
    axes = np.zeros((*moves.shape[:2], 3))
    axes[:, :3] = fit.solution.prediction.observation.axes
    joint, both = 1e-3 * moves, 1e-3 * np.concatenate([moves, axes], axis=2)
    out = []

    def add(motions: Floats, values: Floats) -> None:
        away = values - _class_mean(values, kind)
        size = np.abs(away).max(axis=0)
        differ = size > 1e-6 * np.abs(values).max(axis=0)
        away = np.where(differ, away / np.where(size > 0, size, 1), 0)
        out.append(motions * away[:, None, :])

    add(joint, torque)
    for wide in (s.approach, s.joint_temperature):
        if wide is not None:
            add(joint, wide)
    for values in (s.time, s.air_temperature):
        if values is not None:
            add(both, np.tile(values[:, None], both.shape[2]))
    if s.load_time is not None:
        add(joint, torque * s.load_time[:, None])
    found = np.concatenate(out, axis=2)
    return found[:, :, np.any(found, axis=(0, 1))]


def every_direction(fit: Fit, c: Contrasts) -> list[NoiseWhere]:
    """Judge all directions; p-values count all of them."""
    directions = _directions(fit, c)
    rng = np.random.default_rng(20250301)
    rows = [np.flatnonzero(np.any(d != 0, axis=(1, 2))) for _, _, d in directions]
    square, size = np.zeros(1 + DRAWS), np.zeros((len(directions), 1 + DRAWS))
    at_once = max(AT_ONCE // len(c.y), 1)
    for start in range(0, 1 + DRAWS, at_once):
        some = slice(start, min(start + at_once, 1 + DRAWS))
        drawn = c.free(rng.standard_normal((len(c.y), some.stop - some.start)))
        if start == 0:
            drawn[:, 0] = c.y
        square[some], slopes = np.sum(drawn**2, axis=0), c.slopes(drawn)
        for k, (_, _, d) in enumerate(directions):
            along = np.einsum("kir,kis->krs", d[rows[k]], slopes[rows[k]])
            size[k, some] = np.sum(along**2, axis=(0, 1))
    if not square.all():  # repeats that are equal to the last digit tell no direction from another
        return []
    out = []
    for (kind, name, _), t in zip(directions, size, strict=True):
        mean, spread = float(t[1:].mean()), float(t[1:].std())
        dof = 2 * (mean / spread) ** 2 if mean > 0 else 0.0
        if dof >= FEWEST_ALONG:
            factor = float(t[0]) / mean / c.bias
            low, high = (factor * dof / float(chi2.isf(q, dof)) for q in (0.025, 0.975))
            out.append(NoiseWhere(kind, name, factor, (low, high), _p(t / square)))
    return [replace(v, p_value=min(v.p_value * len(out), 1.0)) for v in out]


def _agrees(v: NoiseWhere, c: Contrasts) -> bool:
    """Whether the direction itself is off, not only the others about it."""
    overall = float(c.y @ c.y) / c.dof / c.bias
    away = abs(np.log(max(v.factor, 1e-300)))
    return bool((v.factor > overall) == (v.factor > 1) and away > abs(np.log(max(overall, 1e-300))))


def _p(ratio: Floats) -> float:
    """Two-sided p-value of the first of these ratios among the drawn others.

    The cube root of a sum of squares is nearly normal (Wilson and Hilferty, Proc. Natl. Acad.
    Sci. 17 (1931) 684-688); what skewness is left is taken from the draws.
    """
    root = np.cbrt(ratio)
    mean, spread = float(root[1:].mean()), float(root[1:].std())
    if spread <= 1e-9 * mean:
        return 1.0
    skew = float(np.mean(((root[1:] - mean) / spread) ** 3))
    z = (float(root[0]) - mean) / spread
    from scipy.stats import pearson3  # slow to import

    return float(min(2 * min(pearson3.sf(z, skew), pearson3.cdf(z, skew)), 1.0))


def _directions(fit: Fit, c: Contrasts) -> list[tuple[Kind, str, Floats]]:
    """Kind, name and (N, m, r) directions of each reading."""
    readings, m = c.readings, c.whitening.m
    v = readings.covariance
    out: list[tuple[Kind, str, Floats]] = []
    for name, unit in _axes(fit):
        d = np.zeros((len(readings), m, 1))
        d[:, :3, 0] = unit * np.sqrt(np.einsum("ki,kij,kj->k", unit, v[:, :3, :3], unit))[:, None]
        out.append(("axis", name, d))
    values, vectors = np.linalg.eigh(v)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    if m == 6:
        turned = np.zeros_like(root)
        turned[:, 3:] = root[:, 3:]
        out.append(("axis", "orientation", turned))
    out += [("joint", f"joint {j + 1}", c.moves[:, :, [j]]) for j in range(c.moves.shape[2])]
    loads = np.unique(readings.load)
    if len(loads) > 1:
        for load in loads:
            name = readings.load_names[load]
            mine = (readings.load == load)[:, None, None]
            out.append(("load", "unloaded" if name == "none" else name, root * mine))
        if len(loads) > 2 and readings.unloaded.any():
            out.append(("load", "any load", root * ~readings.unloaded[:, None, None]))
    return out


def _axes(fit: Fit) -> list[tuple[str, Floats]]:
    """Axes (N, 3) of the instrument: of the beam where the station is the sensor's origin."""
    cell, o = fit.model.cell, fit.solution.prediction.observation
    if cell.registration_known and np.array_equal(cell.registration, np.eye(4)):
        count = len(o.position)
        return [(f"sensor {n}", np.tile(np.eye(3)[i], (count, 1))) for i, n in enumerate("xyz")]
    beam = o.position / np.maximum(np.linalg.norm(o.position, axis=1), 1e-300)[:, None]
    gravity = cell.gravity if np.any(cell.gravity) else np.array([0.0, 0.0, -1.0])
    up = -np.einsum("kij,j->ki", o.axes, gravity)
    level = np.cross(up, beam)
    size = np.linalg.norm(level, axis=1)
    flat = size > 1e-6 * np.linalg.norm(up, axis=1)
    level = np.where(flat[:, None], level / np.where(flat, size, 1.0)[:, None], [[1.0, 0.0, 0.0]])
    return [
        ("along the beam", beam),
        ("across the beam, level", level),
        ("across the beam, upright", np.cross(beam, level)),
    ]
