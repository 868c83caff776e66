"""Whether the stated noise is right: the scatter of repeats, and the directions where it is wrong.

Readings of one pose under one load are repeats. A misfit of the model is equal in them. With W the
whitening of the measurements (loaded readings share their unloaded one) and C the indicator columns
of the classes of repeats, the contrasts

    y = N Nᵀ W r,   Nᵀ W C = 0,   Nᵀ N = I     ⇒     Nᵀ y ~ N(0, f I),    f = ‖y‖² / dim y

show f, the factor by which the stated covariance is wrong (pure error); the rest of χ² is lack of
fit. Differences between repeats, in the side of approach, time, temperatures and slightly in the
load, move joints and target to first order; those columns are projected out as well.

A direction d_k of each reading k (along the beam, the motion by joint j, all elements of the
readings under one load) may scatter more or less than stated. With g_k the derivative of ½‖y‖² by
reading k,

    T = Σ_k ‖d_kᵀ g_k‖²,     score statistic T / ‖y‖²

which does not depend on a common factor. Its null distribution, and that of T for the factor
T / E[T] of the direction, come from simulated contrasts, the same for all directions.

Effects are judged against the actual scatter (F-tests), so a wrong overall size of the noise names
no effect, but makes χ² too large or too small. If it is too small, the stated noise is too large,
since no model makes residuals smaller than the noise. If it is too large, and repeats scatter as
much, the stated noise is too small; if they scatter less, the model misses something; with too few
repeats the noise is blamed only where nothing predicts the residual (see `NoiseReason`).
"""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import scipy

from hilcal.diagnosis.effect_ranking import SAME_EVIDENCE
from hilcal.identification.fit import Fit
from hilcal.identification.folds import connected_groups, groups_within
from hilcal.identification.residual import variance_interval
from hilcal.model.observe import motion
from hilcal.readings.readings import ArmScatter, Readings
from hilcal.readings.whitening import Bucket, Whitening, whitening
from hilcal.robot.arm import Arm
from hilcal.store.codec import encode
from hilcal.types import Floats, Ints

SAME_ANGLE = 1e-6  # commanded joints of repeats agree within this, rad
SAME_LOAD = 0.05  # wrenches of repeats agree within this share of the campaign's largest
ROUNDING = 1e-9
DRAWS = 600
DRAWN_AT_ONCE = 1 << 22  # numbers that are drawn at a time, 32 MB; a choice
FALSE_ALARM = 0.003  # probability of naming a direction where all have the same factor
FEWEST_DOF_OF_DIRECTION = 8.0  # least degrees of freedom of a direction that is judged
FEWEST_DOF = 10  # degrees of freedom below which pure error is not used; a guess
MISFIT_ALARM = 0.0005
"""Probability of calling a right variance factor wrong, on each side."""
PREDICTABLE = 0.1
"""Share s of the misfit that must be predictable for the model to be to blame. The standard
deviation of the predictable part is then a third of the remainder's, s / (1 - s) = 1/9: a standard
uncertainty of less than a third of the largest one need not be evaluated in detail (Eurachem/CITAC
Guide CG 4, *Quantifying uncertainty in analytical measurement*, 3rd ed. 2012)."""
RP_PER_RMS = 2.09
"""Pose repeatability RP = mean + 3 S of the distances from their centre (ISO 9283, 7.2.2), in units
of their rms, for an isotropic normal scatter."""
USUAL_REPEATABILITY_M = 1e-4
"""RP of an arm whose data sheet is not known, m: data sheets state 0.02 to 0.1 mm."""
MOST_SCATTER = 3.0
"""Most scatter of an arm in a campaign, in units of RP; a choice. RP is measured warm, at five
poses in one cube, each approached from one side; a campaign uses all poses and sides."""

Kind = Literal["axis", "joint", "load"]
NoiseReason = Literal["as_stated", "repeats", "too_large", "lack_of_fit", "predictable", "unknown"]
"""Why the noise is, or is not, to blame:

- as_stated: χ² agrees with the stated noise;
- repeats: repeated readings scatter as much, or as little, as the residuals;
- too_large: the residuals are smaller than stated;
- lack_of_fit: repeated readings scatter less than the residuals;
- predictable: something predicts the residual on poses left out;
- unknown: nothing predicts the residual, and there are too few repeats.
"""


