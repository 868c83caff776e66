"""Detection of gross errors: data snooping from a robust start.

Least trimmed squares finds more than half of the readings that agree best with the model. An effect
that the model lacks is represented by smooth nuisance functions, as random effects: joint
displacements as functions of the joint's angle, torque and side of approach; constant link twists,
and link twists proportional to the moments that the link carries; a drift of the target with time.
The residual of the robust start gives their variance. Then readings enter or leave by their
distance t² from the fit to the others, which is χ²_m distributed for a good reading, until the set
does not change (Baarda, *A testing procedure for use in geodetic networks*, 1968).

Readings that deviate by one common cause are no gross errors: readings in a row with the same shift
in the axes of the sensor or of the target, as by another reflector, a target that was moved on the
tool, or a bumped tracker (`runs_of_equal_shifts`); and readings with shifts along the directions of
one site of the arm (`along_one_site`), as a law of a joint, of a link that bends, or of the force
sensor moves each reading along one direction, whatever it depends on.

The shift of a gross error has no preferred direction: in m dimensions the share of its square that
is normal to a given direction is sin² ~ Beta((m − 1)/2, 1/2), whose distribution function p is
uniform. Of F gross errors, with p_(n) ascending, at least n are as near to the directions of a site
as p_(n) with the probability P(B ≥ n), B binomial with F and p_(n). The least of these, over n and
the sites, is multiplied by F and the number of sites. Where the product is too small for chance,
the readings near these directions, if of at least two poses, are ascribed to a law.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy

from hilcal.errors import CannotAnswerError
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.gauss_newton import Solution
from hilcal.identification.outliers.least_trimmed_squares import (
    MISFIT_SCALES,
    MOST_WRONG,
    ReadingModel,
    bulk_scale,
    nearest,
    rejection_limit,
    robust_start,
    trimmed_variance,
)
from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, deflection_groups, whitening_matrix
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
LEAST_T2_SHARE = 3e-3
"""Share of the largest t² in the fit below which no reading leaves in one round."""
SHARED_LEVEL = 1e-3  # probability of so many shared unloaded readings among gross errors: a misfit
START_QUANTILE = 0.99  # probability of the χ² quantile up to which readings enter the robust start
MOST_COLUMNS = 200  # parameters fitted anew with each set; of more, only those without a prior
DISAGREEMENT_M = 1e-3  # scatter of most readings, m, that no arm reaches: the readings disagree
MOST_ROUNDS = 20  # in which readings enter and leave
WHITENED_AT_ONCE = 4096  # readings whitened at a time
COVARIANCE_RIDGE = 1e-6
"""Share of a group's mean covariance added to each reading, as exact ones have none."""
MOST_SHARE = 0.35  # most nuisance columns, as a share of the whitened rows
SAME_SHIFT = 0.25  # difference of two equal shifts at most, as a share of the larger one
MOST_BETWEEN = 1  # most readings with another shift between two with equal shifts
FEWEST_IN_RUN = 4  # readings with an equal shift: two in a row agree by chance
MOST_ALIKE_SHARE = 0.05
"""Share of readings up to which those with equal shifts count as gross errors."""
SITE_LEVEL = 1e-2  # of so many near one site by chance, and of noise so far from a law's direction
FEWEST_POSES = 2  # poses that a law must move: at one pose directions of sites may coincide
LINEARISATION_SHARE = 0.05
"""Share of a law's shift normal to its direction that the linearisation may cause."""


@dataclass(frozen=True, slots=True, eq=False)
class Disagreement:
    """Readings (rows) that deviate strongly, but cannot be set aside as gross errors.

    "many": too many to be distinguished from good ones; "alike": in a row, by the same shift.
    """

    kind: Literal["many", "alike"]
    rows: Ints


@dataclass(frozen=True, slots=True, eq=False)
class SnoopingResult:
    """Result of the test for gross errors."""

    agree: Bools  # (N,) readings that agree with the model
    used: Bools  # (N,) readings to fit: these and those of a disagreement, without deflections
    # from an unloaded reading that is a gross error
    misfit: float  # variance of the residual of good readings, in units of the noise
    disagreement: Disagreement | None = None


