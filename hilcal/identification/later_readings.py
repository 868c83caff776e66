"""An earlier fit at later readings of the same arm: what it knows is the prior, frames may be new.

With θ_A and κC the earlier estimate and the covariance of what it predicts by (`predictive`), the
later readings are

    y = f(θ_A + R u + F b + D δ) + e + p,    R Rᵀ = κC,  u ~ N(0, 1),  b and δ flat

b the twist of the base where the tracker was set up anew, δ changes of the arm (none to begin
with), e ~ N(0, a V) the noise and p ~ N(0, c V̄) a misfit that all readings of a pose share. a + c
is the factor κσ² by which the earlier fit missed poses that it had left out; what is beyond the
stated noise, κσ² − 1, is divided as its residual says. The minimum over u, p, b and δ of

    ‖y − f‖² / (a V) + ‖u‖² + ‖p‖² / (c V̄)

is rᵀ M r of the linearised problem (`regression.projection`): what the earlier fit, by its own
statement, does not explain. Without any change it follows χ² with as many degrees of freedom as
there are elements beyond the flat parameters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hilcal.cell import Cell
from hilcal.config.cell import Tool
from hilcal.effects.protocol import FRAME_ROLES, Effect, Role
from hilcal.effects.target_offset import TargetOffset
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.arm_scatter import with_arm_scatter
from hilcal.identification.baseline import ARM
from hilcal.identification.earlier_fit import EarlierFit
from hilcal.identification.fit import Fit
from hilcal.identification.priors import scales_of
from hilcal.identification.registration import register
from hilcal.identification.residual import residual
from hilcal.identification.solver import shortened
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.projection import Projection, projection
from hilcal.types import Floats

STEPS = 20
"""Most Gauss-Newton steps; a choice, they converge within four."""
CONVERGED = 1e-4
"""Step that ends them, rms of the whitened rows; a choice."""
ABSURD = 1e4
"""Change of a parameter, in ordinary magnitudes, that is not tried; 10 m of a link. A choice."""
LEAST = 1e-6
"""Directions of the prior that move the readings by less, in σ, are left at its mean; a choice."""
LEAST_SHARED = 1e-3
"""Share of a pose in the misfit that is neglected; a choice."""
HALVINGS = 6
"""Most halvings of a step that makes the sum of squares grow; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Moving:
    """A change of the arm: an effect that is added, with some directions of its parameters.

    Attributes:
        effect: the effect, of another name than those of the model; several changes may be of one.
        directions: (P, k) D, in units of the effect's parameters.
    """

    effect: Effect
    directions: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Setting:
    """Later readings, and what is free to explain them without any change of the arm.

    Attributes:
        earlier: the earlier fit.
        readings: the later readings.
        w: their scaling, by the stated noise.
        model: the earlier effects; the tracker's new place where it was set up anew.
        mean: (P,) prior mean of its parameters.
        lift: (P, K) directions that are free: R, and those of the frame.
        ridge: (K,) 1 for those with a prior, 0 for flat ones.
        poses: (R, L) rows of the misfit of each pose, in units of the noise √a.
        anew: whether the tracker was set up anew.
        frames: number of parameters of frames that are estimated anew, the last ones.
    """

    earlier: EarlierFit
    readings: Readings
    w: Whitening
    model: Model
    mean: Floats
    lift: Floats
    ridge: Floats
    poses: Floats
    anew: bool
    frames: int