@dataclass(frozen=True, slots=True)
class NoiseWhere:
    """A direction in which the noise is not as stated."""

    kind: Kind  # "axis" of the instrument, motion by a "joint", or "load"
    name: str  # e.g. "along the beam", "joint 2", "10kg"
    factor: float  # variance factor in this direction, against the stated covariance
    interval: tuple[float, float]  # its 95 % confidence interval
    p_value: float  # of the same factor in all directions, corrected for their number


@dataclass(frozen=True, slots=True)
class PureError:
    """The scatter of repeats."""

    factor: float  # variance factor of the repeats, against the stated covariance
    interval: tuple[float, float]  # its 95 % confidence interval
    dof: int  # its degrees of freedom
    lack_of_fit_p: float  # p-value of the rest of χ², against pure error
    where: NoiseWhere | None = None  # None where the factor is the same in all directions

    def to_dict(self) -> dict[str, object]:
        """Return it as JSON."""
        where = encode(self.where) or {}
        where = {"variance_factor" if k == "factor" else k: v for k, v in where.items()} or None
        return {
            "variance_factor": self.factor,
            "interval": list(self.interval),
            "dof": self.dof,
            "lack_of_fit_p": self.lack_of_fit_p,
            "where": where,
        }


@dataclass(frozen=True, slots=True)
class NoiseVerdict:
    """Whether the stated covariance is to blame for a variance factor."""

    reason: NoiseReason

    @property
    def misjudged(self) -> bool:
        """Whether the stated noise is to blame."""
        return self.reason in ("repeats", "too_large", "unknown")

    @property
    def contradicted(self) -> bool:
        """Whether χ² contradicts the stated noise."""
        return self.reason != "as_stated"


def judge_noise(fit: Fit, repeats: PureError | None, predictable: bool) -> NoiseVerdict:
    """Judge the noise of a fit without suspects; `predictable`: something predicts the residual."""
    high = float(scipy.stats.chi2.sf(fit.chi2, fit.dof)) < MISFIT_ALARM
    # Noise that was estimated contains what the fit explains: nobody stated it too large.
    stated = fit.readings.noise_stated
    low = stated and float(scipy.stats.chi2.cdf(fit.chi2, fit.dof)) < MISFIT_ALARM
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
    """Return RP as the arm's maker states it, m, or else `USUAL_REPEATABILITY_M`."""
    return USUAL_REPEATABILITY_M if arm.repeatability is None else arm.repeatability


def within_repeatability(scatter: ArmScatter, arm: Arm) -> bool:
    """Whether the repeatability of the arm allows the scatter."""
    return RP_PER_RMS * scatter.size_m <= MOST_SCATTER * stated_repeatability(arm)


def exceeds_repeatability(scatter: ArmScatter, arm: Arm) -> bool:
    """Whether the scatter exceeds what any arm's repeatability allows, by two standard errors.

    The size² is in proportion to Σ σ_k², so that its relative standard error is
    2 (Σ (σ_k u_k)²)^½ / Σ σ_k², u_k the standard uncertainty of σ_k.
    """
    std, error = np.array(scatter.std), np.array(scatter.std_error)
    relative = float(np.linalg.norm(std * error)) / max(float(np.sum(std**2)), 1e-300)
    least = replace(scatter, size_m=scatter.size_m * max(1.0 - 2.0 * relative, 0.0))
    return not within_repeatability(least, arm)


def prefers_instrument(scatter: ArmScatter) -> bool:
    """Whether the readings prefer, beyond doubt, an instrument that is noisier than stated."""
    return scatter.log_evidence < -SAME_EVIDENCE


def separates_instrument(scatter: ArmScatter) -> bool:
    """Whether the readings distinguish the arm's scatter from a noisier instrument."""
    return abs(scatter.log_evidence) > SAME_EVIDENCE