@dataclass(frozen=True, eq=False)
class DataSnooping:
    """Test of the readings of a fit for gross errors."""

    model: Model
    readings: Readings  # all
    mode: Mode
    solution: Solution  # of a part of the readings
    y: Floats  # (P,) coordinates at which the model is linearised

    def test(self, rng: np.random.Generator) -> SnoopingResult:
        """Test all readings from a robust start; `solution` may be fitted to gross errors, too."""
        every = np.ones(len(self.readings), dtype=np.bool_)
        point = linearised(self, self.solution.y)
        residual = point.linear.residuals(point.linear.tested)
        linear = point.with_nuisance(float(np.mean(residual**2)))
        t2 = linear.distances(linear.tested)[linear.tested]
        if t2.max() <= rejection_limit(linear.m, len(t2)):  # model and smooth functions explain all
            return SnoopingResult(every, every, 1.0)
        point, used = robust_start(linearised(self, self.y), rng)
        linear = point.linear
        d2, centre = linear.distances_from(linear.fitted(used))
        misfit = trimmed_variance(linear, d2, centre)
        linear = point.with_nuisance(misfit)
        for _ in range(MOST_ROUNDS):
            t2, centre = _tested(linear, used)
            updated, _ = nearest(linear, t2, centre)
            if np.array_equal(updated, used):
                break
            used = updated
        core = float(scipy.stats.chi2.ppf(START_QUANTILE, linear.m)) * trimmed_variance(
            linear, t2, centre
        )
        return self._screened(point, (t2 <= core) | centre, misfit)

    def retest(self, screened: SnoopingResult) -> SnoopingResult:
        """Repeat the test, from the readings that agreed in `screened` and their solution."""
        return self._screened(linearised(self, self.y), screened.agree, screened.misfit)

    def _screened(self, point: "_LinearModel", used: Bools, misfit: float) -> SnoopingResult:
        readings = self.readings
        every, of_law = np.ones_like(used), np.zeros_like(used)
        count = int(np.count_nonzero(point.linear.tested))
        while True:
            linear = point.with_nuisance(misfit)
            used, t2, scale = self._snooped(linear, used | of_law, of_law)
            agree = used | ~linear.tested
            off = np.flatnonzero(~agree)
            if self._accident(linear, off):
                return SnoopingResult(every, every, misfit)
            size = np.sqrt(scale * np.mean(np.trace(readings.covariance[:, :3, :3], 0, 1, 2)))
            if len(off) > MOST_WRONG * count or (
                scale > MISFIT_SCALES[1] and size > DISAGREEMENT_M
            ):
                off = np.flatnonzero((t2 > rejection_limit(linear.m, count)) & linear.tested)
                return SnoopingResult(every, every, misfit, Disagreement("many", off))
            if not len(off):
                return SnoopingResult(agree, every, misfit)
            white = linear.residuals(used)[off, :, None]
            shift = (np.linalg.pinv(linear.root[off]) @ white)[:, :, 0]
            axes = self.model.predict(readings.states[off], self.solution.theta).observation
            alike = runs_of_equal_shifts(readings, linear.tested, off, shift[:, :3], axes.rotation)
            single = ~np.isin(off, alike) & ~readings.scalar[off]  # a distance has no direction
            rows = off[single]
            # The rms over directions, of lengths and angles apart.
            std2 = np.diagonal(readings.covariance[rows], axis1=1, axis2=2)
            std2 = std2.reshape(len(rows), readings.m // 3, 3).mean(axis=2)
            unit = np.repeat(np.sqrt(std2), 3, axis=1)
            sites = point.sites[rows] / unit[:, :, None]
            law = rows[along_one_site(shift[single] / unit, sites, readings.pose[rows])]
            if not len(law):
                fitted = agree | np.isin(np.arange(len(agree)), alike)
                disagreement = Disagreement("alike", alike) if len(alike) else None
                return SnoopingResult(agree, self._fittable(linear, fitted), misfit, disagreement)
            of_law[law] = True
            residual = point.linear.residuals(used | of_law)[used | of_law]
            misfit = max(misfit, float(np.mean(residual**2)))

    def _snooped(
        self, linear: ReadingModel, used: Bools, of_law: Bools
    ) -> tuple[Bools, Floats, float]:
        """Return the good readings (N,), t² (N,) from the fit to them, and the scale of its bulk.

        It starts with the `used` readings (N,); those `of_law` (N,) always stay.
        """
        count = int(np.count_nonzero(linear.tested))
        for _ in range(MOST_ROUNDS):
            t2, centre = _tested(linear, used)
            judged = t2[used & (t2 > 0)]
            scale = bulk_scale(judged, linear.m) if len(judged) else 1.0
            far = max(
                rejection_limit(linear.m, count, scale), LEAST_T2_SHARE * float(t2[used].max())
            )
            updated = linear.with_lone_centres(((t2 <= far) & linear.tested) | of_law, centre)
            if np.array_equal(updated, used):
                break
            used = updated
        return used, t2, scale

    def _accident(self, linear: ReadingModel, off: Ints) -> bool:
        """Whether too many of the rows `off` are unloaded readings that deflections share."""
        shared = self.readings.unloaded & linear.tested & (linear.group >= 0)
        unloaded = int(np.count_nonzero(shared[off]))
        share = float(np.mean(shared[linear.tested]))
        return (
            unloaded > 0
            and float(scipy.stats.binom.sf(unloaded - 1, len(off), share)) < SHARED_LEVEL
        )

    def _fittable(self, linear: ReadingModel, agree: Bools) -> Bools:
        """Return `agree` (N,) without groups that lack a good loaded or a good unloaded reading."""
        if not len(linear.members):
            return agree
        unloaded, used = self.readings.unloaded[linear.members], agree.copy()
        good = agree[linear.members] & (linear.members >= 0)
        lost = ~((good & unloaded).any(axis=1) & (good & ~unloaded).any(axis=1))
        rows = linear.members[lost]
        used[rows[rows >= 0]] = False
        return used


@dataclass(frozen=True, eq=False)
class _LinearModel:
    """The linear model of all readings at coordinates y (P,)."""

    snooping: DataSnooping
    y: Floats
    live: Ints  # (K,) indices of the estimated coordinates, which are the columns of `linear`
    scale: Floats  # (K,) their ordinary magnitudes, the units of the columns
    prediction: Prediction
    linear: ReadingModel

    def moved(self, delta: Floats) -> "_LinearModel":
        y = self.y.copy()
        y[self.live] += self.scale * delta
        return linearised(self.snooping, y)

    @cached_property
    def sites(self) -> Floats:
        """(N, m, P) changes of the readings by each site of a law."""
        s = self.snooping
        return site_columns(s.model, s.solution.space.theta(self.y), self.prediction, s.readings)

    def with_nuisance(self, misfit: float) -> ReadingModel:
        """Return the linear model with smooth nuisance columns of variance `misfit` − 1."""
        s, rank = self.snooping, int(self.linear.elements_read[self.linear.tested].sum())
        columns = smooth_nuisance_columns(s.model, self.prediction, s.readings, rank)
        for k in range(0, len(columns), WHITENED_AT_ONCE):  # in place: the largest array of a fit
            rows = slice(k, k + WHITENED_AT_ONCE)
            columns[rows] = self.linear.root[rows] @ columns[rows]
        count = max(columns.shape[0] * columns.shape[1], 1)
        length = np.sqrt(np.einsum("nip,nip->p", columns, columns) / count)
        nonzero = length > 1e-9 * length.max(initial=0.0)
        size = np.sqrt(max(misfit - 1.0, 0.0) / max(int(np.count_nonzero(nonzero)), 1))
        columns *= np.where(nonzero, size / np.where(nonzero, length, 1.0), 0.0)
        return self.linear.with_columns(columns if nonzero.all() else columns[:, :, nonzero])


def linearised(snooping: DataSnooping, y: Floats) -> _LinearModel:
    """Return the linear model of all readings at the coordinates y (P,)."""
    model, readings, s = snooping.model, snooping.readings, snooping.solution
    theta = s.space.theta(y)
    prediction = model.predict(readings.states, theta)
    no_groups = np.zeros((0, 0), dtype=np.int64)
    members = _groups(readings) if snooping.mode == "deflection" else no_groups
    root = whitening_matrix(_covariance(readings, members))
    residual = _residual(readings, prediction, members)
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
        residual=(root @ residual[:, :, None])[:, :, 0],
        columns=root @ (jacobian * scale).reshape(*residual.shape, len(live)),
        precision=precision,
        pull=precision * y[live] / scale,
        root=root,
        members=members,
    )
    return _LinearModel(snooping, y, live, scale, prediction, linear)


