"""Which readings are gross errors: data snooping (Baarda) from a robust start.

Least trimmed squares finds the readings, more than half, that agree best on the model. What a model
without some effect leaves of them sizes smooth nuisance functions that stand in for it, as random
effects. Then readings join or leave by their distance t² from the fit to the
others, which is χ²_m of a good reading (`reading_model`), until none does.

Source: Baarda, *A testing procedure for use in geodetic networks* (1968).

Smooth nuisance columns, so that data snooping does not take a misfit for gross errors.

Joint displacements by smooth functions of the joint's angle, torque and side of approach; link
twists, constant and by the moments that the link carries; a drift of the target with time.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.stats import binom, chi2

from hilcal.identification.common_cause import along_one_site, off_alike, site_columns
from hilcal.identification.gauss_newton import Solution
from hilcal.identification.least_trimmed_squares import (
    MISFIT,
    MOST,
    bulk,
    limit,
    nearest,
    robust_start,
    variance,
)
from hilcal.identification.priors import scales_of
from hilcal.identification.reading_model import ReadingModel
from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, deflection_groups, inverse_root
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

SMALLEST = 3e-3
"""Share of the largest t² of the used readings below which none leaves before a new fit; a choice,
no study set it."""
ACCIDENT = 1e-3
"""Binomial probability of so many shared unloaded readings among the gross errors, below which the
cause is a misfit; a choice, the tests of effects on unloaded readings confirm it."""
CORE = 0.99
"""Probability of the χ² quantile up to which readings join the robust start; a choice."""
MOST_COLUMNS = 200
"""Most parameters that are fitted anew with each choice of readings; where there are more, those
with a prior are held. A choice by timing: hundreds of harmonics hardly depend on one reading."""
ROUGH_M = 1e-3
"""Scatter of most readings about model and smooth functions, m, from which on they disagree; a
choice: more than any arm leaves beside its geometry."""
ROUNDS = 20
"""Most rounds in which readings join and leave; a choice."""
WHITENED = 4096
"""Readings that are whitened at a time."""
EXACT = 1e-6
"""Share of a group's mean covariance that each of its readings has at least; a choice: an unloaded
reading that is stated to be exact is so all the same."""
MOST_SHARE = 0.35
"""Most columns, as a share of the whitened rows; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class Disagreement:
    """Readings that are far off, and no gross errors that could be set aside.

    Attributes:
        kind: "many", where more are off than can be told from good ones; "alike", where readings in
            a row are off by the same shift.
        rows: of the readings.
    """

    kind: Literal["many", "alike"]
    rows: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Screened:
    """Readings that were tested for gross errors.

    Attributes:
        agree: (N,) that agree with the model.
        used: (N,) to fit to: these, and those of a disagreement; without deflections from an
            unloaded reading that is off.
        misfit: variance of what the model leaves of good readings, in units of the noise.
        disagreement: readings that are off and yet used.
    """

    agree: Bools
    used: Bools
    misfit: float
    disagreement: Disagreement | None