def pure_error(fit: Fit) -> PureError | None:
    """Compare repeats; None where there are too few."""
    c = contrasts(fit)
    if c is None or c.dof < FEWEST_DOF:
        return None
    pure = float(c.y @ c.y) / c.bias
    lack = max(float(np.sum(c.whitening.whiten(fit.raw) ** 2)) / c.bias - pure, 0.0)
    lack_dof, p = fit.dof - c.dof, 1.0
    if lack_dof > 0 and pure > 0:
        p = float(scipy.stats.f.sf((lack / lack_dof) / (pure / c.dof), lack_dof, c.dof))
    # A direction is wrong itself if it is further off than all together, to the same side.
    overall = max(pure / c.dof, 1e-300)
    off = [
        v
        for v in judge_directions(fit, c)
        if v.p_value < FALSE_ALARM
        and (v.factor > overall) == (v.factor > 1)
        and abs(np.log(max(v.factor, 1e-300))) > abs(np.log(overall))
    ]
    where = min(off, key=lambda v: v.p_value, default=None)
    return PureError(pure / c.dof, variance_interval(pure, c.dof), c.dof, p, where)


@dataclass(frozen=True, slots=True, eq=False)
class RepeatGroup:
    """Measurements with common classes of repeats, or with common unloaded readings."""

    rows: Ints  # (r,) whitened rows
    explained: Floats  # (r, k) orthonormal, the span of W C; contrasts are its complement


@dataclass(frozen=True, slots=True, eq=False)
class Contrasts:
    """All contrasts of a fit's repeats, as whitened rows."""

    readings: Readings  # the fitted readings, repeats with their mean covariance
    whitening: Whitening  # of those readings
    blocks: tuple[RepeatGroup, ...]
    y: Floats  # (r,) the part of the residual in the contrasts, free of nuisance
    nuisance: Floats  # (r, k) orthonormal columns of the differences between repeats
    bias: float  # factor by which estimated covariances make ‖y‖² too large
    joint_motion: Floats  # (N, m, n) motion of each reading by each joint, sensor axes

    @property
    def dof(self) -> int:
        """Degrees of freedom."""
        explained = sum(b.explained.shape[1] for b in self.blocks)
        return int(len(self.y) - explained - self.nuisance.shape[1])

    def project_out(self, x: Floats) -> Floats:
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
            rows = white[start:stop].reshape(len(b.loaded), -1, width)
            back = (np.swapaxes(b.factor, 1, 2) @ rows).reshape(*b.loaded.shape, m, width)
            out[b.loaded] = back
            if b.reference.shape[1]:
                out[b.reference] = -np.einsum("lu,glms->gums", b.weights, back)
            start = stop
        return out


def repeat_classes(readings: Readings) -> Ints:
    """(N,) class: same joints, same load by name and wrench, same target and observer."""
    s = readings.states
    parts = s.wrench[:, :3], s.wrench[:, 3:]
    size = np.repeat([np.linalg.norm(part, axis=1).max(initial=0.0) for part in parts], 3)
    wrench = s.wrench / np.where(size > 0, SAME_LOAD * size, 1.0)
    named = 10.0 * np.stack([readings.load, readings.line], axis=1)
    points = np.concatenate([s.q / SAME_ANGLE, wrench, named], axis=1)
    return groups_within(points, 1.0)


def contrasts(fit: Fit) -> Contrasts | None:
    """Contrasts of the repeats of a fit; None where nothing was repeated."""
    readings = fit.readings[~fit.outlier]
    kind = repeat_classes(readings)
    if len(np.unique(kind)) == len(kind):
        return None
    readings, bias = _pooled(readings, kind)
    w = whitening(readings, fit.mode, "gc")
    blocks = _blocks(w, kind)
    if not blocks:
        return None
    p = fit.solution.prediction
    chain = p.situation.chain
    moves = motion(fit.model.cell, p.observation, chain, p.deviation, w.m).drives
    rows = np.concatenate([b.rows for b in blocks])
    y = _unexplained(blocks, w.whiten(fit.raw).reshape(-1)[rows])
    differing = w.whiten(w.raw(_differences(fit, readings, kind, moves)))[rows]
    u, s, _ = np.linalg.svd(_unexplained(blocks, differing), full_matrices=False)
    nuisance = u[:, s > 1e-2]
    return Contrasts(readings, w, blocks, y - nuisance @ (nuisance.T @ y), nuisance, bias, moves)


