"""The pose of the tool by a model, and its inverse: joint values that put it at its target pose.

The tool in base axes, without the instruments (effects with fields "station" and "scale"):

    T_base_tool = T_base_chain T_chain_flange(q, w) T_chainflange_flange T_flange_tool

`identification.registration.robot_frames` declares base and flange.

Newton's method on T(q) = T_wanted starts from the commanded joint values and stays on their branch:

    q ← q + J⁺ e,   e = (p_wanted − p, Log(R_wanted Rᵀ)),   J = ∂(p, ω)/∂q by the chain alone

Each residual e is of the full model at equilibrium, so the solution is exact. J lacks the effects,
which costs a step or two more; each step reduces e about 10³ times.

An arm with fewer than six joints of independent values cannot correct all of a pose. There the
position is met, and the orientation is as near as the remaining freedom of the joints allows:

    q ← q + J_p⁺ e_p + (J_r N)⁺ (e_r − J_r J_p⁺ e_p),   N = I − J_p⁺ J_p
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from hilcal.calibration.measured import Outside
from hilcal.effects.protocol import FRAME_ROLES, Effect
from hilcal.errors import InputError
from hilcal.identification.registration.robot_frames import robot_frames, state_with_every_column
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import States
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import Chain, evaluate, joint_jacobian
from hilcal.shown import Brief, Tabular
from hilcal.types import Bools, Floats, Ints

if TYPE_CHECKING:
    from hilcal.calibration.calibration import Calibration

TOLERANCE = 1e-10
"""Residual at which a point is solved, m and rad."""
MAX_STEPS = 30
"""Newton steps at most; four are usual."""
MOST_TURNED = 0.02
"""Largest angle, rad, from a target orientation that an arm with few joints cannot have: several
times the errors of arms. A choice."""
MAX_JOINT_STEP = 0.2
"""Largest step of a joint, rad; longer ones are shortened, so that the branch stays the same."""
MIN_SINGULAR_RATIO = 1e-3
"""Ratio of the smallest to the largest singular value of J, lengths in units of the reach, below
which a pose is singular: joints may turn a thousand times as far as the tool. A choice."""

Pose = tuple[Floats, Floats, Chain]
"""Orientation (N, 3, 3) and position (N, 3) of the tool, base axes, with the chain."""


@dataclass(frozen=True, slots=True, eq=False)
class ToolPose:
    """A tool on the flange of a fitted arm."""

    model: Model  # its target is the tool; without effects that place another target
    theta: Floats  # (P,) its parameters
    columns: Ints  # (P,) indices of these parameters in the fitted model
    nominal: Floats  # (4, 4) T_flange_tool
    pose: Floats  # (4, 4) T_chainflange_tool, the same on the flange of the fitted chain
    registered: Floats  # (4, 4) from the axes of the registration to those of the base
    base: Floats  # (4, 4) from the axes of the chain to those of the base, constant effects alone
    frames: tuple[tuple[Effect, slice], ...]
    """Effects that place the base, with the slices of their parameters."""
    moving: tuple[tuple[Effect, slice], ...]
    """Other effects that move base or target, with the slices of their parameters."""


def tool_of(
    model: Model, theta: Floats, pose: Floats | None, flange: Floats | None = None
) -> ToolPose:
    """Return the tracked target as fitted, or a tool with another pose T_flange_tool (4, 4).

    `flange` (4, 4): that of the other tool, in axes of the fitted one; None: the fitted one.
    """
    index = np.arange(model.size)
    robot = robot_frames(model, theta)
    flange = robot.flange if flange is None else robot.flange @ flange
    if pose is None:
        nominal, tool_model, columns = robot.declared[0], model, index
    else:
        nominal, used = pose, [e for e in model.effects if e.role != "target"]
        parts = [index[s] for e, s in zip(model.effects, model.slices(), strict=True) if e in used]
        columns = np.concatenate([index[:0], *parts])
        cell = replace(model.cell, targets=None, target_names=(), targets_known=())
        cell = replace(cell, target=flange @ pose, target_known=True)
        tool_model = replace(model, cell=cell, effects=tuple(used))
    state = state_with_every_column(tool_model.cell)
    if tool_model.cell.targets is not None:
        state = replace(state, target=np.zeros(1, dtype=np.int64))
    situation = tool_model.predict(state, theta[columns]).situation
    pairs = list(zip(tool_model.effects, tool_model.slices(), strict=True))
    moving = [
        (e, part)
        for e, part in pairs
        if e.role not in FRAME_ROLES
        and any(c.field in ("target", "base") for c in e.columns(situation))
    ]
    return ToolPose(
        model=tool_model,
        theta=theta[columns],
        columns=columns,
        nominal=nominal,
        pose=flange @ nominal,
        registered=robot.registered,
        base=robot.chain,
        frames=tuple((e, part) for e, part in pairs if e.role == "registration"),
        moving=tuple(moving),
    )


def tool_poses(tool: ToolPose, prediction: Prediction) -> tuple[Floats, Floats]:
    """Orientation (N, 3, 3) and position (N, 3) of the tool in base axes, m."""
    chain, s = prediction.situation.chain, prediction.situation
    deviations = [e.deviation(tool.theta[part], s) for e, part in tool.moving]
    offsets = sum((d.target for d in deviations if d.target is not None), np.zeros((1, 6)))
    flange, offset = chain.rotation[-1], tool.pose[:3, 3] + offsets[:, :3]
    position = chain.point(offset if len(offsets) > 1 else offset[0])
    turned_flange = se3.product(flange, se3.rotation(offsets[:, 3:])) if offsets.any() else flange
    rotation = se3.product(turned_flange, tool.pose[:3, :3])
    if not any(d.base is not None for d in deviations):
        r, p = tool.base[:3, :3], tool.base[:3, 3]
        return se3.product(r, rotation), p + se3.apply(r, position)
    deviations += [e.deviation(tool.theta[part], s) for e, part in tool.frames]
    base = [d.base for d in deviations if d.base is not None]
    r, p = se3.exp(sum(base[1:], base[0]))
    turn = tool.registered[:3, :3]
    r, p = se3.product(turn, r), tool.registered[:3, 3] + se3.apply(turn, p)
    return se3.product(r, rotation), p + se3.apply(r, position)


def in_chain(tool: ToolPose, rotation: Floats, position: Floats) -> tuple[Floats, Floats]:
    """Convert poses (N, 3, 3) and (N, 3) from base axes to the axes of the fitted chain."""
    turn = tool.base[:3, :3].T
    return se3.product(turn, rotation), se3.apply(turn, position - tool.base[:3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class Inverse(Brief):
    """The solution for N points."""

    q: Floats  # (N, n) joint values
    residual_m: Floats  # (N,) distance from the target position
    residual_rad: Floats  # (N,) angle from the target orientation
    most_rad: float = TOLERANCE  # angle at which a point is solved

    @property
    def solved(self) -> Bools:
        """(N,) points at which the tool reaches its target pose, within `TOLERANCE`."""
        reached = self.residual_m <= TOLERANCE
        return np.asarray(reached & (self.residual_rad <= self.most_rad))


def invert(
    arm: Arm, poses: Callable[[Floats, Ints], Pose], q: Floats, rotation: Floats, position: Floats
) -> Inverse:
    """Find joint values for target orientations (N, 3, 3) and positions (N, 3), from q (N, n)."""
    q, count = arm.complete(q).copy(), len(q)
    residual = np.full((count, 2), np.inf)
    active = np.arange(count)
    scale = np.array([arm.reach] * 3 + [1.0] * 3)
    few = int(arm.independent.sum()) < 6
    for _ in range(MAX_STEPS):
        r, p, chain = poses(q[active], active)
        rotvec = se3.rotation_vector(se3.product(rotation[active], np.swapaxes(r, 1, 2)))
        e = np.concatenate([position[active] - p, rotvec], axis=1)  # base axes
        residual[active] = np.linalg.norm(e.reshape(-1, 2, 3), axis=2)
        jacobian, e = _jacobian(arm, chain, p), e / scale
        if few:
            step = _position_first(jacobian, e)
            moving = (residual[active, 0] > TOLERANCE) | (np.abs(step).max(axis=1) > TOLERANCE)
        else:
            step = np.einsum("nij,nj->ni", _inverse(jacobian), e)
            moving = residual[active].max(axis=1) > TOLERANCE
        if not moving.any():
            break
        longest = np.abs(step).max(axis=1, keepdims=True)
        step *= np.minimum(1.0, MAX_JOINT_STEP / np.maximum(longest, 1e-300))
        q[active[moving]] = arm.complete(q[active[moving]] + step[moving])
        active = active[moving]
    return Inverse(q, residual[:, 0], residual[:, 1], MOST_TURNED if few else TOLERANCE)


def _inverse(jacobian: Floats) -> Floats:
    """(N, n, k) pseudo-inverse, with singular values of at least 1e-6."""
    u, s, vt = np.linalg.svd(jacobian, full_matrices=False)
    return np.asarray(np.einsum("nji,nj,nkj->nik", vt, 1.0 / np.maximum(s, 1e-6), u))


def _position_first(jacobian: Floats, e: Floats) -> Floats:
    """(N, n) steps that meet positions, then orientations with the remaining freedom of joints."""
    of_position, of_turn = jacobian[:, :3], jacobian[:, 3:]
    inverse = _inverse(of_position)
    step = np.einsum("nij,nj->ni", inverse, e[:, :3])
    free = np.eye(jacobian.shape[2]) - inverse @ of_position
    turn = np.linalg.pinv(of_turn @ free, rcond=MIN_SINGULAR_RATIO)
    remaining = e[:, 3:] - np.einsum("nij,nj->ni", of_turn, step)
    return np.asarray(step + np.einsum("nij,nj->ni", turn, remaining))


def nominal_pose(arm: Arm, tool: Floats, q: Floats) -> Pose:
    """Pose of a tool T_flange_tool (4, 4) on the nominal arm at joint values (N, n)."""
    chain = evaluate(arm, q)
    return se3.product(chain.rotation[-1], tool[:3, :3]), chain.point(tool[:3, 3]), chain


def invert_nominal(
    arm: Arm, tool: Floats, q: Floats, rotation: Floats, position: Floats
) -> Inverse:
    """Find joint values of the nominal arm for one target pose or N; else as `invert`."""
    goal = np.broadcast_to(rotation, (len(q), 3, 3)), np.broadcast_to(position, (len(q), 3))
    return invert(arm, lambda joints, _: nominal_pose(arm, tool, joints), q, *goal)


def _jacobian(arm: Arm, chain: Chain, position: Floats) -> Floats:
    """(N, 6, n) derivative of displacement/reach and rotation by the controller's joint values."""
    jacobian = joint_jacobian(chain, position)
    jacobian[:, :3] /= arm.reach
    return jacobian if arm.coupling is None else np.asarray(jacobian @ arm.coupling)