@dataclass(frozen=True, eq=False)
class Snooping:
    """The readings of a fit, as they are tested for gross errors.

    Attributes:
        model: robot and effects.
        readings: all of them.
        mode: "deflection" or "absolute".
        solution: of some of them.
        y: (P,) parameters that the model is linearised at.
    """

    model: Model
    readings: Readings
    mode: Mode
    solution: Solution
    y: Floats

    def begin(self, rng: np.random.Generator) -> Screened:
        """Test all readings from a robust start; the solution may be of bad readings, too."""
        every = np.ones(len(self.readings), dtype=np.bool_)
        if self._all_noise():
            return Screened(every, every, 1.0, None)
        at, used = robust_start(linearised(self, self.y), rng)
        of = at.linear
        d2, centre = of.near(of.fitted(used)[0])
        misfit = variance(of, d2, centre)
        of = at.with_nuisance(misfit)
        for _ in range(ROUNDS):
            t2, centre = _tested(of, used)
            now, _ = nearest(of, t2, centre)
            if np.array_equal(now, used):
                break
            used = now
        core = float(chi2.ppf(CORE, of.m)) * variance(of, t2, centre)
        return self._screened(at, (t2 <= core) | centre, misfit)

    def _all_noise(self) -> bool:
        """Whether smooth functions beside the model leave noise of each reading: none is off."""
        at = linearised(self, self.solution.y)
        of = at.with_nuisance(float(np.mean(at.linear.residuals(at.linear.tested) ** 2)))
        t2 = of.distances(of.tested)[of.tested]
        return bool(t2.max() <= limit(of.m, len(t2)))

    def again(self, before: Screened) -> Screened:
        """Test them from the readings that agreed before, whose solution this is."""
        return self._screened(linearised(self, self.y), before.agree, before.misfit)

    def _screened(self, at: "_LinearModel", used: Bools, misfit: float) -> Screened:
        every, kept = np.ones_like(used), np.zeros_like(used)
        count = int(np.count_nonzero(at.linear.tested))
        while True:
            of = at.with_nuisance(misfit)
            used, t2, scale = self._snooped(of, used | kept, kept)
            agree = used | ~of.tested
            off = np.flatnonzero(~agree)
            if self._accident(of, off):
                return Screened(every, every, misfit, None)
            size = np.sqrt(scale * np.mean(np.trace(self.readings.covariance[:, :3, :3], 0, 1, 2)))
            if len(off) > MOST * count or (scale > MISFIT[1] and size > ROUGH_M):
                off = np.flatnonzero((t2 > limit(of.m, count)) & of.tested)
                return Screened(every, every, misfit, Disagreement("many", off))
            if not len(off):
                return Screened(agree, every, misfit, None)
            white = of.residuals(used)[off, :, None]
            shift = (np.linalg.pinv(of.root[off]) @ white)[:, :, 0]
            axes = self.model.predict(self.readings.states[off], self.solution.theta).observation
            alike = off_alike(self.readings, of.tested, off, shift[:, :3], axes.rotation)
            rest = ~np.isin(off, alike) & ~self.readings.scalar[off]  # no direction to tell
            unit = _units(self.readings.covariance[off[rest]])
            sites = at.sites[off[rest]] / unit[:, :, None]
            law = off[rest][
                along_one_site(shift[rest] / unit, sites, self.readings.pose[off[rest]])
            ]
            if not len(law):
                fitted = agree | np.isin(np.arange(len(agree)), alike)
                found = Disagreement("alike", alike) if len(alike) else None
                return Screened(agree, self._fittable(of, fitted), misfit, found)
            kept[law] = True
            left = at.linear.residuals(used | kept)[used | kept]
            misfit = max(misfit, float(np.mean(left**2)))

    def _snooped(self, of: ReadingModel, used: Bools, kept: Bools) -> tuple[Bools, Floats, float]:
        """Readings (N,) that are not off, t² (N,) from the fit to them, and the scale of its bulk.

        Args:
            of: the linear model.
            used: (N,) those to begin with.
            kept: (N,) of these, those that stay.
        """
        count = int(np.count_nonzero(of.tested))
        for _ in range(ROUNDS):
            t2, centre = _tested(of, used)
            judged = t2[used & (t2 > 0)]
            scale = bulk(judged, of.m) if len(judged) else 1.0
            far = max(limit(of.m, count, scale), SMALLEST * float(t2[used].max()))
            now = of.with_lone_centres(((t2 <= far) & of.tested) | kept, centre)
            if np.array_equal(now, used):
                break
            used = now
        return used, t2, scale

    def _accident(self, of: ReadingModel, off: Ints) -> bool:
        """Whether unloaded readings that deflections share are too many of those that are off."""
        shared = self.readings.unloaded & of.tested & (of.group >= 0)
        unloaded = int(np.count_nonzero(shared[off]))
        share = float(np.mean(shared[of.tested]))
        return unloaded > 0 and float(binom.sf(unloaded - 1, len(off), share)) < ACCIDENT

    def _fittable(self, of: ReadingModel, agree: Bools) -> Bools:
        """(N,) readings without deflections of which the loaded or all unloaded ones are off."""
        used = agree.copy()
        if not len(of.members):
            return used
        there = of.members >= 0
        unloaded = self.readings.unloaded[of.members]
        good = agree[of.members] & there
        lost = ~((good & unloaded).any(axis=1) & (good & ~unloaded).any(axis=1))
        gone = of.members[lost]
        used[gone[gone >= 0]] = False
        return used