@dataclass(frozen=True, eq=False)
class Remeasured:
    """Later readings beside an earlier fit and some changes of the arm, at some coordinates.

    R whitened rows, K coordinates u, b and δ, L coordinates p, P parameters.

    Attributes:
        setting: what the readings are explained by.
        changes: of the arm.
        model: that of the setting, and the changes.
        mean: (P,) prior mean of its parameters.
        lift: (P, K) directions of u, b and δ.
        ridge: (K + L,) of these and of p: 1 for those with a prior, 0 for flat ones.
        coordinates: (K + L,) u, b, δ and p.
    """

    setting: Setting
    changes: tuple[Moving, ...]
    model: Model
    mean: Floats
    lift: Floats
    ridge: Floats
    coordinates: Floats

    @cached_property
    def theta(self) -> Floats:
        """(P,) parameters.

        Raises:
            CannotAnswerError: they are beyond what has a static equilibrium.
        """
        step = self.lift @ self.coordinates[: self.lift.shape[1]]
        if np.any(np.abs(step) > ABSURD * scales_of(self.model)):
            raise CannotAnswerError("a change of such a size has no static equilibrium")
        return np.asarray(self.mean + step)

    @cached_property
    def prediction(self) -> Prediction:
        """Prediction of the readings."""
        return self.model.predict(self.setting.readings.states, self.theta)

    @cached_property
    def raw(self) -> Floats:
        """(D, m) residual, sensor axes."""
        return residual(self.setting.readings, self.prediction, self.setting.w)

    @cached_property
    def white(self) -> Floats:
        """(R,) residual in units of the noise √a."""
        return _scaled(self.setting, self.setting.w.whiten(self.raw).reshape(-1))

    @cached_property
    def projection(self) -> Projection:
        """M, of rows in units of the noise √a."""
        w = self.setting.w
        jacobian = self.model.jacobian(self.prediction, self.theta, w.m)
        moved = _scaled(self.setting, w.whiten(w.raw(jacobian @ self.lift)))
        return projection(np.hstack([moved, self.setting.poses]), self.ridge)

    @cached_property
    def target(self) -> Floats:
        """(R,) r, with respect to the prior mean."""
        count = self.lift.shape[1]
        rows = self.projection.rows[:, :count]
        return np.asarray(self.white + rows @ self.coordinates[:count])

    @property
    def square(self) -> float:
        """What is minimised."""
        left = self.white - self.setting.poses @ self.coordinates[self.lift.shape[1] :]
        return float(left @ left + self.ridge @ self.coordinates**2)

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
        return float(self.setting.w.rank - self.free)

    @property
    def sizes(self) -> Floats:
        """(k,) δ of all changes, in order."""
        return self.coordinates[self.setting.lift.shape[1] : self.lift.shape[1]]

    @property
    def inverse(self) -> Floats:
        """(k, k) covariance of δ in units of the noise a."""
        own = self.projection.inverse_root[:, self.setting.lift.shape[1] : self.lift.shape[1]]
        return np.asarray(own.T @ own)

    def columns(self, moving: Moving) -> tuple[Floats, Floats]:
        """Return rows (R, k) of a change, and the motion (D, 3, k) of the target it makes, m."""
        w = self.setting.w
        jacobian = self.model.jacobian_of((moving.effect,), self.prediction, self.theta, w.m)
        raw = w.raw(jacobian @ moving.directions)
        return _scaled(self.setting, w.whiten(raw)), raw[:, :3]

    def moved(self, step: Floats) -> "Remeasured":
        """Return them after a step (K + L,)."""
        return replace(self, coordinates=self.coordinates + step)