def _groups(readings: Readings) -> Ints:
    """(G, S) rows that share unloaded readings, unloaded first, filled up with −1."""
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
    """(N, m, m) covariances, made positive for all readings of groups."""
    v = readings.covariance
    if not len(members):
        return v
    present = (members >= 0)[:, :, None, None]
    mean = np.sum(v[members] * present, axis=1) / present.sum(axis=1)
    out = v.copy()
    g, s = np.nonzero(members >= 0)
    out[members[g, s]] += COVARIANCE_RIDGE * mean[g]
    return out


def _residual(readings: Readings, prediction: Prediction, members: Ints) -> Floats:
    """(N, m) measured minus predicted; rotations of groups relative to an unloaded reading."""
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


def _tested(linear: ReadingModel, used: Bools) -> tuple[Floats, Bools]:
    """t² (N,) of all readings, and the centres of groups (N,)."""
    if not len(linear.members):
        return linear.distances(used), np.zeros_like(used)
    _, centre = linear.distances_from(linear.fitted(used))
    return linear.distances(linear.with_lone_centres(used, centre)), centre


def smooth_nuisance_columns(
    model: Model, prediction: Prediction, readings: Readings, rank: int
) -> Floats:
    """Columns (N, m, P) of smooth functions; the simplest ones where the `rank` is small."""
    situation, s = prediction.situation, readings.states
    moves = motion(
        model.cell, prediction.observation, situation.chain, prediction.deviation, readings.m
    )
    functions = [np.ones_like(situation.angle), situation.torque]
    if s.approach is not None:
        functions.append(s.approach)
    functions += [np.cos(situation.angle), np.sin(situation.angle)]
    joints = [moves.drives * f[:, None, :] for f in functions]
    links = [moves.by_slot(k) for k in range(situation.wrench.shape[1])]
    loads = [x[:, :, 3:5] * situation.wrench[:, k, None, 3:5] for k, x in enumerate(links)]
    drift = [] if s.time is None else [moves.by_station() * (s.time - s.time.mean())[:, None, None]]
    harmonics = [moves.drives * f(2 * situation.angle)[:, None, :] for f in (np.cos, np.sin)]
    most = int(MOST_SHARE * rank)
    return np.concatenate([*joints, *drift, *loads, *harmonics, *links], axis=2)[:, :, :most]