def _class_mean(values: Floats, kind: Ints) -> Floats:
    """(N, ...) mean over the class of each reading, of values (N, ...)."""
    mean = np.zeros((int(kind.max()) + 1, *values.shape[1:]))
    np.add.at(mean, kind, values)
    count = np.maximum(np.bincount(kind), 1)
    return np.asarray((mean.T / count).T[kind])


def _pooled(readings: Readings, kind: Ints) -> tuple[Readings, float]:
    """Give repeats their mean covariance; return the bias of an estimated covariance as well.

    Variances estimated from ν degrees of freedom scatter by 2/ν in their logarithm, which the
    repeats show, and E[V̂⁻¹] = V⁻¹ ν/(ν − m − 1).
    """
    v, m, count = readings.covariance, readings.m, np.bincount(kind)
    log_v = np.log(np.maximum(np.diagonal(v, axis1=1, axis2=2), 1e-300))
    log_v = log_v - _class_mean(log_v, kind)
    variance = float(np.sum(log_v**2)) / (m * max(int(np.sum(count - 1)), 1))
    repeats = float(np.sum(count[count > 1])) / max(int(np.sum(count > 1)), 1)
    excess = min(variance / 2 * (m + 1) / repeats, 0.5)
    return replace(readings, covariance=_class_mean(v, kind)), 1.0 / (1.0 - excess)


Group = tuple[Ints, Bucket, int]  # measurements of a group, their bucket, and its index in that


def _blocks(w: Whitening, kind: Ints) -> tuple[RepeatGroup, ...]:
    """Join groups of measurements that have classes in common."""
    # Class of a measurement: those of its loaded reading and of its unloaded readings.
    label = []
    groups: list[Group] = []
    first = 0
    for b in w.buckets:
        loaded = kind[b.loaded]
        ends = np.zeros((*loaded.shape, 2), dtype=loaded.dtype)
        if b.reference.shape[1]:
            unloaded, unused = kind[b.reference][:, None, :], b.weights == 0
            ends[:, :, 0] = np.where(unused, len(kind), unloaded).min(axis=2)
            ends[:, :, 1] = np.where(unused, -1, unloaded).max(axis=2)
        label.append(np.concatenate([loaded[:, :, None], ends], axis=2).reshape(-1, 3))
        size = b.loaded.shape[1]
        groups += [(first + g * size + np.arange(size), b, g) for g in range(len(b.loaded))]
        first += b.loaded.size
    number = np.unique(np.concatenate(label), axis=0, return_inverse=True)[1].reshape(-1)
    owner = np.repeat(np.arange(len(groups)), [len(rows) for rows, _, _ in groups])
    # Groups are joined if they share a class of measurements. They share no unloaded reading,
    # which would correlate them (see `whitening`).
    total = len(groups) + int(number.max()) + 1
    joined = connected_groups(owner, len(groups) + number, total)[: len(groups)]
    ends = np.flatnonzero(np.diff(np.sort(joined))) + 1
    parts = np.split(np.argsort(joined, kind="stable"), ends)
    blocks = (_block([groups[k] for k in rows], number, w.m) for rows in parts)
    return tuple(block for block in blocks if block is not None)


def _block(groups: list[Group], number: Ints, m: int) -> RepeatGroup | None:
    """Return the block of some groups, by the class of each measurement; None without contrasts."""
    measured = np.concatenate([rows for rows, _, _ in groups])
    column = np.unique(number[measured], return_inverse=True)[1].reshape(-1)
    if column.max() + 1 == len(measured):
        return None
    # W C: the whitened columns of the measurements, summed by class.
    wc = np.zeros((len(measured) * m, int(column.max()) + 1, m))
    start = 0
    for rows, b, g in groups:
        stop = start + len(rows)
        factors = np.split(b.factor[g], len(rows), axis=1)
        for k, factor in zip(column[start:stop], factors, strict=True):
            wc[start * m : stop * m, k] += factor
        start = stop
    rows = (measured[:, None] * m + np.arange(m)).reshape(-1)
    weighted = np.concatenate([np.any(b.factor[g] != 0, axis=1) for _, b, g in groups])
    u, s, _ = np.linalg.svd(wc.reshape(len(wc), -1)[weighted], full_matrices=False)
    rank = int(np.sum(s > ROUNDING * s.max(initial=0.0)))
    return None if rank == len(u) else RepeatGroup(rows[weighted], u[:, :rank])