@dataclass(frozen=True, eq=False)
class _LinearModel:
    """The linear model of all readings at parameters y (P,).

    Attributes:
        of: the fit.
        y: coordinates of the parameters.
        live: (K,) those that are estimated, and the columns of `linear`.
        scale: (K,) their ordinary magnitudes, the units of the columns.
        prediction: there.
        linear: the linear model.
    """

    of: Snooping
    y: Floats
    live: Ints
    scale: Floats
    prediction: Prediction
    linear: ReadingModel

    def moved(self, delta: Floats) -> "_LinearModel":
        """Return it after a step δ (K,)."""
        y = self.y.copy()
        y[self.live] += self.scale * delta
        return linearised(self.of, y)

    @cached_property
    def sites(self) -> Floats:
        """(N, m, P) changes of the readings by each site of a law."""
        theta = self.of.solution.space.theta(self.y)
        return site_columns(self.of.model, theta, self.prediction, self.of.readings)

    def with_nuisance(self, misfit: float) -> ReadingModel:
        """Return the linear model with smooth nuisance columns of some variance above the noise."""
        of, readings = self.of, self.of.readings
        rank = int(self.linear.read[self.linear.tested].sum())
        columns = smooth_nuisance_columns(of.model, self.prediction, readings, rank)
        for k in range(0, len(columns), WHITENED):  # in place: they are the largest array of a fit
            rows = slice(k, k + WHITENED)
            columns[rows] = self.linear.root[rows] @ columns[rows]
        count = max(columns.shape[0] * columns.shape[1], 1)
        length = np.sqrt(np.einsum("nip,nip->p", columns, columns) / count)
        kept = length > 1e-9 * length.max(initial=0.0)
        size = np.sqrt(max(misfit - 1.0, 0.0) / max(int(np.count_nonzero(kept)), 1))
        columns *= np.where(kept, size / np.where(kept, length, 1.0), 0.0)
        return self.linear.with_columns(columns if kept.all() else columns[:, :, kept])


def linearised(of: Snooping, y: Floats) -> _LinearModel:
    """Return the linear model of all readings at the coordinates y (P,)."""
    model, readings, s = of.model, of.readings, of.solution
    theta = s.space.theta(y)
    prediction = model.predict(readings.states, theta)
    members = _groups(readings) if of.mode == "deflection" else np.zeros((0, 0), dtype=np.int64)
    root = inverse_root(_covariance(readings, members))
    off = _off(readings, prediction, members)
    live = np.flatnonzero(s.prior > 0)
    if len(live) > MOST_COLUMNS:
        live = np.flatnonzero(np.isinf(s.prior))
    scale = s.space.scales(scales_of(model))[live]
    if len(s.space.index):
        jacobian = model.jacobian(prediction, theta, readings.m).reshape(-1, model.size)
        columns = s.space.columns(jacobian)[:, live] * scale
    else:
        columns = model.jacobian(prediction, theta, readings.m, live) * scale
    precision = s.beta * (scale / s.prior[live]) ** 2
    linear = ReadingModel(
        residual=(root @ off[:, :, None])[:, :, 0],
        columns=root @ columns.reshape(*off.shape, len(live)),
        precision=precision,
        pull=precision * y[live] / scale,
        root=root,
        members=members,
    )
    return _LinearModel(of, y, live, scale, prediction, linear)