def setting(
    earlier: EarlierFit, readings: Readings, *, anew: bool, cell: Cell | None = None
) -> Setting:
    """Prepare the comparison of later readings with an earlier fit.

    Args:
        earlier: the earlier fit.
        readings: later readings.
        anew: whether the tracker was set up anew, so that its place is estimated.
        cell: the later campaign's; its tool is used, and its target where that is another one.

    Raises:
        InputError: an effect needs a column that the readings lack; or, for deflections, a loaded
            reading without its unloaded one.
        CannotAnswerError: the readings do not determine the tracker's place.
    """
    fit = earlier.fit
    for effect in fit.model.effects:
        if effect.role not in FRAME_ROLES and not effect.computable(readings.states):
            raise InputError(
                f"effect {effect.name} needs {', '.join(effect.needs)}, which the later readings "
                "do not have"
            )
    flat: list[Role] = ["registration"] if anew else []
    now = fit.model.cell
    if cell is not None:
        now = replace(
            now, tool_mass=cell.tool_mass, tool_com=cell.tool_com, load_point=cell.load_point
        )
        if other_target(fit.model.cell, cell):
            flat.append("target")
            now = now.with_targets(cell.all_targets, cell.known_targets)
    if readings.states.observer is not None:  # they are set up anew for every campaign
        now = replace(now, observers=()).observed_by(readings.observers)
        flat = [*(role for role in flat if role != "registration" or now.tied), "observer"]
    now, rms = _placed(fit, now, flat, readings)
    scatter = fit.readings.arm_scatter
    if scatter is not None and readings.arm_scatter is None:
        readings = with_arm_scatter(now, readings, scatter)
    w = whitening(readings, fit.mode, "gc")
    states, catalogue = fit.readings[~fit.outlier].states, fit.model.catalogue
    parts = [
        (e, s)
        for e, s in zip(fit.model.effects, fit.model.slices(), strict=True)
        if e.role not in flat
    ]
    if "target" in flat and now.target_known:
        flat.remove("target")
    frames = [kind(now, states) for kind in catalogue.with_role(*flat)] if flat else []
    effects = tuple(type(e)(now, states, e.options) for e, _ in parts)
    model = replace(fit.model, cell=now, effects=(*effects, *frames))
    count = sum(len(e.parameters) for e in effects)
    mean, lift = np.zeros(model.size), np.zeros((model.size, earlier.root.shape[1]))
    if parts:
        mean[:count] = np.concatenate([fit.theta[s] for _, s in parts])
        lift[:count] = np.concatenate([earlier.root[s] for _, s in parts])
    lift = lift @ _visible(model, mean, lift, readings, w).T
    of_frames = np.eye(model.size)[:, count:] * scales_of(model)[count:]
    free = np.zeros(of_frames.shape[1])
    if fit.mode == "deflection":  # deflections tell of frames only how they are turned
        known = [rms if p.unit == "m" else rms / ARM for f in frames for p in f.parameters]
        of_frames, free = np.eye(model.size)[:, count:] * np.array(known), free + 1.0
    ridge = np.concatenate([np.ones(lift.shape[1]), free])
    lift = np.hstack([lift, of_frames])
    poses = _pose_rows(earlier, w)
    return Setting(earlier, readings, w, model, mean, lift, ridge, poses, anew, len(mean) - count)


def frames_alone(at: Setting) -> Setting:
    """Return the setting in which the earlier parameters stay as they were; frames are free."""
    known = len(at.mean) - at.frames
    moves = np.any(at.lift[known:] != 0.0, axis=0)
    none = at.poses[:, :0]
    return replace(at, lift=at.lift[:, moves], ridge=at.ridge[moves], poses=none)


def beside_frames(at: Setting) -> Floats:
    """(P, K) directions of the prior, each with the motion of the free frames that absorbs most."""
    frames = np.any(at.lift[len(at.mean) - at.frames :] != 0.0, axis=0)
    own = at.lift[:, ~frames]
    if not frames.any():
        return own
    prediction = at.model.predict(at.readings.states, at.mean)
    jacobian = at.model.jacobian(prediction, at.mean, at.w.m)
    seen = at.w.whiten(at.w.raw(jacobian @ at.lift))
    absorbed = np.linalg.lstsq(seen[:, frames], seen[:, ~frames], rcond=None)[0]
    return np.asarray(own - at.lift[:, frames] @ absorbed)


def other_target(one: Cell, other: Cell) -> bool:
    """Whether another target is configured, or another place of it on the flange."""
    if one.target_names != other.target_names:
        return True
    before, after = (c.config.tool if c.config else None for c in (one, other))
    return _targets(before) != _targets(after)


def _targets(tool: Tool | None) -> object:
    return None if tool is None else (tool.target_m, tool.target_rotvec_rad, tool.targets)