def _unexplained(blocks: tuple[RepeatGroup, ...], x: Floats) -> Floats:
    """Project rows (r, ...) of all blocks onto the contrasts."""
    out, start = x.copy(), 0
    for b in blocks:
        rows = out[start : start + len(b.rows)]
        rows -= b.explained @ (b.explained.T @ rows)
        start += len(b.rows)
    return out


def _differences(fit: Fit, readings: Readings, kind: Ints, moves: Floats) -> Floats:
    """(N, m, P) first-order motions by differences between repeats; 1 mrad or 1 mm each."""
    s, torque = readings.states, fit.solution.prediction.situation.torque
    axes = np.zeros((*moves.shape[:2], 3))
    axes[:, :3] = fit.solution.prediction.observation.axes
    joint, both = 1e-3 * moves, 1e-3 * np.concatenate([moves, axes], axis=2)
    out = []

    def add(motions: Floats, values: Floats) -> None:
        centred = values - _class_mean(values, kind)
        size = np.abs(centred).max(axis=0)
        differ = size > 1e-6 * np.abs(values).max(axis=0)
        scaled = np.where(differ, centred / np.where(size > 0, size, 1), 0)
        out.append(motions * scaled[:, None, :])

    add(joint, torque)
    for values in (s.approach, s.joint_temperature):
        if values is not None:
            add(joint, values)
    for values in (s.time, s.air_temperature):
        if values is not None:
            add(both, np.tile(values[:, None], both.shape[2]))
    if s.load_time is not None:
        add(joint, torque * s.load_time[:, None])
    columns = np.concatenate(out, axis=2)
    return columns[:, :, np.any(columns, axis=(0, 1))]


def judge_directions(fit: Fit, c: Contrasts) -> list[NoiseWhere]:
    """Judge all directions; p-values are corrected for their number."""
    directions = _directions(fit, c)
    rng = np.random.default_rng(20250301)
    rows = [np.flatnonzero(np.any(d != 0, axis=(1, 2))) for _, _, d in directions]
    square, size = np.zeros(1 + DRAWS), np.zeros((len(directions), 1 + DRAWS))
    at_once = max(DRAWN_AT_ONCE // len(c.y), 1)
    for start in range(0, 1 + DRAWS, at_once):
        batch = slice(start, min(start + at_once, 1 + DRAWS))
        drawn = c.project_out(rng.standard_normal((len(c.y), batch.stop - batch.start)))
        if start == 0:
            drawn[:, 0] = c.y
        square[batch], slopes = np.sum(drawn**2, axis=0), c.slopes(drawn)
        for k, (_, _, d) in enumerate(directions):
            along = np.einsum("kir,kis->krs", d[rows[k]], slopes[rows[k]])
            size[k, batch] = np.sum(along**2, axis=(0, 1))
    if not square.all():  # identical repeats do not distinguish directions
        return []
    out = []
    for (kind, name, _), t in zip(directions, size, strict=True):
        mean, spread = float(t[1:].mean()), float(t[1:].std())
        dof = 2 * (mean / spread) ** 2 if mean > 0 else 0.0
        if dof >= FEWEST_DOF_OF_DIRECTION:
            factor = float(t[0]) / mean / c.bias
            low, high = (factor * dof / float(scipy.stats.chi2.isf(q, dof)) for q in (0.025, 0.975))
            out.append(NoiseWhere(kind, name, factor, (low, high), _p(t / square)))
    return [replace(v, p_value=min(v.p_value * len(out), 1.0)) for v in out]


def _p(ratio: Floats) -> float:
    """Two-sided p-value of the first ratio, the others being drawn under the null hypothesis.

    The cube root of a sum of squares is nearly normal (Wilson and Hilferty, Proc. Natl. Acad.
    Sci. 17 (1931) 684-688); its remaining skewness is estimated from the draws.
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
    out += [
        ("joint", f"joint {j + 1}", c.joint_motion[:, :, [j]])
        for j in range(c.joint_motion.shape[2])
    ]
    loads = np.unique(readings.load)
    if len(loads) > 1:
        for load in loads:
            name = readings.load_names[load]
            of_load = (readings.load == load)[:, None, None]
            out.append(("load", "unloaded" if name == "none" else name, root * of_load))
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
