"""Which readings are gross errors: data snooping from a robust start.

Least trimmed squares finds the readings, more than half, that agree best on the model. What a model
without some effect leaves of them sizes smooth nuisance functions that stand in for it, as random
effects: joint displacements by functions of the joint's angle, torque and side of approach, link
twists, constant and by the moments that the link carries, a drift of the target with time. Then
readings join or leave by their distance t² from the fit to the others, which is χ²_m of a good
reading, until none does (Baarda, *A testing procedure for use in geodetic networks*, 1968).

Readings that are off for one cause are no gross errors: those off by the same shift in a row, in
the axes of the sensor or of the target, as by another reflector, a target that was moved on the
tool, a tracker that was bumped (`off_alike`); and those off along what one site of the arm can do.
What a law of a joint, of a link that bends or of the force sensor does to a reading goes along one
direction there, whatever the law depends on; a gross error goes anywhere. Of a random error in m
dimensions the share beside a direction is sin² ~ Beta((m − 1)/2, 1/2), with p its distribution
function uniform. So n of F gross errors are as near to a site's direction as p_(n), ascending, with
the probability P(B(F, p_(n)) ≥ n), times F and the number of sites for the least of all. Where that
is too small, what is along the site, at two poses at least, is a law's (`along_one_site`).
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.stats import beta, binom, chi2

from hilcal.errors import CannotAnswerError
from hilcal.identification.gauss_newton import Solution
from hilcal.identification.least_trimmed_squares import (
    MISFIT,
    MOST,
    ReadingModel,
    bulk,
    limit,
    nearest,
    robust_start,
    variance,
)
from hilcal.identification.priors import scales_of
from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, deflection_groups, inverse_root
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
SMALLEST = 3e-3  # share of the largest used t² below which none leaves before a new fit
ACCIDENT = 1e-3  # probability of so many shared unloaded readings that are off: a misfit
CORE = 0.99  # of the χ² quantile up to which readings join the robust start
MOST_COLUMNS = 200  # parameters fitted anew with each choice; of more, those without a prior
ROUGH_M = 1e-3  # scatter of most readings, m, from which on they disagree: no arm leaves as much
ROUNDS = 20  # most rounds in which readings join and leave
WHITENED = 4096  # readings that are whitened at a time
EXACT = 1e-6  # share of a group's mean covariance that each has: exact unloaded readings stay so
MOST_SHARE = 0.35  # most nuisance columns, as a share of the whitened rows
SAME = 0.25  # largest difference of two shifts that are the same one, as a share of the larger
BETWEEN = 1  # readings between two alike ones that may be off otherwise
RUN = 4  # fewest readings that are off alike: two in a row agree by chance
ACCIDENTAL = 0.05  # share of readings up to which those off alike count as gross errors
CHANCE = 1e-2  # that so many are along any one site; that noise moves one beside its law so far
FEWEST = 2  # poses that a law moves at least: axes may agree at one
ROUGH = 0.05  # share of a law's shift that may be beside its direction, as the model is linear


@dataclass(frozen=True, slots=True, eq=False)
class Disagreement:
    """Readings (rows) that are far off, and no gross errors that could be set aside.

    "many": more are off than can be told from good ones; "alike": in a row, by the same shift.
    """

    kind: Literal["many", "alike"]
    rows: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Screened:
    """Readings that were tested for gross errors."""

    agree: Bools  # (N,) that agree with the model
    used: Bools  # (N,) to fit to: these, and those of a disagreement; without deflections from an
    # unloaded reading that is off
    misfit: float  # variance of what the model leaves of good readings, in units of the noise
    disagreement: Disagreement | None = None  # readings that are off and yet used


@dataclass(frozen=True, eq=False)
class Snooping:
    """The readings of a fit, as they are tested for gross errors."""

    model: Model
    readings: Readings  # all of them
    mode: Mode
    solution: Solution  # of some of them
    y: Floats  # (P,) coordinates that the model is linearised at

    def begin(self, rng: np.random.Generator) -> Screened:
        """Test all readings from a robust start; the solution may be of bad readings, too."""
        every = np.ones(len(self.readings), dtype=np.bool_)
        if self._all_noise():
            return Screened(every, every, 1.0)
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
        readings = self.readings
        every, kept = np.ones_like(used), np.zeros_like(used)
        count = int(np.count_nonzero(at.linear.tested))
        while True:
            of = at.with_nuisance(misfit)
            used, t2, scale = self._snooped(of, used | kept, kept)
            agree = used | ~of.tested
            off = np.flatnonzero(~agree)
            if self._accident(of, off):
                return Screened(every, every, misfit)
            size = np.sqrt(scale * np.mean(np.trace(readings.covariance[:, :3, :3], 0, 1, 2)))
            if len(off) > MOST * count or (scale > MISFIT[1] and size > ROUGH_M):
                off = np.flatnonzero((t2 > limit(of.m, count)) & of.tested)
                return Screened(every, every, misfit, Disagreement("many", off))
            if not len(off):
                return Screened(agree, every, misfit)
            white = of.residuals(used)[off, :, None]
            shift = (np.linalg.pinv(of.root[off]) @ white)[:, :, 0]
            axes = self.model.predict(readings.states[off], self.solution.theta).observation
            alike = off_alike(readings, of.tested, off, shift[:, :3], axes.rotation)
            rest = ~np.isin(off, alike) & ~readings.scalar[off]  # no direction to tell
            rows = off[rest]
            unit = _units(readings.covariance[rows])
            sites = at.sites[rows] / unit[:, :, None]
            law = rows[along_one_site(shift[rest] / unit, sites, readings.pose[rows])]
            if not len(law):
                fitted = agree | np.isin(np.arange(len(agree)), alike)
                found = Disagreement("alike", alike) if len(alike) else None
                return Screened(agree, self._fittable(of, fitted), misfit, found)
            kept[law] = True
            left = at.linear.residuals(used | kept)[used | kept]
            misfit = max(misfit, float(np.mean(left**2)))

    def _snooped(self, of: ReadingModel, used: Bools, kept: Bools) -> tuple[Bools, Floats, float]:
        """Readings (N,) that are not off, t² (N,) from the fit to them, and the scale of its bulk.

        It begins with the `used` ones (N,), of which those that are `kept` (N,) stay.
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
        if not len(of.members):
            return agree
        unloaded, used = self.readings.unloaded[of.members], agree.copy()
        good = agree[of.members] & (of.members >= 0)
        lost = ~((good & unloaded).any(axis=1) & (good & ~unloaded).any(axis=1))
        gone = of.members[lost]
        used[gone[gone >= 0]] = False
        return used