def _placed(fit: Fit, now: Cell, flat: Sequence[Role], readings: Readings) -> tuple[Cell, float]:
    """Return the cell with frames as registered to the readings, and the rms error of that, m."""
    if not flat:
        return now, 0.0
    targets, known = now.all_targets, now.known_targets
    if "target" not in flat:
        known = (True,) * len(targets)
        for e, mine in zip(fit.model.effects, fit.model.slices(), strict=True):
            if isinstance(e, TargetOffset):
                targets = e.displaced(fit.theta[mine])
    held = now.with_targets(targets, known)
    held = replace(held, registration_known="registration" not in flat)
    found = register(held, readings)
    placed = replace(now, registration=found.cell.registration, observers=found.cell.observers)
    if "target" in flat:
        placed = placed.with_targets(found.cell.all_targets)
    return placed, max(found.rms, 1e-6)


def _visible(model: Model, mean: Floats, root: Floats, readings: Readings, w: Whitening) -> Floats:
    """(K', K) directions of the prior that the readings see; the others stay at its mean."""
    prediction = model.predict(readings.states, mean)
    seen = w.whiten(w.raw(model.jacobian(prediction, mean, w.m) @ root))
    _, values, vectors = np.linalg.svd(seen, full_matrices=False)
    return np.asarray(vectors[values > LEAST * max(float(values.max(initial=0.0)), 1.0)])


def _pose_rows(earlier: EarlierFit, w: Whitening) -> Floats:
    """Rows (R, L) of a misfit that is common to the measurements of a pose, with its spread."""
    shared = earlier.by_pose / earlier.noise
    poses, of = np.unique(w.group, return_inverse=True)
    if shared < LEAST_SHARED or len(poses) == len(w):
        return np.zeros((len(w) * w.m, 0))
    out = np.zeros((len(w), w.m, len(poses), w.m))
    std = np.sqrt(shared * np.diagonal(w.covariance, axis1=1, axis2=2))
    each = np.arange(w.m)
    out[np.arange(len(w))[:, None], each, of.reshape(-1)[:, None], each] = std
    return w.whiten(out.reshape(len(w), w.m, -1))


def _scaled(at: Setting, white: Floats) -> Floats:
    """Whitened rows (R, ...) in units of the noise."""
    alone = len(np.unique(at.w.group)) == len(at.w)
    a = at.earlier.noise + (at.earlier.by_pose if alone else 0.0)
    return np.asarray(white / np.sqrt(a))


def remeasure(
    at: Setting, changes: Sequence[Moving] = (), start: Remeasured | None = None
) -> Remeasured:
    """Find the minimum by Gauss-Newton on the exact chain.

    Args:
        at: the later readings.
        changes: of the arm, with flat parameters.
        start: a minimum with the first of these changes.

    Raises:
        CannotAnswerError: no static equilibrium.
    """
    k, sizes = at.lift.shape[1], [c.directions.shape[1] for c in changes]
    effects = tuple({id(c.effect): c.effect for c in changes}.values())
    model = replace(at.model, effects=(*at.model.effects, *effects))
    lift = np.zeros((model.size, k + sum(sizes)))
    lift[: len(at.lift), :k] = at.lift
    place = dict(zip(map(id, model.effects), model.slices(), strict=True))
    for c, end in zip(changes, np.cumsum(sizes), strict=True):
        lift[place[id(c.effect)], k + end - c.directions.shape[1] : k + end] = c.directions
    ridge = np.concatenate([at.ridge, np.zeros(sum(sizes)), np.ones(at.poses.shape[1])])
    mean = np.concatenate([at.mean, np.zeros(len(lift) - len(at.mean))])
    x = np.zeros(len(ridge))
    if start is not None:
        before = k + len(start.sizes)
        x[:before] = start.coordinates[:before]
        x[lift.shape[1] :] = start.coordinates[before:]
    here = Remeasured(at, tuple(changes), model, mean, lift, ridge, x)
    for _ in range(STEPS):
        m = here.projection
        step = m.solve(m.rows.T @ here.target) - here.coordinates
        if float(np.linalg.norm(m.rows @ step)) < CONVERGED * np.sqrt(len(here.target)):
            break
        nearer = shortened(here.moved, step, HALVINGS, lambda p: p.square, here.square)
        if nearer is None:
            break
        here = nearer
    return here
