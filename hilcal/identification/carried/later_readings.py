"""An earlier fit as the prior of later readings of the same arm; frames may be new.

With the earlier estimate θ_A and its predictive covariance κC (`predictive`), the later readings
are

    y = f(θ_A + R u + F b + D δ) + e + p,    R Rᵀ = κC,  u ~ N(0, 1),  b and δ flat

b the twist of the base where the tracker was set up anew, δ changes of the arm (none to begin
with), e ~ N(0, a V) the noise and p = Z s, s ~ N(0, 1), what acts beside the model. That is a
misfit with the variance c V̄ that all readings of a pose share (several loads at one pose then
carry less information than as many poses), and effects that are no change of the arm: those of
temperatures that the earlier campaign did not have (`prediction.other_temperatures`), and those of
instruments that differ in every campaign, such as a tracker's drift. a + c is κσ², the variance
factor of the earlier fit at poses left out; the excess over the stated noise, κσ² − 1, is divided
between a and c by the residual (`earlier_fit`). The minimum over u, s, b and δ of

    ‖y − f − Z s‖² / (a V) + ‖u‖² + ‖s‖²

is rᵀ M r of the linearised problem (`regression.schur`): what the earlier fit does not
explain. Without any change it follows χ² with as many degrees of freedom as
there are elements beyond the flat parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hilcal.cell import Cell
from hilcal.effects.protocol import Effect, Role
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import LEVER_M
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import Fit, require_gc
from hilcal.identification.gauss_newton import shortened
from hilcal.identification.noise.arm_scatter import with_arm_scatter
from hilcal.identification.prediction.predictive import Predictive, predictive_of
from hilcal.identification.prediction.validation import other_target, require_columns
from hilcal.identification.registration.registration import register, targets_as_fitted
from hilcal.identification.residual import residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, covariance_blocks, whitening
from hilcal.regression.schur import Projection, projection
from hilcal.types import Floats

# All of these are choices.
STEPS = 20  # most Gauss-Newton steps; they converge within four
CONVERGED = 1e-4  # step that ends them, rms of the whitened rows
LARGEST_CHANGE = 1e4
"""Least change of a parameter, in ordinary magnitudes, that is refused; 10 m of a link."""
LEAST_MOTION = 1e-6
"""Directions of the prior that move readings by less, in σ, are left at its mean."""
LEAST_POSE_SHARE = 1e-3  # share of a pose in the misfit that is neglected
HALVINGS = 6  # of a step that makes the sum of squares grow


@dataclass(frozen=True, slots=True, eq=False)
class EarlierFit:
    """A gc-scaled fit, and its predictive distribution for readings that were not fitted."""

    fit: Fit
    predictive: Predictive
    root: Floats  # (P, K) R, root of κC
    noise: float  # a, variance of the noise in units of the stated one
    pose_variance: float  # c, variance of the misfit that all readings of a pose share, likewise


def earlier_fit(fit: Fit) -> EarlierFit:
    """Return a fit, which must be gc-scaled, with its predictive distribution."""
    require_gc(fit, "a comparison with later readings")
    predicted = predictive_of(fit)
    beyond = max(predicted.factor * predicted.scatter - 1.0, 0.0)
    shared = beyond * _share_by_pose(fit, predicted, fit.readings[~fit.outlier])
    root = _root(predicted.factor * predicted.covariance)
    return EarlierFit(fit, predicted, root, 1.0 + beyond - shared, shared)


def _root(covariance: Floats) -> Floats:
    values, vectors = np.linalg.eigh(covariance)
    return np.asarray(vectors[:, values > 0] * np.sqrt(values[values > 0]))


def _share_by_pose(fit: Fit, predicted: Predictive, inliers: Readings) -> float:
    """Share of the misfit on poses left out that all readings of a pose have in common.

    With r_i (3,) the residual of measurement i, predicted without its pose, V_ij the stated
    covariance of two measurements, J_i C J_jᵀ that of their predictions and τ_i² = tr V_ii, the
    shares a and c of

        r_iᵀ r_j = a tr V_ij + c τ_i τ_j + tr J_i C J_jᵀ

    are fitted to all i ≠ j of a pose and to i = j; 1 of a is the stated noise. Without two readings
    in a pose c is 0.
    """
    w, m, off = fit.whitening, fit.whitening.m, fit.left_out[:, :3]
    if len(np.unique(fit.pose)) == len(fit.pose):
        return 0.0
    tau = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2))
    measurement = np.empty(len(inliers), dtype=np.int64)
    measurement[w.reading] = np.arange(len(off))
    stated: dict[tuple[int, int], float] = {}
    for bucket, block in zip(w.buckets, covariance_blocks(inliers, w), strict=True):
        count = bucket.loaded.shape[1]
        parts = block.reshape(len(block), count, m, count, m)[:, :, :3, :, :3]
        traces = np.einsum("gaibi->gab", parts)
        a, b = np.triu_indices(count, 1)
        for rows, trace in zip(measurement[bucket.loaded], traces, strict=True):
            keys = zip(rows[a].tolist(), rows[b].tolist(), strict=True)
            stated.update(zip(keys, trace[a, b].tolist(), strict=True))
    jacobian = fit.model.jacobian(fit.solution.prediction, fit.theta, m)[:, :3]
    spread = w.raw(jacobian @ _root(predicted.covariance)).reshape(len(off), -1)
    x = [np.stack([tau**2, tau**2], axis=1)]
    y = [np.sum(off**2, axis=1) - np.sum(spread**2, axis=1)]
    for rows in (np.flatnonzero(fit.pose == p) for p in np.unique(fit.pose)):
        first, second = np.triu_indices(len(rows), 1)
        i, j = rows[first], rows[second]
        pairs = [stated.get((a, b), stated.get((b, a), 0.0)) for a, b in zip(i, j, strict=True)]
        x.append(np.stack([np.array(pairs), tau[i] * tau[j]], axis=1).reshape(-1, 2))
        y.append(np.sum(off[i] * off[j], axis=1) - (spread[rows] @ spread[rows].T)[first, second])
    a, c = np.linalg.lstsq(np.concatenate(x), np.concatenate(y), rcond=None)[0]
    scatter, shared = max(float(a) - 1.0, 0.0), max(float(c), 0.0)
    return shared / (scatter + shared) if scatter + shared > 0.0 else 0.0


@dataclass(frozen=True, slots=True, eq=False)
class EffectDirections:
    """A change of the arm: an effect that is added, with some directions of its parameters."""

    effect: Effect  # with a name that the model lacks; several changes may share one
    directions: Floats  # (P, k) D, in units of the effect's parameters


@dataclass(frozen=True, slots=True, eq=False)
class LaterReadings:
    """Later readings, and the parameters that may explain them without a change of the arm."""

    earlier: EarlierFit
    readings: Readings  # the later ones
    w: Whitening  # their scaling, by the stated noise
    model: Model  # the earlier effects; the tracker's new place where it was set up anew
    mean: Floats  # (P,) prior mean of its parameters
    lift: Floats  # (P, K) directions that are free: R, and those of the frame
    ridge: Floats  # (K,) 1 for those with a prior, 0 for flat ones
    nuisance: Floats  # (R, L) rows of Z, in units of the noise √a
    anew: bool  # whether the tracker was set up anew
    frames: int  # number of parameters of frames that are estimated anew, the last ones
    cell: Cell | None  # of the later campaign; None: that of the earlier fit

    def without(self, row: int) -> "LaterReadings":
        """Return the same without a reading."""
        readings = self.readings[np.arange(len(self.readings)) != row]
        return later_readings(self.earlier, readings, anew=self.anew, cell=self.cell)

    def scaled(self, white: Floats) -> Floats:
        """Whitened rows (R, ...) in units of the noise."""
        alone = len(np.unique(self.w.group)) == len(self.w)
        a = self.earlier.noise + (self.earlier.pose_variance if alone else 0.0)
        return np.asarray(white / np.sqrt(a))


@dataclass(frozen=True, eq=False)
class LaterFit:
    """Later readings explained by an earlier fit and changes: rows R, coordinates K and L."""

    later: LaterReadings  # the readings and the earlier fit
    model: Model  # that of `later`, and the changes
    mean: Floats  # (P,) prior mean of its parameters
    lift: Floats  # (P, K) directions of u, b and δ
    ridge: Floats  # (K + L,) of these and of s: 1 for those with a prior, 0 for flat ones
    coordinates: Floats  # (K + L,) u, b, δ and s

    @cached_property
    def theta(self) -> Floats:
        """(P,) parameters; raises CannotAnswerError where they have no static equilibrium."""
        step = self.lift @ self.coordinates[: self.lift.shape[1]]
        if np.any(np.abs(step) > LARGEST_CHANGE * scales_of(self.model)):
            raise CannotAnswerError("a change of such a size has no static equilibrium")
        return np.asarray(self.mean + step)

    @cached_property
    def prediction(self) -> Prediction:
        """Prediction of the readings."""
        return self.model.predict(self.later.readings.states, self.theta)

    @cached_property
    def raw(self) -> Floats:
        """(D, m) residual, sensor axes."""
        return residual(self.later.readings, self.prediction, self.later.w)

    @cached_property
    def white(self) -> Floats:
        """(R,) residual in units of the noise √a."""
        return self.later.scaled(self.later.w.whiten(self.raw).reshape(-1))

    @cached_property
    def projection(self) -> Projection:
        """M, of rows in units of the noise √a."""
        w = self.later.w
        jacobian = self.model.jacobian(self.prediction, self.theta, w.m)
        moved = self.later.scaled(w.whiten(w.raw(jacobian @ self.lift)))
        return projection(np.hstack([moved, self.later.nuisance]), self.ridge)

    @cached_property
    def target(self) -> Floats:
        """(R,) r, with respect to the prior mean."""
        count = self.lift.shape[1]
        rows = self.projection.rows[:, :count]
        return np.asarray(self.white + rows @ self.coordinates[:count])

    @property
    def square(self) -> float:
        """The minimised sum of squares."""
        remaining = self.white - self.later.nuisance @ self.coordinates[self.lift.shape[1] :]
        return float(remaining @ remaining + self.ridge @ self.coordinates**2)

    @property
    def rss(self) -> float:
        """rᵀ M r."""
        return float(self.target @ self.projection.project_out(self.target))

    @property
    def free(self) -> int:
        """Number of flat parameters that the readings determine."""
        determined = np.count_nonzero(np.any(self.projection.inverse_root, axis=1))
        return int(determined) - int(np.count_nonzero(self.ridge))

    @property
    def dof(self) -> float:
        """Degrees of freedom of rᵀ M r."""
        return float(self.later.w.rank - self.free)

    @property
    def sizes(self) -> Floats:
        """(k,) δ of all changes, in order."""
        return self.coordinates[self.later.lift.shape[1] : self.lift.shape[1]]

    @property
    def inverse(self) -> Floats:
        """(k, k) covariance of δ in units of the noise a."""
        root = self.projection.inverse_root[:, self.later.lift.shape[1] : self.lift.shape[1]]
        return np.asarray(root.T @ root)

    def columns(self, moving: EffectDirections) -> tuple[Floats, Floats]:
        """Return rows (R, k) of a change, and the motion (D, 3, k) of the target it makes, m."""
        w = self.later.w
        jacobian = self.model.jacobian_of((moving.effect,), self.prediction, self.theta, w.m)
        raw = w.raw(jacobian @ moving.directions)
        return self.later.scaled(w.whiten(raw)), raw[:, :3]

    def moved(self, step: Floats) -> "LaterFit":
        """Return the same after a step (K + L,) of the coordinates."""
        return replace(self, coordinates=self.coordinates + step)


def later_readings(
    earlier: EarlierFit, readings: Readings, *, anew: bool, cell: Cell | None = None
) -> LaterReadings:
    """Prepare the comparison of later readings with an earlier fit.

    With `anew` the place of the tracker is estimated. Of the later campaign's `cell` the tool is
    used, and the targets where they differ.

    Raises:
        InputError: an effect needs a column that the readings lack; or, for deflections, a loaded
            reading without its unloaded one.
        CannotAnswerError: the readings do not determine the tracker's place.
    """
    fit = earlier.fit
    require_columns(fit.model, readings, "later")
    flat: list[Role] = ["registration"] if anew else []
    later_cell = fit.model.cell
    if cell is not None:
        later_cell = replace(
            later_cell, tool_mass=cell.tool_mass, tool_com=cell.tool_com, load_point=cell.load_point
        )
        if other_target(fit.model.cell, cell):
            flat.append("target")
            later_cell = later_cell.with_targets(cell.all_targets, cell.known_targets)
    if readings.states.observer is not None:  # observers are set up anew for every campaign
        later_cell = replace(later_cell, observers=()).observed_by(readings.observers)
        flat = [*(role for role in flat if role != "registration" or later_cell.tied), "observer"]
    later_cell, rms = _placed(fit, later_cell, flat, readings) if flat else (later_cell, 0.0)
    scatter = fit.readings.arm_scatter
    if scatter is not None and readings.arm_scatter is None:
        readings = with_arm_scatter(later_cell, readings, scatter)
    w = whitening(readings, fit.mode, "gc")
    states, slices = fit.readings[~fit.outlier].states, fit.model.slices()
    parts = [
        p
        for p in zip(fit.model.effects, slices, strict=True)
        if p[0].role not in flat and not _differs_by_campaign(p[0])
    ]
    if "target" in flat and later_cell.target_known:
        flat.remove("target")
    kinds = fit.model.catalogue.with_role(*flat) if flat else ()
    frames = [kind(later_cell, states) for kind in kinds]
    effects = tuple(type(e)(later_cell, states, e.options) for e, _ in parts)
    model = replace(fit.model, cell=later_cell, effects=(*effects, *frames))
    count = sum(len(e.parameters) for e in effects)
    mean, lift = np.zeros(model.size), np.zeros((model.size, earlier.root.shape[1]))
    if parts:
        mean[:count] = np.concatenate([fit.theta[s] for _, s in parts])
        lift[:count] = np.concatenate([earlier.root[s] for _, s in parts])
    # Directions of the prior that do not move the readings stay at its mean.
    _, values, vectors = np.linalg.svd(_rows(model, mean, lift, readings, w), full_matrices=False)
    lift = lift @ vectors[values > LEAST_MOTION * max(float(values.max(initial=0.0)), 1.0)].T
    size = scales_of(model)[count:]
    if fit.mode == "deflection":  # deflections determine only the turns of frames
        size = np.array(
            [rms if p.unit == "m" else rms / LEVER_M for f in frames for p in f.parameters]
        )
    free = np.full(len(size), 1.0 if fit.mode == "deflection" else 0.0)
    ridge = np.concatenate([np.ones(lift.shape[1]), free])
    lift = np.hstack([lift, np.eye(model.size)[:, count:] * size])
    later = LaterReadings(
        earlier, readings, w, model, mean, lift, ridge, _pose_rows(earlier, w), anew,
        len(mean) - count, cell,
    )  # fmt: skip
    unnamed = later.scaled(w.whiten(w.raw(_unnamed_rows(later))))
    return replace(later, nuisance=np.hstack([later.nuisance, unnamed]))


def with_frames_only(later: LaterReadings) -> LaterReadings:
    """Return the setting with the earlier parameters fixed; frames are free."""
    moves = np.any(later.lift[len(later.mean) - later.frames :] != 0.0, axis=0)
    none = later.nuisance[:, :0]
    return replace(later, lift=later.lift[:, moves], ridge=later.ridge[moves], nuisance=none)


def directions_beside_frames(later: LaterReadings) -> Floats:
    """(P, K) directions of the prior, each with the motion of frames that absorbs most of it."""
    frames = np.any(later.lift[len(later.mean) - later.frames :] != 0.0, axis=0)
    prior = later.lift[:, ~frames]
    if not frames.any():
        return prior
    rows = _rows(later.model, later.mean, later.lift, later.readings, later.w)
    absorbed = np.linalg.lstsq(rows[:, frames], rows[:, ~frames], rcond=None)[0]
    return np.asarray(prior - later.lift[:, frames] @ absorbed)


def _placed(fit: Fit, cell: Cell, flat: Sequence[Role], readings: Readings) -> tuple[Cell, float]:
    """Return the cell registered to the readings, and the rms error of the registration, m."""
    held = cell
    if "target" not in flat:
        placed = targets_as_fitted(fit.model, fit.theta)
        held = cell.with_targets(placed, (True,) * len(placed))
    r = register(replace(held, registration_known="registration" not in flat), readings)
    moved = replace(cell, registration=r.cell.registration, observers=r.cell.observers)
    if "target" in flat:
        moved = moved.with_targets(r.cell.all_targets)
    return moved, max(r.rms, 1e-6)


def _rows(model: Model, mean: Floats, lift: Floats, readings: Readings, w: Whitening) -> Floats:
    """Whitened rows (R, K) of the readings by directions (P, K) of the parameters."""
    prediction = model.predict(readings.states, mean)
    return w.whiten(w.raw(model.jacobian(prediction, mean, w.m) @ lift))


def _differs_by_campaign(effect: Effect | type[Effect]) -> bool:
    """Whether an effect is of the instruments, and another one in every campaign."""
    return effect.of_setup and effect.role == "effect" and effect.change is None


def _unnamed_rows(later: LaterReadings) -> Floats:
    """Rows (N, m, L) of effects that act on the later readings and are no change of the arm.

    Those of temperature that the earlier model does not name, where it is warmer or colder than in
    its readings, and those that differ in every campaign, of their ordinary sizes.
    """
    model, states, m = later.model, later.readings.states, later.w.m
    other = later.earlier.predictive.other_temperatures
    rows = [] if other is None else [other.rows(states, m, model.cell)]
    for kind in model.catalogue.effects:
        if _differs_by_campaign(kind) and kind.computable(states) and kind.applies(model.cell):
            e = model.catalogue.make(kind.name, model.cell, states, m=m)
            at = model.predict(states, later.mean)
            rows.append(model.jacobian_of((e,), at, later.mean, m) * e.magnitudes)
    return np.concatenate([np.zeros((len(states), m, 0)), *rows], axis=2)


def _pose_rows(earlier: EarlierFit, w: Whitening) -> Floats:
    """Rows (R, L) of a misfit that is common to the measurements of a pose, with its spread."""
    shared = earlier.pose_variance / earlier.noise
    poses, pose = np.unique(w.group, return_inverse=True)
    if shared < LEAST_POSE_SHARE or len(poses) == len(w):
        return np.zeros((len(w) * w.m, 0))
    out = np.zeros((len(w), w.m, len(poses), w.m))
    std = np.sqrt(shared * np.diagonal(w.covariance, axis1=1, axis2=2))
    element = np.arange(w.m)
    out[np.arange(len(w))[:, None], element, pose.reshape(-1)[:, None], element] = std
    return w.whiten(out.reshape(len(w), w.m, -1))


def fit_later(
    later: LaterReadings, changes: Sequence[EffectDirections] = (), start: LaterFit | None = None
) -> LaterFit:
    """Find the minimum by Gauss-Newton on the exact chain, with flat changes of the arm.

    `start` may be a minimum with the first changes. CannotAnswerError: no static equilibrium.
    """
    k, sizes = later.lift.shape[1], [c.directions.shape[1] for c in changes]
    effects = tuple({id(c.effect): c.effect for c in changes}.values())
    model = replace(later.model, effects=(*later.model.effects, *effects))
    lift = np.zeros((model.size, k + sum(sizes)))
    lift[: len(later.lift), :k] = later.lift
    place = dict(zip(map(id, model.effects), model.slices(), strict=True))
    for c, end in zip(changes, np.cumsum(sizes), strict=True):
        lift[place[id(c.effect)], k + end - c.directions.shape[1] : k + end] = c.directions
    ridge = np.concatenate([later.ridge, np.zeros(sum(sizes)), np.ones(later.nuisance.shape[1])])
    mean = np.concatenate([later.mean, np.zeros(len(lift) - len(later.mean))])
    x = np.zeros(len(ridge))
    if start is not None:
        count = k + len(start.sizes)
        x[:count] = start.coordinates[:count]
        x[lift.shape[1] :] = start.coordinates[count:]
    point = LaterFit(later, model, mean, lift, ridge, x)
    for _ in range(STEPS):
        m = point.projection
        step = m.solve(m.rows.T @ point.target) - point.coordinates
        if float(np.linalg.norm(m.rows @ step)) < CONVERGED * np.sqrt(len(point.target)):
            break
        nearer = shortened(point.moved, step, HALVINGS, lambda p: p.square, point.square)
        if nearer is None:
            break
        point = nearer
    return point