@dataclass(frozen=True, eq=False)
class _LinearModel:
    """The linear model of all readings at coordinates y (P,)."""

    of: Snooping
    y: Floats
    live: Ints  # (K,) those that are estimated, and the columns of `linear`
    scale: Floats  # (K,) their ordinary magnitudes, the units of the columns
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
        of, rank = self.of, int(self.linear.read[self.linear.tested].sum())
        columns = smooth_nuisance_columns(of.model, self.prediction, of.readings, rank)
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
    carried = bool(len(s.space.index))
    jacobian = model.jacobian(prediction, theta, readings.m, None if carried else live)
    if carried:
        jacobian = s.space.columns(jacobian.reshape(-1, model.size))[:, live]
    precision = s.beta * (scale / s.prior[live]) ** 2
    linear = ReadingModel(
        residual=(root @ off[:, :, None])[:, :, 0],
        columns=root @ (jacobian * scale).reshape(*off.shape, len(live)),
        precision=precision,
        pull=precision * y[live] / scale,
        root=root,
        members=members,
    )
    return _LinearModel(of, y, live, scale, prediction, linear)


def _groups(readings: Readings) -> Ints:
    """(G, S) rows that share unloaded readings, unloaded first, −1 beyond the last."""
    rows = [
        np.concatenate([unloaded, loaded], axis=1)
        for loaded, unloaded, _ in deflection_groups(replace(readings, common=None))
    ]
    most = max(part.shape[1] for part in rows)
    pad = [((0, 0), (0, most - part.shape[1])) for part in rows]
    return np.concatenate(
        [np.pad(r, p, constant_values=-1) for r, p in zip(rows, pad, strict=True)]
    )


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
    at, s = prediction.situation, readings.states
    moves = motion(model.cell, prediction.observation, at.chain, prediction.deviation, readings.m)
    functions = [np.ones_like(at.angle), at.torque]
    if s.approach is not None:
        functions.append(s.approach)
    functions += [np.cos(at.angle), np.sin(at.angle)]
    joints = [moves.drives * f[:, None, :] for f in functions]
    links = [moves.by_slot(k) for k in range(at.wrench.shape[1])]
    loads = [x[:, :, 3:5] * at.wrench[:, k, None, 3:5] for k, x in enumerate(links)]
    drift = [] if s.time is None else [moves.by_station() * (s.time - s.time.mean())[:, None, None]]
    harmonics = [moves.drives * f(2 * at.angle)[:, None, :] for f in (np.cos, np.sin)]
    most = int(MOST_SHARE * rank)
    return np.concatenate([*joints, *drift, *loads, *harmonics, *links], axis=2)[:, :, :most]