def runs_of_equal_shifts(
    readings: Readings, tested: Bools, off: Ints, shift: Floats, axes: Floats
) -> Ints:
    """Return the rows in runs with the same shift; none up to `MOST_ALIKE_SHARE` of the tested.

    `off` (F,) are the rows of the readings that deviate, ascending; `shift` (F, 3) their shifts in
    sensor axes; and `axes` (F, 3, 3) the rotations of the target in them.
    """
    order = np.zeros(len(readings), dtype=np.int64)
    alike = np.zeros(len(off), dtype=np.bool_)
    target = readings.target
    for k in np.unique(target[off]):
        rows = tested & (target == k)
        order[rows] = np.arange(np.count_nonzero(rows))
        i = np.flatnonzero(target[off] == k)
        turned = (shift[i, None] @ axes[i])[:, 0]
        alike[i] = _in_a_row(order[off[i]], shift[i]) | _in_a_row(order[off[i]], turned)
    few = np.count_nonzero(alike) <= MOST_ALIKE_SHARE * np.count_nonzero(tested)
    return off[:0] if few else off[alike]


def _in_a_row(order: Ints, shift: Floats) -> Bools:
    """(F,) which shifts (F, 3) belong to a run of at least `FEWEST_IN_RUN` equal ones.

    The readings between two of them, at most `MOST_BETWEEN`, deviate as well.
    """
    count = len(shift)
    run, size = np.arange(count), np.linalg.norm(shift, axis=1)
    for ahead in range(1, MOST_BETWEEN + 2):
        for k in range(count - ahead):
            j = k + ahead
            distance = np.linalg.norm(shift[j] - shift[k])
            if order[j] - order[k] == ahead and distance <= SAME_SHIFT * max(size[k], size[j]):
                run[run == run[j]] = run[k]
    return np.asarray(np.bincount(run, minlength=count)[run] >= FEWEST_IN_RUN)


