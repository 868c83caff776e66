"""Base and target frames by whitened least squares on positions and attitudes together.

With the nominal flange poses (R_i, p_i), readings y_i obey

    y_i = R (p_i + R_i τ) + t,      M_i = R R_i R_τ  (attitude, where read)

R, t: the base in the sensor's frame; τ, R_τ: the target k(i) on the flange. The 6 + 6 T parameters
are a shift of the base at the centroid of the flange's positions and a turn, base axes; per target
a shift and a turn, flange axes; all in ordinary sizes.
"""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.reading_model import ReadingModel
from hilcal.identification.solver import minimise
from hilcal.readings.readings import Readings
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats, Ints

ROUGH = (1e-4, 1e-4)
"""Roughness that is added to the stated covariance, m and rad: nominal arms are 0.1 to 3 mm off, so
that no reading tells their frames better. A choice at the lower end."""
TARGET_M = 0.3
"""Ordinary distance of a target from the flange, m: a tool's length; a choice."""
BASE_M = 3.0
"""Ordinary distance of a tracker from the base, m: a cell's size; a choice."""
TELL = 0.1
"""A direction of the frames counts as determined when the readings tell it to this share of an
ordinary size (3 cm of the target's offset, 0.1 rad); a choice: a point 0.1 of the tool's length off
moves a reading at most by as much, and only where poses turn as the measured ones did not."""
ALTERNATIONS = 10
"""Steps between rotation and translations; the least squares that follow do the rest. A choice."""
HOLD = 1e-6
"""Weight of an ordinary size against a position error of 1 m in the linear starts; a choice, small
enough to shift no start, and enough to keep what the poses do not tell near what is given."""


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Base and targets.

    Attributes:
        base: (4, 4) T_sensor_base.
        targets: (T, 4, 4) T_flange_target.
    """

    base: Floats
    targets: Floats


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """What the frames are found from.

    Attributes:
        rotation: (N, 3, 3) nominal orientation of the flange, base axes.
        position: (N, 3) nominal position of the flange, m.
        value: (N, 3) positions read, sensor axes, m.
        attitude: (N, 3, 3) attitudes read, or None.
        root: (N, m, m) inverse root of the covariance, roughness included.
        target: (N,) index of the target that was read.
    """

    rotation: Floats
    position: Floats
    value: Floats
    attitude: Floats | None
    root: Floats
    target: Ints

    @classmethod
    def of(cls, arm: Arm, readings: Readings) -> "FrameData":
        """Return the readings beside the flange poses of a nominal arm."""
        value, root = readings.value, inverse_roots(readings.covariance)
        turn = value[:, 3:] if readings.m == 6 else None
        return cls.at(arm, angles(readings), value[:, :3], turn, root, readings.target)

    @classmethod
    def at(
        cls, arm: Arm, q: Floats, value: Floats, turn: Floats | None, root: Floats, target: Ints
    ) -> "FrameData":
        """Return what was read at joint values (N, n); `turn` (N, 3) the attitudes read, rad."""
        chain = evaluate(arm, q)
        return cls(
            np.ascontiguousarray(chain.rotation[-1]),
            np.ascontiguousarray(chain.position[-1]),
            value,
            None if turn is None else se3.rotation(turn),
            root,
            target,
        )

    @property
    def m(self) -> int:
        """Elements per reading: 3 or 6."""
        return 3 if self.attitude is None else 6

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.value)

    def __getitem__(self, rows: Ints | Bools | slice) -> "FrameData":
        """Return the chosen readings."""
        given = {f.name: a for f in fields(self) if (a := getattr(self, f.name)) is not None}
        return replace(self, **{name: a[rows] for name, a in given.items()})

    def points(self, frames: Frames) -> Floats:
        """(N, 3) predicted positions of the targets, base axes, m."""
        offset = frames.targets[self.target, :3, 3]
        return np.asarray(self.position + np.einsum("nij,nj->ni", self.rotation, offset))

    def misfit(self, frames: Frames) -> Floats:
        """(N, m) measured minus predicted, sensor axes, m and rad."""
        r, t = frames.base[:3, :3], frames.base[:3, 3]
        off = self.value - self.points(frames) @ r.T - t
        if self.attitude is None:
            return np.asarray(off)
        predicted = r @ self.rotation @ frames.targets[self.target, :3, :3]
        turn = se3.rotation_vector(self.attitude @ np.swapaxes(predicted, 1, 2))
        return np.concatenate([off, turn], axis=1)


def angles(readings: Readings) -> Floats:
    """(N, n) joint values of the readings: as the encoders reported them, else as commanded."""
    states = readings.states
    return states.q if states.q_actual is None else states.q_actual


def inverse_roots(covariance: Floats) -> Floats:
    """(N, m, m) lower triangular W with W V Wᵀ = I, V the covariance with the roughness added.

    A covariance may have an eigenvalue below zero by rounding (`tables.checks`), which can be
    larger than the roughness; it counts as zero.
    """
    m = covariance.shape[-1]
    rough = np.diag(np.repeat(np.square(ROUGH), 3)[:m])
    try:
        root = np.linalg.cholesky(covariance + rough)
    except np.linalg.LinAlgError:
        value, axes = np.linalg.eigh(covariance)
        whole = (axes * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        root = np.linalg.cholesky(whole + rough)
    return np.asarray(np.linalg.inv(root))


def sizes(targets: int) -> Floats:
    """(6 + 6 T,) ordinary sizes of the parameters, m and rad."""
    own = [TARGET_M] * 3 + [1.0] * 3
    return np.array([BASE_M] * 3 + [1.0] * 3 + own * targets)


def free_parameters(base: bool, targets: Bools, attitudes: bool) -> Bools:
    """(6 + 6 T,) which parameters are estimated where base and targets (T,) are or are not unknown.

    A target's axes show in attitudes alone, and are estimated from them also where its offset is
    known.
    """
    own = [np.repeat([bool(t), attitudes], 3) for t in targets]
    return np.concatenate([np.full(6, base), *own])


def given_and_free(cell: Cell, attitudes: bool) -> tuple[Frames, Bools]:
    """Return the frames of a cell, as given or as placed, and what is estimated of them."""
    free = free_parameters(not cell.registration_known, ~np.array(cell.known_targets), attitudes)
    return Frames(cell.registration, cell.all_targets), free


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """Prior of the targets: as given, to within the ordinary sizes.

    Attributes:
        given: (T, 4, 4) targets as configured, or the nominal ones.
        weight: of a target that is an ordinary size off, in units of whitened misfit.
    """

    given: Floats
    weight: float

    def away(self, targets: Floats) -> Floats:
        """(6 + 6 T,) weighted distance of the targets from the given ones."""
        shift = targets[:, :3, 3] - self.given[:, :3, 3]
        back = np.swapaxes(self.given[:, :3, :3], 1, 2)
        turn = se3.rotation_vector(targets[:, :3, :3] @ back)
        own = np.concatenate([shift / TARGET_M, turn / np.pi], axis=1)
        return np.concatenate([np.zeros(6), self.weight * own.reshape(-1)])

    def slopes(self) -> Floats:
        """(6 + 6 T,) its derivative by the parameters."""
        own = np.tile(np.repeat([1.0, 1.0 / np.pi], 3), len(self.given))
        return np.concatenate([np.zeros(6), self.weight * own])


@dataclass(frozen=True, eq=False)
class Placement:
    """Frames beside what was read: a point of `solver.minimise`.

    Attributes:
        seen: flange poses and readings.
        frames: base and targets.
        free: (6 + 6 T,) the parameters that are estimated, K of them.
        hold: prior of the targets.
    """

    seen: FrameData
    frames: Frames
    free: Bools
    hold: Hold | None = None

    @cached_property
    def off(self) -> Floats:
        """(N, m) misfit, m and rad."""
        return self.seen.misfit(self.frames)

    @cached_property
    def white(self) -> Floats:
        """(N, m) whitened misfit."""
        return np.asarray(np.einsum("nij,nj->ni", self.seen.root, self.off))

    @property
    def square(self) -> float:
        """Whitened sum of squares."""
        return float(np.sum(self.white**2))

    @property
    def residual(self) -> Floats:
        """(R,) whitened misfit, and that of the prior."""
        if self.hold is None:
            return self.white.reshape(-1)
        away = self.hold.away(self.frames.targets)[self.free]
        return np.concatenate([self.white.reshape(-1), -away])

    def jacobian(self) -> Floats:
        """(R, K) derivative of what is predicted."""
        rows = self.columns().reshape(self.white.size, int(np.count_nonzero(self.free)))
        if self.hold is None:
            return rows
        return np.concatenate([rows, np.diag(self.hold.slopes()[self.free])])

    def columns(self) -> Floats:
        """(N, m, K) whitened derivative of the predicted readings."""
        seen, r = self.seen, self.frames.base[:3, :3]
        x = seen.points(self.frames) - self._centre
        turned = r @ seen.rotation
        out = np.zeros((len(seen), seen.m, len(self.free)))
        out[:, :3, :3] = r
        out[:, :3, 3:6] = -r @ se3.skew(x)
        out[:, 3:, 3:6] = r[: seen.m - 3]
        for k in range(len(self.frames.targets)):
            mine, at = seen.target == k, 6 + 6 * k
            out[mine, :3, at : at + 3] = turned[mine]
            out[mine, 3:, at + 3 : at + 6] = turned[mine, : seen.m - 3]
        return np.asarray(seen.root @ out[:, :, self.free] * self._sizes)

    @property
    def linear(self) -> ReadingModel:
        """The linear model of the readings."""
        none = np.zeros(np.count_nonzero(self.free))
        members = np.zeros((0, 0), dtype=np.int64)
        return ReadingModel(self.white, self.columns(), none, none, self.seen.root, members)

    def moved(self, step: Floats) -> "Placement":
        """Return the placement after a step (K,)."""
        whole = np.zeros(len(self.free))
        whole[self.free] = self._sizes * step
        about, back = np.eye(4), np.eye(4)
        about[:3, 3], back[:3, 3] = self._centre, -self._centre
        turn = se3.matrix(se3.rotation(whole[3:6]), whole[:3])
        targets, own = self.frames.targets.copy(), whole[6:].reshape(-1, 6)
        targets[:, :3, 3] += own[:, :3]
        targets[:, :3, :3] = se3.rotation(own[:, 3:]) @ targets[:, :3, :3]
        return replace(self, frames=Frames(self.frames.base @ about @ turn @ back, targets))

    def determined(self, spread: float) -> tuple[Floats, Floats]:
        """Undetermined directions (6 + 6 T, U), and the Gauss-Newton step (K,) along the others.

        Args:
            spread: rms of the whitened misfit, at least 1.
        """
        a = self.jacobian()
        # Squared singular values up to 1e12 leave rounding of 1e-2 in those that decide, about 10.
        squares, vectors = np.linalg.eigh(a.T @ a)
        told = squares > (spread / TELL) ** 2
        null = np.zeros((len(self.free), np.count_nonzero(~told)))
        null[self.free] = vectors[:, ~told]
        part = vectors[:, told]
        return null, part @ ((part.T @ (a.T @ self.residual)) / squares[told])

    @cached_property
    def _centre(self) -> Floats:
        """(3,) the point of the base axes that the base turns about, m."""
        return np.asarray(self.seen.position.mean(axis=0))

    @cached_property
    def _sizes(self) -> Floats:
        """(K,) units of the columns."""
        return sizes(len(self.frames.targets))[self.free]


def best_placement(
    seen: FrameData, given: Frames, free: Bools, good: float, steps: int, rotated: int
) -> Placement:
    """Return the best placement from several starts: closed forms, then rotations of a cube.

    Args:
        seen: flange poses and readings.
        given: base and targets as configured, or the nominal ones.
        free: (6 + 6 T,) what is estimated.
        good: whitened rms misfit per reading at which no other start is tried.
        steps: most steps from each start.
        rotated: of the rotations of a cube, the number of those that fit best and are tried.
    """
    found: list[Placement] = []

    def reached(start: Frames) -> bool:
        found.append(minimise(Placement(seen, start, free), steps))
        return found[-1].square <= good**2 * len(seen)

    if not any(map(reached, _closed_forms(seen, given, free))) and rotated and free[:6].any():
        turns = (_with_translations(seen, given, turn, free) for turn in cube())
        begun = sorted((Placement(seen, f, free) for f in turns), key=lambda p: p.square)
        for placement in begun[:rotated]:
            reached(placement.frames)
    return min(found, key=lambda p: p.square)


def settled(at: Placement, given: Frames) -> tuple[Placement, Floats]:
    """Return a minimum whose undetermined part is held near the given targets, and that part.

    The prior has the ordinary sizes as standard deviations. It acts along the undetermined
    directions (6 + 6 T, U) alone: along the others, the last steps go to the minimum without it.
    """
    dof = max(at.seen.m * len(at.seen) - int(np.count_nonzero(at.free)), 1)
    spread = max(float(np.sqrt(at.square / dof)), 1.0)
    null, _ = at.determined(spread)
    if null.size:
        at = replace(minimise(replace(at, hold=Hold(given.targets, spread))), hold=None)
    for _ in range(3):
        null, step = at.determined(spread)
        at = at.moved(step)
    return at, null


def nearest_rotation(m: Floats) -> Floats:
    """Return the rotation (..., 3, 3) nearest to a matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(m)
    flip = np.ones(m.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * flip[..., None, :]) @ vt)