def off_alike(readings: Readings, tested: Bools, off: Ints, shift: Floats, axes: Floats) -> Ints:
    """Return the rows that are off alike, more than `ACCIDENTAL` of the tested ones (N,), or none.

    Of rows `off` (F,), ascending, with their shifts (F, 3) and the target's axes (F, 3, 3), both in
    axes of the sensor.
    """
    order = np.zeros(len(readings), dtype=np.int64)
    found = np.zeros(len(off), dtype=np.bool_)
    target = readings.target
    for k in np.unique(target[off]):
        rows = tested & (target == k)
        order[rows] = np.arange(np.count_nonzero(rows))
        at = np.flatnonzero(target[off] == k)
        turned = (shift[at, None] @ axes[at])[:, 0]
        found[at] = _in_a_row(order[off[at]], shift[at]) | _in_a_row(order[off[at]], turned)
    few = np.count_nonzero(found) <= ACCIDENTAL * np.count_nonzero(tested)
    return off[:0] if few else off[found]


def _in_a_row(order: Ints, shift: Floats) -> Bools:
    """(F,) which shifts (F, 3) are the same as `RUN` in a row, all readings between off as well."""
    count = len(shift)
    run, size = np.arange(count), np.linalg.norm(shift, axis=1)
    for ahead in range(1, BETWEEN + 2):
        for k in range(count - ahead):
            then = k + ahead
            apart = np.linalg.norm(shift[then] - shift[k])
            if order[then] - order[k] == ahead and apart <= SAME * max(size[k], size[then]):
                run[run == run[then]] = run[k]
    return np.asarray(np.bincount(run, minlength=count)[run] >= RUN)


def site_columns(model: Model, theta: Floats, prediction: Prediction, readings: Readings) -> Floats:
    """(N, m, P) changes of N readings by each site; last by 1 N and 1 N·m on the force sensor."""
    p, states, at, m = prediction, readings.states, prediction.observation, readings.m
    moves = motion(model.cell, at, p.situation.chain, p.deviation, m)
    turns = [moves.by_slot(k, slice(3, 6)) for k in range(p.situation.wrench.shape[1])]
    sensor = []
    for part in (slice(0, 3), slice(3, 6)):
        for axis in np.moveaxis(p.situation.chain.rotation[-1], 2, 0):
            wrench = states.wrench.copy()
            wrench[:, part] += axis
            try:
                o = model.predict(replace(states, wrench=wrench), theta, p).observation
            except CannotAnswerError:  # parameters so large that more load has no equilibrium
                continue
            turn = se3.rotation_vector(o.rotation @ at.rotation.swapaxes(1, 2))
            sensor.append(np.concatenate([o.position - at.position, turn], axis=1)[:, :m])
    columns = [*turns, *(column[:, :, None] for column in sensor)]
    return np.concatenate(columns, axis=2)


def along_one_site(shift: Floats, columns: Floats, pose: Ints) -> Bools:
    """(F,) which readings that are off a law moves.

    Shifts (F, m) and the changes by each site (F, m, P) are in units of the noise, the same for all
    directions: random ones are not drawn to those of little noise. `pose` (F,) is where they are.
    """
    count, m, sites = columns.shape
    if not count:
        return np.zeros(0, dtype=np.bool_)
    square, length = np.sum(shift**2, axis=1), np.linalg.norm(columns, axis=1)
    along = np.einsum("fi,fip->fp", shift, columns) / np.where(length > 0, length, np.inf)
    beside = np.maximum(square[:, None] - along**2, 0.0)
    near = beside <= (chi2.isf(CHANCE, m - 1) + ROUGH**2 * square)[:, None]
    p = np.where(near, beta.cdf(beside / square[:, None], (m - 1) / 2, 0.5), 1.0)
    ascending: Floats = np.sort(p[_different(shift, pose)], axis=0)
    count = len(ascending)
    so_many = np.asarray(binom.sf(np.arange(count)[:, None], count, ascending))
    law = [
        k
        for k, least in enumerate(np.argmin(so_many, axis=0))
        if so_many[least, k] * count * sites < CHANCE
        and len(np.unique(pose[p[:, k] <= ascending[least, k]])) >= FEWEST
    ]
    return np.asarray(near[:, law].any(axis=1))


def _different(shift: Floats, pose: Ints) -> Bools:
    """(F,) readings without the shift of an earlier one at their pose, which has one cause."""
    out = np.ones(len(pose), dtype=np.bool_)
    for rows in (np.flatnonzero(pose == p) for p in np.unique(pose)):
        size = np.linalg.norm(shift[rows], axis=1)
        apart = np.linalg.norm(shift[rows, None] - shift[rows], axis=2)
        same = apart <= SAME * np.maximum(size[:, None], size)
        out[rows] = ~np.tril(same, -1).any(axis=1)
    return out
