"""Base, targets and observers by whitened least squares, before anything else is fitted.

With the nominal flange poses (R_i, p_i), readings y_i obey

    y_i = h(R (p_i + R_i τ) + t),      M_i = R R_i R_τ  (attitude, where read)

R, t: the base in the sensor's frame; τ, R_τ: the target k(i) on the flange; h: what the observer
o(i) reads, for one tracker the position itself. The 6 + 6 T + 6 O parameters are a shift of the
base at the centroid of the flange's positions and a turn, base axes; per target a shift and a turn,
flange axes; per observer the twist of its frame; all in ordinary sizes. Starts are closed forms
(Kabsch; linear equations of a point, |p|² − d² being linear in it, and of a plane) and rotations of
a cube. Readings that are centimetres off are detected from a robust start, and left out. Directions
that the poses do not determine stay near the cell's targets and are listed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.effects.target_offset import TargetOffset
from hilcal.errors import CannotAnswerError
from hilcal.identification.outliers.data_snooping import runs_of_equal_shifts
from hilcal.identification.outliers.least_trimmed_squares import (
    MOST_WRONG,
    rejection_limit,
    robust_start,
    trimmed_variance,
)
from hilcal.identification.registration.placement import (
    MIN_POSES,
    FrameData,
    Frames,
    Placement,
    angles,
    fitted_placement,
    given_and_free,
    minimise,
)
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.regression.normal_equations import echelon
from hilcal.robot import se3
from hilcal.robot.chain import evaluate, joint_jacobian
from hilcal.tables.uncertainty import step
from hilcal.types import Bools, Floats

# All of these are choices.
COLLINEAR_M = 1e-3  # m rms from a line, below which positions are collinear
DISTURBED_M = 3e-3  # m rms from which far readings are looked for: nominal arms are off by less
FAR_FACTOR = 10.0  # times the median misfit from which on a reading of several observers is far off
LEAST_FAR_M = 1e-4  # m, misfit that is never far off
SEED, ROUNDS = 0, 5  # of random subsets; most rounds in which readings join and leave
LEAST_TURN = 1e-3  # range of a joint's angle, rad, below which it counts as never turned
LEAST_COMPONENT = 0.05  # component of an undetermined direction that is worth mentioning
COMPUTED = 1.2  # times the rounding of positions and joints that computed positions may be off
EXACT = 1e-6  # share of the reach by which two programs compute one position differently
LEAST_SCATTER_M = 2e-6  # m, 3-D; no arm repeats to this, and an instrument adds its own; a choice
FEWEST_FREE = 15  # elements beyond the unknowns that tell so


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """Frame parameters that can move together without a change of any reading."""

    target: int | None  # index of the target that moves; None where the base alone moves
    target_shift: Floats  # (3,) flange axes, m
    target_turn: Floats  # (3,) rad
    base_shift: Floats  # (3,) of the base with it, at the middle of the flange's positions, m
    base_turn: Floats  # (3,) rad
    observers: tuple[str, ...] = ()  # those of several observers that move with it, as "point P"

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {
            "target": self.target,
            "target_shift_m": self.target_shift.tolist(),
            "target_turn_rad": self.target_turn.tolist(),
            "base_shift_m": self.base_shift.tolist(),
            "base_turn_rad": self.base_turn.tolist(),
            **({"observers": list(self.observers)} if self.observers else {}),
        }


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """The place of base and targets, and what the poses do not determine."""

    cell: Cell  # with base and target in place
    residual: Floats  # (N, m) measured minus predicted by the nominal arm, sensor axes, m and rad
    rms: float  # of the 3-D position error, m, of the readings that are not far off
    turn_rms: float | None  # of the attitude's error, rad; None for positions alone
    far: Bools  # (N,) far off while the others fit: the frames are not fitted to these
    undetermined: tuple[Undetermined, ...]
    never_turned: Bools  # (n,) joints that never turned
    estimated: bool  # whether anything was unknown

    def to_json(
        self, base: Floats | None = None, targets: Floats | None = None
    ) -> dict[str, object]:
        """Return its JSON; with base (4, 4) and targets (T, 4, 4) as a fit has them."""
        cell = self.cell
        placed = cell.all_targets if targets is None else targets
        several = cell.target_names if cell.targets is not None else ()
        by_name = {name: _pose(t) for name, t in zip(several, placed, strict=False)}
        return {
            "base": _pose(cell.registration if base is None else base),
            "target": _pose(placed[0]),
            **({"targets": by_name} if by_name else {}),
            "estimated": self.estimated,
            "rms_m": self.rms,
            "rms_rad": self.turn_rms,
            "undetermined": [u.to_json() for u in self.undetermined],
            "joints_never_turned": (np.flatnonzero(self.never_turned) + 1).tolist(),
        }


def _pose(t: Floats) -> dict[str, Sequence[float]]:
    return {"xyz_m": t[:3, 3].tolist(), "rotvec_rad": se3.rotation_vector(t[:3, :3]).tolist()}


def register(cell: Cell, readings: Readings) -> Registration:
    """Estimate the places of base, targets and observers where they are unknown.

    Raises:
        CannotAnswerError: the poses do not determine them: fewer than four distinct positions, all
            on one line, or fewer readings of an observer than unknowns of its place.
    """
    cell = cell.observed_by(readings.observers)
    data, m = FrameData.of(cell.arm, readings), readings.m
    frames, free = given_and_free(cell, m == 6)
    estimated = not (cell.registration_known and cell.target_known) or any(
        o.free for o in cell.observers
    )
    if estimated:
        _refuse_few(cell, readings)
        placement, null = fitted_placement(data, frames, free)
    else:
        placement, null = Placement(data, frames, np.zeros_like(free)), np.zeros((len(free), 0))
    far = _far(readings, placement)
    if estimated and 0 < far.mean() <= MOST_WRONG:
        placement, null = fitted_placement(data[~far], frames, free)
        if cell.observers:
            far = _far_by_median(data.misfit(placement.frames))
    off, placed = data.misfit(placement.frames), placement.frames
    if estimated:
        x = data.points(placed)
        spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)[1]
        in_space = m == 6 or cell.registration_known or bool(cell.observers)
        if not in_space and spread < COLLINEAR_M * np.sqrt(len(x)):
            raise CannotAnswerError(
                "registration: all positions lie in one point or on one line; measure poses "
                "spread in space"
            )
        cell = replace(cell.with_targets(placed.targets), observers=placed.observers)
        cell = replace(cell, registration=placed.base)
    rms, turn_rms = (
        float(np.sqrt(np.mean(np.sum(off[~far, part] ** 2, axis=1))))
        for part in (slice(0, 3), slice(3, 6))
    )
    return Registration(
        cell=cell,
        residual=off,
        rms=rms,
        turn_rms=turn_rms if m == 6 else None,
        far=far & (far.mean() <= MOST_WRONG),
        undetermined=_undetermined(null, placed),
        never_turned=np.ptp(angles(readings), axis=0) < LEAST_TURN,
        estimated=estimated,
    )


def computed_from_joints(registered: Registration, readings: Readings) -> bool:
    """Whether the positions of one tracker are the nominal arm's, computed from the joint values.

    The nominal arm then leaves the rounding of positions (Δ_x per axis) and joint values (Δ_q):

        Σ |r_i|² ≤ c² Σ (|Δ_x|² + |J_i Δ_q|²)/12,

    J_i being the Jacobian of the target's position. The errors of a real arm are far larger.
    """
    near = ~registered.far
    if registered.cell.observers or 3 * np.count_nonzero(near) < 9 + FEWEST_FREE:
        return False
    variance = _rounding(registered, readings) + (EXACT * registered.cell.arm.reach) ** 2
    square = np.sum(registered.residual[near, :3] ** 2)
    return bool(square <= COMPUTED**2 * np.sum(variance[near]))


def scatters_less_than_arms(registered: Registration, readings: Readings) -> bool:
    """Whether positions scatter by less than any arm about an arm of somewhat other geometry.

    Small motions of all links are fitted to the residual of the nominal arm. With R what they
    leave, ν its degrees of freedom and Δ² the variance by rounding, it is certain at 99 % that

        σ² = 3 R / χ²(1 %, ν) − Δ² < LEAST_SCATTER²      (3-D, per reading).
    """
    cell, residual = registered.cell, registered.residual[:, :3]
    if cell.observers or registered.far.any():
        return False
    chain = evaluate(cell.arm, angles(readings))
    points = FrameData.of(cell.arm, readings).points(given_and_free(cell, readings.m == 6)[0])
    turns = chain.rotation  # (L, N, 3, 3)
    arms = (points - chain.position)[..., None]
    moved = np.concatenate([turns, np.cross(turns, arms, axis=2)], axis=3)
    columns = np.moveaxis(moved, 0, 2).reshape(len(points) * 3, -1)
    rank = np.linalg.matrix_rank(columns)
    free = residual.size - rank
    if free < FEWEST_FREE:
        return False
    measured = (residual @ cell.registration[:3, :3]).reshape(-1)
    left = measured - columns @ np.linalg.lstsq(columns, measured)[0]
    most = 3.0 * float(left @ left) / scipy.stats.chi2.ppf(0.01, free)
    return bool(most - np.mean(_rounding(registered, readings)) < LEAST_SCATTER_M**2)


def _rounding(registered: Registration, readings: Readings) -> Floats:
    """(N,) variance of the 3-D position by the rounding of positions and joint values, m²."""
    cell, q, arm = registered.cell, angles(readings), registered.cell.arm
    points = FrameData.of(arm, readings).points(given_and_free(cell, readings.m == 6)[0])
    steps = [max(step(x), np.radians(step(np.degrees(x)))) for x in q.T]
    jacobian = joint_jacobian(evaluate(arm, q), points)[:, :3]
    of_positions = sum(step(x) ** 2 for x in readings.value[:, :3].T)
    return np.asarray((np.sum((jacobian * steps) ** 2, axis=(1, 2)) + of_positions) / 12)


def _refuse_few(cell: Cell, readings: Readings) -> None:
    angle = angles(readings)
    for k, o in enumerate(cell.observers):
        rows = readings.observer == k
        count = len(np.unique(angle[rows], axis=0)) * (3 if o.name.kind == "station" else 1)
        if 0 < count < len(o.free):
            raise CannotAnswerError(
                f"registration: {o.name} has readings of {rows.sum()} poses, too few for the "
                f"{len(o.free)} unknowns of its place; measure more, or state its place"
            )
    distinct = len(np.unique(np.round(angle, 9), axis=0))
    if distinct < MIN_POSES and not cell.observers:
        raise CannotAnswerError(
            f"registration: {distinct} distinct poses; measure at least {MIN_POSES}, better "
            "10, that turn the flange and do not lie on a line"
        )


def targets_as_fitted(model: Model, theta: Floats) -> Floats:
    """(T, 4, 4) all targets of a model with parameters (P,)."""
    for e, rows in zip(model.effects, model.slices(), strict=True):
        if isinstance(e, TargetOffset):
            return e.displaced(theta[rows])
    return model.cell.all_targets


def _far(readings: Readings, placement: Placement) -> Bools:
    """(N,) readings far off while the others fit to within `DISTURBED_M`; none in other cases."""
    if placement.frames.observers:
        return _far_by_median(placement.misfit)
    data, none = placement.data, np.zeros(len(readings), dtype=np.bool_)

    def fits(off: Floats) -> bool:
        return bool(np.mean(np.sum(off[:, :3] ** 2, axis=1)) <= DISTURBED_M**2)

    if fits(placement.misfit):
        return none
    placement, used = robust_start(placement, np.random.default_rng(SEED))
    for _ in range(ROUNDS):
        linear = placement.linear
        d2, _ = linear.distances_from(np.zeros(linear.columns.shape[2]))
        far = d2 > rejection_limit(data.m, len(data), trimmed_variance(linear, d2, none))
        if far.mean() > MOST_WRONG:
            return none
        placement = replace(placement, frames=minimise(replace(placement, data=data[~far])).frames)
        if np.array_equal(far, ~used):
            break
        used = ~far
    rows, base = np.flatnonzero(far), placement.frames.base[:3, :3]
    axes = base @ data.rotation[rows] @ placement.frames.targets[data.target[rows], :3, :3]
    alike = runs_of_equal_shifts(readings, ~none, rows, placement.misfit[rows, :3], axes)
    return far if fits(placement.misfit[~far]) and not len(alike) else none


def _far_by_median(off: Floats) -> Bools:
    """(N,) readings that are off (N, m) by far more than most."""
    size = np.linalg.norm(off[:, :3], axis=1)
    return np.asarray(size > max(LEAST_FAR_M, FAR_FACTOR * float(np.median(size))))


def _undetermined(null: Floats, frames: Frames) -> tuple[Undetermined, ...]:
    """Return the undetermined directions, each with as few parameters of a target as possible."""
    size = len(frames.targets)
    targets = np.arange(6, 6 + 6 * size).reshape(-1, 2, 3)
    turns_and_base = [3, 4, 5, *targets[:, 1].reshape(-1).tolist(), 0, 1, 2]
    of_observers = range(6 + 6 * size, len(null))
    blocks = (targets[:, 0].reshape(-1).tolist(), turns_and_base, of_observers)
    out = []
    for row in echelon(null.T, blocks, LEAST_COMPONENT):
        row = row / np.abs(row).max()
        moved = (row * (np.abs(row) >= LEAST_COMPONENT) * frames.sizes).reshape(-1, 2, 3)
        base, of_targets, of_others = moved[0], moved[1 : 1 + size], moved[1 + size :]
        active = np.flatnonzero(np.abs(of_targets).any(axis=(1, 2)))
        target = int(active[0]) if len(active) else None
        shift, turn = np.zeros((2, 3)) if target is None else of_targets[target]
        pairs = zip(frames.observers, of_others, strict=True)
        observers = tuple(str(o.name) for o, m in pairs if m.any())
        out.append(Undetermined(target, shift, turn, base[0], base[1], observers))
    return tuple(out)