BAND = 0.95
"""Share of points whose error lies within the stated band."""


@dataclass(frozen=True, slots=True)
class ErrorSize:
    """Sizes of 3-D position errors, m."""

    mean_m: float
    rms_m: float
    max_m: float

    @classmethod
    def of(cls, errors: Floats) -> "ErrorSize":
        """Return the sizes of (N,) distances."""
        rms = float(np.sqrt(np.mean(errors**2)))
        return cls(float(errors.mean()), rms, float(errors.max()))


@dataclass(frozen=True, slots=True, eq=False)
class ToolPoses(Brief):
    """Poses of the tool at N points, base axes.

    A fit to deflections knows where a load moves the tool, not where the tool is: its positions are
    off by the errors of the arm, and covariance and band are those of `position` minus
    `nominal_position`, the displacement by the load.
    """

    position: Floats  # (N, 3) m
    rotation: Floats  # (N, 3, 3)
    nominal_position: Floats
    """(N, 3) target position: by the nominal arm, or by the unloaded arm for a fit to
    deflections."""
    nominal_rotation: Floats  # (N, 3, 3)
    covariance: Floats | None
    """(N, 3, 3) of the true position about `position`, m²; None if `std` is false. See above."""
    outside: tuple[Outside, ...]  # measured ranges that the points leave

    @property
    def error_m(self) -> Floats:
        """(N,) distance of the tool from its target position, m."""
        return np.asarray(np.linalg.norm(self.position - self.nominal_position, axis=1))

    @property
    def error_rad(self) -> Floats:
        """(N,) angle of the tool from its target orientation, rad."""
        turn = se3.product(self.rotation, np.swapaxes(self.nominal_rotation, 1, 2))
        return np.asarray(np.linalg.norm(se3.rotation_vector(turn), axis=1))

    @property
    def std_m(self) -> Floats:
        """(N,) root of the trace of the position's covariance, m."""
        return np.asarray(np.sqrt(np.trace(self._stated_covariance(), axis1=1, axis2=2)))

    @property
    def band_m(self) -> Floats:
        """(N,) radius about `position` that holds the true position with probability `BAND`, m."""
        return band(self._stated_covariance())

    def _stated_covariance(self) -> Floats:
        if self.covariance is None:
            raise InputError("the uncertainty was left out; ask for it with std=True")
        return self.covariance