def _groups(readings: Readings) -> Ints:
    """(G, S) rows that share unloaded readings, unloaded first, −1 beyond the last."""
    groups = deflection_groups(replace(readings, common=None))
    most = max(loaded.shape[1] + unloaded.shape[1] for loaded, unloaded, _ in groups)
    out = []
    for loaded, unloaded, _ in groups:
        rows = np.concatenate([unloaded, loaded], axis=1)
        out.append(np.pad(rows, ((0, 0), (0, most - rows.shape[1])), constant_values=-1))
    return np.concatenate(out)


def _covariance(readings: Readings, members: Ints) -> Floats:
    """(N, m, m) covariances, of a group's readings none zero."""
    v = readings.covariance
    if not len(members):
        return v
    there = (members >= 0)[:, :, None, None]
    mean = np.sum(v[members] * there, axis=1) / there.sum(axis=1)
    out = v.copy()
    g, s = np.nonzero(members >= 0)
    out[members[g, s]] += EXACT * mean[g]
    return out


def _units(covariance: Floats) -> Floats:
    """(F, m) standard deviations of a reading, the same for all directions."""
    m = covariance.shape[1]
    variance = np.diagonal(covariance, axis1=1, axis2=2).reshape(len(covariance), m // 3, 3)
    return np.asarray(np.repeat(np.sqrt(variance.mean(axis=2)), 3, axis=1))


def _off(readings: Readings, prediction: Prediction, members: Ints) -> Floats:
    """(N, m) measured minus predicted; turns of deflections relative to an unloaded reading."""
    o = prediction.observation
    position = readings.value[:, :3] - o.position
    if readings.m == 3:
        return position
    read = se3.rotation(readings.value[:, 3:])
    if not len(members):
        turn = se3.rotation_vector(read @ o.rotation.swapaxes(1, 2))
        return np.concatenate([position, turn], axis=1)
    first = np.arange(len(readings))
    g, s = np.nonzero(members >= 0)
    first[members[g, s]] = members[g, 0]
    measured, predicted = (
        se3.rotation_vector(r @ r[first].swapaxes(1, 2)) for r in (read, o.rotation)
    )
    return np.concatenate([position, measured - predicted], axis=1)


def _tested(of: ReadingModel, used: Bools) -> tuple[Floats, Bools]:
    """t² (N,) of all readings, and the centres of groups (N,)."""
    if not len(of.members):
        return of.distances(used), np.zeros_like(used)
    _, centre = of.near(of.fitted(used)[0])
    return of.distances(of.with_lone_centres(used, centre)), centre


def smooth_nuisance_columns(
    model: Model, prediction: Prediction, readings: Readings, rank: int
) -> Floats:
    """Columns (N, m, P); only the simplest ones where the `rank` of the readings is small."""
    situation, s = prediction.situation, readings.states
    moves = motion(
        model.cell, prediction.observation, situation.chain, prediction.deviation, readings.m
    )
    one = np.ones_like(situation.angle)
    functions = [one, situation.torque]
    if s.approach is not None:
        functions.append(s.approach)
    functions += [np.cos(situation.angle), np.sin(situation.angle)]
    joints = [moves.drives * f[:, None, :] for f in functions]
    links, loads = [], []
    for slot in range(situation.wrench.shape[1]):
        moved = moves.by_slot(slot)
        links.append(moved)
        loads.append(moved[:, :, 3:5] * situation.wrench[:, slot, None, 3:5])
    drift = [] if s.time is None else [moves.by_station() * (s.time - s.time.mean())[:, None, None]]
    harmonics = [moves.drives * f(2 * situation.angle)[:, None, :] for f in (np.cos, np.sin)]
    most = int(MOST_SHARE * rank)
    return np.concatenate([*joints, *drift, *loads, *harmonics, *links], axis=2)[:, :, :most]