def rotation_of_attitudes(attitude: Floats, flange: Floats) -> Floats:
    """(3, 3) A of M_i Bᵀ = A R_i, from the null vector of a linear system.

    Args:
        attitude: (N, 3, 3) M_i.
        flange: (N, 3, 3) R_i.
    """
    # vec by rows: (M_i ⊗ I) vec(Bᵀ) = (I ⊗ R_iᵀ) vec(A)
    eye = np.eye(3)
    left = np.einsum("nij,kl->nikjl", attitude, eye).reshape(-1, 9)
    right = np.einsum("ij,nlk->nikjl", eye, flange).reshape(-1, 9)
    gram = np.concatenate([left, -right], axis=1)
    a = np.linalg.eigh(gram.T @ gram)[1][9:, 0].reshape(3, 3)
    return nearest_rotation(a * (np.sign(np.linalg.det(a)) or 1.0))


def _closed_forms(seen: FrameData, given: Frames, free: Bools) -> Iterator[Frames]:
    """Yield base and targets from attitudes and from positions."""
    if not free[:6].any():
        yield _with_translations(seen, given, given.base[:3, :3], free)
        return
    if seen.attitude is not None:
        mine = seen.target == seen.target[0]
        base = rotation_of_attitudes(seen.attitude[mine], seen.rotation[mine])
        yield _with_translations(seen, given, base, free)
    yield _alternated(seen, given, free)