def site_columns(model: Model, theta: Floats, prediction: Prediction, readings: Readings) -> Floats:
    """(N, m, P) changes of readings by each site, at last by 1 N and 1 N·m on the force sensor."""
    p, states, observation, m = prediction, readings.states, prediction.observation, readings.m
    moves = motion(model.cell, observation, p.situation.chain, p.deviation, m)
    turns = [moves.by_slot(k)[:, :, 3:] for k in range(p.situation.wrench.shape[1])]
    sensor = []
    for part in (slice(0, 3), slice(3, 6)):
        for axis in np.moveaxis(p.situation.chain.rotation[-1], 2, 0):
            wrench = states.wrench.copy()
            wrench[:, part] += axis
            try:
                o = model.predict(replace(states, wrench=wrench), theta).observation
            except CannotAnswerError:  # parameters so large that there is no equilibrium
                continue
            turn = se3.rotation_vector(o.rotation @ observation.rotation.swapaxes(1, 2))
            sensor.append(np.concatenate([o.position - observation.position, turn], axis=1)[:, :m])
    columns = [*turns, *(column[:, :, None] for column in sensor)]
    return np.concatenate(columns, axis=2)


def along_one_site(shift: Floats, columns: Floats, pose: Ints) -> Bools:
    """Return (F,) which readings that deviate are ascribed to a law, not to gross errors.

    `shift` (F, m) are their shifts, `columns` (F, m, P) their changes by each site of a law, `pose`
    (F,) their poses. The unit is the noise, equal in all directions, so that random shifts prefer
    none.
    """
    count, m, sites = columns.shape
    if not count:
        return np.zeros(0, dtype=np.bool_)
    square, length = np.sum(shift**2, axis=1), np.linalg.norm(columns, axis=1)
    along = np.einsum("fi,fip->fp", shift, columns) / np.where(length > 0, length, np.inf)
    normal = np.maximum(square[:, None] - along**2, 0.0)
    near = (
        normal
        <= (scipy.stats.chi2.isf(SITE_LEVEL, m - 1) + LINEARISATION_SHARE**2 * square)[:, None]
    )
    p = np.where(near, scipy.stats.beta.cdf(normal / square[:, None], (m - 1) / 2, 0.5), 1.0)
    ascending: Floats = np.sort(p[_different(shift, pose)], axis=0)
    count = len(ascending)
    so_many = np.asarray(scipy.stats.binom.sf(np.arange(count)[:, None], count, ascending))
    law = [
        k
        for k, least in enumerate(np.argmin(so_many, axis=0))
        if so_many[least, k] * count * sites < SITE_LEVEL
        and len(np.unique(pose[p[:, k] <= ascending[least, k]])) >= FEWEST_POSES
    ]
    return np.asarray(near[:, law].any(axis=1))


def _different(shift: Floats, pose: Ints) -> Bools:
    """(F,) readings whose shift no previous one at their pose has: a common cause counts once."""
    out = np.ones(len(pose), dtype=np.bool_)
    for rows in (np.flatnonzero(pose == p) for p in np.unique(pose)):
        size = np.linalg.norm(shift[rows], axis=1)
        distance = np.linalg.norm(shift[rows, None] - shift[rows], axis=2)
        same = distance <= SAME_SHIFT * np.maximum(size[:, None], size)
        out[rows] = ~np.tril(same, -1).any(axis=1)
    return out