def band(covariance: Floats) -> Floats:
    """(N,) radius that holds `BAND` of normal vectors e with covariance Σ (N, 3, 3); 0 for Σ = 0.

    |e|² ≈ g χ²_ν with the same mean and variance: g = tr Σ²/tr Σ, ν = (tr Σ)²/tr Σ² (Satterthwaite,
    Biometrics Bulletin 2 (1946) 110-114).
    """
    size = np.trace(covariance, axis1=1, axis2=2)
    shape = covariance / np.where(size > 0, size, 1.0)[:, None, None]
    second = np.einsum("nij,nji->n", shape, shape)
    second = np.where(size > 0, second, 1.0)
    return np.asarray(np.sqrt(size * second * scipy.stats.chi2.ppf(BAND, 1.0 / second)))


@dataclass(frozen=True, eq=False)
class Compensation(Tabular):
    """Joint values that put the tool at its target pose, with errors before and after."""

    inverse: Inverse  # joint values and residuals
    _calibration: "Calibration"
    _tool: ToolPose
    _states: States
    _wanted: tuple[Floats, Floats] | None
    _std: bool
    unstated: tuple[str, ...] = ()
    """Columns of `States` that the model needs and the points lack."""

    def _brief(self) -> dict[str, str]:
        return {
            "points": f"{len(self.q)}, of which {np.count_nonzero(self.inverse.solved)} are solved",
            "q": f"array {self.q.shape}, rad, of joints that slide m",
            "more": "q, before, after, usable, inside, singular, other_branch, limits, to_frame()",
        }

    @property
    def q(self) -> Floats:
        """(N, n) corrected joint values, rad."""
        return self.inverse.q

    @property
    def given(self) -> Floats:
        """(N, n) commanded joint values, rad."""
        return self._states.q

    @property
    def inside(self) -> Bools:
        """(N,) whether the point lies within the measured ranges."""
        nowhere = np.zeros(len(self.q), dtype=bool)
        return np.asarray(~np.any([nowhere, *(o.points for o in self.after.outside)], axis=0))

    @cached_property
    def before(self) -> ToolPoses:
        """The tool at the commanded joint values; without uncertainties."""
        return self._calibration.poses(self._tool, self._states, self._goal, std=False)

    @cached_property
    def after(self) -> ToolPoses:
        """The tool at the corrected joint values."""
        states = replace(self._states, q=self.q)
        return self._calibration.poses(self._tool, states, self._goal, self._std, self.unstated)

    @property
    def units(self) -> tuple[str, ...]:
        """(n,) units of the joint values: rad, of joints that slide m."""
        return self._tool.model.cell.arm.units

    @property
    def limits(self) -> Bools:
        """(N, n) joint values beyond the arm's limits."""
        arm = self._tool.model.cell.arm
        return np.asarray((self.q < arm.q_min) | (self.q > arm.q_max))

    @cached_property
    def singular(self) -> Bools:
        """(N,) whether the pose is singular."""
        s = np.linalg.svd(self._nominal_jacobian(self.q), compute_uv=False)
        return np.asarray(s[:, -1] < MIN_SINGULAR_RATIO * s[:, 0])

    @cached_property
    def other_branch(self) -> Bools:
        """(N,) whether a singular pose lies between commanded and corrected joint values.

        The arm then has another configuration, as an elbow that is bent the other way: the sign of
        the determinant of the Jacobian differs. Only of arms with six independent joints.
        """
        given, corrected = self._nominal_jacobian(self.given), self._nominal_jacobian(self.q)
        if corrected.shape[1] != corrected.shape[2]:
            return np.zeros(len(self.q), dtype=np.bool_)
        return np.asarray(np.linalg.det(given) * np.linalg.det(corrected) < 0.0)

    def _nominal_jacobian(self, q: Floats) -> Floats:
        """(N, 6, k) derivative of the nominal arm's tool by its k independent joints."""
        arm = self._tool.model.cell.arm
        chain = evaluate(arm, q)
        return _jacobian(arm, chain, chain.point(self._tool.nominal[:3, 3]))[..., arm.independent]

    @property
    def turned_on(self) -> tuple[Outside, ...]:
        """Joint angles that lie within the measured ranges only modulo whole turns."""
        by_angle = self._calibration.measured.turned_on(replace(self._states, q=self.q))
        inside: dict[str, Bools | bool] = {o.range.variable: ~o.points for o in self.after.outside}
        remaining = [
            replace(o, points=o.points & inside.get(o.range.variable, True)) for o in by_angle
        ]
        return tuple(o for o in remaining if o.points.any())

    @property
    def usable(self) -> Bools:
        """(N,) points that are solved on their branch, not singular, within limits and ranges."""
        solved = self.inverse.solved & ~self.singular & ~self.other_branch
        good = solved & ~self.limits.any(axis=1)
        return np.asarray(good & self.inside)

    @cached_property
    def _goal(self) -> tuple[Floats, Floats]:
        if self._wanted is None:
            return self._calibration.nominal(self._tool, self._states)
        return self._wanted

    def to_dict(self, names: Sequence[str] | None = None) -> dict[str, object]:
        """Return the document of `compensate --json`, SI; `names` of the points, else 1 to N.

        `expected_error_m` is the root sum square of the inversion's residual and the position's
        standard deviation.
        """
        calibration, before, after = self._calibration, self.before, self.after
        names = [str(k + 1) for k in range(len(self.q))] if names is None else names
        columns: dict[str, Sequence[Any]] = {
            "name": names,
            "q_command": self.given.tolist(),
            "q_corrected": self.q.tolist(),
            "expected_error_m": np.hypot(self.inverse.residual_m, after.std_m).tolist(),
            "inside": self.inside.tolist(),
            "q_rad": self.q.tolist(),
            "before_m": before.error_m.tolist(),
            "before_rad": before.error_rad.tolist(),
            "residual_m": self.inverse.residual_m.tolist(),
            "std_m": after.std_m.tolist(),
            "band_m": after.band_m.tolist(),
            "refused": [None] * len(names),
        }
        rows = zip(*columns.values(), strict=True)
        return {
            "calibration": dict(calibration.source),
            "refuted": calibration.refuted_by is not None,
            "readings": calibration.mode,
            "base_in_tracker": se3.six(calibration.base_in_tracker()),
            "base_is": calibration.frames.base_is,
            "n_points": len(names),
            "error_before": asdict(ErrorSize.of(before.error_m)),
            "error_after": {
                "std_m": ErrorSize.of(after.std_m).rms_m,
                "band_m": float(after.band_m.max()),
                "band_share": BAND,
            },
            "points": [dict(zip(columns, row, strict=True)) for row in rows],
        }