def cube() -> Floats:
    """(24, 3, 3) the rotations that take a cube to itself."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.asarray(np.round(Rotation.create_group("O").as_matrix()))


def _with_translations(seen: FrameData, given: Frames, rotation: Floats, free: Bools) -> Frames:
    """Complete a rotation of the base by the best translations and the targets' axes."""
    count, size = len(seen), len(given.targets)
    turned = rotation @ seen.rotation
    a = np.zeros((count, 3, 3 + 3 * size))
    a[:, :, :3] = np.eye(3)
    for k in range(size):
        mine = seen.target == k
        a[mine, :, 3 + 3 * k : 6 + 3 * k] = turned[mine]
    live = np.repeat(free[::6], 3)
    x = np.concatenate([given.base[:3, 3], *given.targets[:, :3, 3]])
    hold = np.repeat([HOLD / BASE_M] + [HOLD / TARGET_M] * size, 3)
    flat = a.reshape(-1, len(x))
    rest = (seen.value - seen.position @ rotation.T).reshape(-1) - flat @ x
    rows = np.concatenate([flat, np.diag(hold * np.sqrt(count))])[:, live]
    if live.any():
        x[live] += np.linalg.lstsq(rows, np.concatenate([rest, np.zeros(len(x))]), rcond=None)[0]
    base, targets = np.eye(4), given.targets.copy()
    base[:3, :3], base[:3, 3] = rotation, x[:3]
    targets[:, :3, 3] = x[3:].reshape(size, 3)
    if seen.attitude is not None:
        for k in range(size):
            mine = seen.target == k
            mean = np.einsum("nji,njk->ik", turned[mine], seen.attitude[mine])
            targets[k, :3, :3] = nearest_rotation(mean)
    return Frames(base, targets)


def _alternated(seen: FrameData, given: Frames, free: Bools) -> Frames:
    """Positions alone: Procrustes for R, then linear for τ and t, a few times."""
    out, y = given, seen.value - seen.value.mean(axis=0)
    for _ in range(ALTERNATIONS):
        x = seen.points(out)
        before, out = (
            out.targets,
            _with_translations(seen, given, nearest_rotation(y.T @ (x - x.mean(axis=0))), free),
        )
        if np.abs(out.targets - before).max() < 1e-6:
            break
    return out
