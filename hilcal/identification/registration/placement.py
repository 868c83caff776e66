"""Placement of base, targets and observers: derivatives, starts and minimum; see `registration`."""

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np

from hilcal.cell import Cell, Observer, plane_frame
from hilcal.identification.outliers.least_trimmed_squares import ReadingModel
from hilcal.model.observe import Observation, by_observer_frame, observed
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import whitening_matrix
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
ROUGHNESS = (1e-4, 1e-4)  # m and rad, added to the stated noise: nominal arms are 0.1 to 3 mm off
TARGET_M, BASE_M = 0.3, 3.0  # ordinary distances of target and flange, of tracker and base
DETERMINED_SHARE = 0.1  # share of an ordinary size to which readings must determine a direction
ALTERNATIONS = 10  # between rotation and translations; least squares follow
START_WEIGHT = 1e-6  # weight of an ordinary size in the linear starts, against an error of 1 m
MIN_POSES = 4
START_READINGS, START_READINGS_EACH = 100, 50
"""Readings that starts are tried on: of all, and of each observer."""
GOOD_RMS = 10.0  # rms misfit with roughness at which no other start is tried: 1 mm and 1 mrad
START_STEPS, MOST_ROTATIONS = 15, 5  # steps of a start; rotations of a cube that are tried
MOST_STEPS, DAMPING = 40, 1e-3  # of `minimise`: most steps; λ of the first one
SETTLED = 1e-9  # relative decrease of the sum of squares below which it ends
LEAST_STEP = 1e-12  # largest element of a step below which it ends: rounding
START_STEPS_SEVERAL, MOST_FOLLOWED = 50, 6
"""With several observers: steps of a start; starts followed."""


def angles(readings: Readings) -> Floats:
    """(N, n) joint values of the readings: as the encoders reported them, else as commanded."""
    states = readings.states
    return states.q if states.q_actual is None else states.q_actual


def rough_whitening(covariance: Floats, partial: bool = False) -> Floats:
    """(N, m, m) W with W V Wᵀ = I, V the covariance with the roughness added.

    With `partial`, elements of variance 0 were not read, and get no roughness either.
    """
    m = covariance.shape[-1]
    rough = np.repeat(np.square(ROUGHNESS), 3)[:m] * np.eye(m)
    if partial:
        rough = rough * (np.diagonal(covariance, axis1=1, axis2=2) > 0)[:, None, :]
    return whitening_matrix(covariance + rough)


def free_parameters(base: bool, targets: Bools, attitudes: bool) -> Bools:
    """Return (6 + 6 T,) which parameters of base and targets are estimated.

    `base` and `targets` (T,) state which of the frames have unknown places. A target's axes show in
    attitudes alone, and are estimated from them even at a known offset.
    """
    return np.concatenate(
        [np.full(6, base), *(np.repeat([bool(t), attitudes], 3) for t in targets)]
    )


def given_and_free(cell: Cell, attitudes: bool) -> tuple["Frames", Bools]:
    """Return the frames of a cell, and (P,) which of their parameters are estimated."""
    free = free_parameters(not cell.registration_known, ~np.array(cell.known_targets), attitudes)
    observers = (np.isin(np.arange(6), o.free) for o in cell.observers)
    frames = Frames(cell.registration, cell.all_targets, cell.observers)
    return frames, np.concatenate([free, *observers])


@dataclass(frozen=True, slots=True, eq=False)
class Frames:
    """Base, targets and observers, with P = 6 + 6 T + 6 O parameters."""

    base: Floats  # (4, 4) T_sensor_base
    targets: Floats  # (T, 4, 4) T_flange_target
    observers: tuple[Observer, ...] = ()  # those that read; none for one tracker

    @property
    def sizes(self) -> Floats:
        """(P,) ordinary sizes of the parameters, m and rad."""
        parts = [BASE_M, *[TARGET_M] * len(self.targets), *[BASE_M] * len(self.observers)]
        return np.array([size for part in parts for size in [part] * 3 + [1.0] * 3])


@dataclass(frozen=True, slots=True, eq=False)
class FrameData:
    """The data that determine the frames."""

    rotation: Floats  # (N, 3, 3) nominal orientation of the flange, base axes
    position: Floats  # (N, 3) nominal position of the flange, m
    value: Floats  # (N, 3) positions read, sensor axes, m
    attitude: Floats | None  # (N, 3, 3) attitudes read
    root: Floats  # (N, m, m) inverse root of the covariance, roughness included
    target: Ints  # (N,) index of the target that was read
    observer: Ints | None = None  # (N,) index of the observer that read it

    @classmethod
    def of(cls, arm: Arm, readings: Readings) -> "FrameData":
        """Return the readings with the flange poses of a nominal arm."""
        value, turn = readings.value, readings.value[:, 3:] if readings.m == 6 else None
        observer = readings.states.observer
        root = rough_whitening(readings.covariance, partial=observer is not None)
        data = cls.at(arm, angles(readings), value[:, :3], turn, root, readings.target)
        return replace(data, observer=observer)

    @classmethod
    def at(
        cls, arm: Arm, q: Floats, value: Floats, turn: Floats | None, root: Floats, target: Ints
    ) -> "FrameData":
        """Return readings at joint values (N, n); `turn` (N, 3) are the attitudes, rad."""
        chain = evaluate(arm, q)
        rotation, position = (np.ascontiguousarray(x[-1]) for x in (chain.rotation, chain.position))
        attitude = None if turn is None else se3.rotation(turn)
        return cls(rotation, position, value, attitude, root, target)

    @property
    def m(self) -> int:
        """Elements per reading: 3 or 6."""
        return 3 if self.attitude is None else 6

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, rows: Ints | Bools | slice) -> "FrameData":
        arrays = {f.name: a for f in fields(self) if (a := getattr(self, f.name)) is not None}
        return replace(self, **{name: a[rows] for name, a in arrays.items()})

    def points(self, frames: Frames) -> Floats:
        """(N, 3) predicted positions of the targets, base axes, m."""
        return self.position + se3.apply(self.rotation, frames.targets[self.target, :3, 3])

    def predicted_readings(self, frames: Frames) -> Observation:
        """Return the predicted readings."""
        r, points = frames.base[:3, :3], self.points(frames)
        turn = r @ self.rotation @ frames.targets[self.target, :3, :3]
        position = points @ r.T + frames.base[:3, 3]
        if self.observer is None:
            return Observation(position, turn, points, r)
        return observed(frames.observers, self.observer, position, turn)

    def misfit(self, frames: Frames) -> Floats:
        """(N, m) measured minus predicted, m and rad, in the axes of what reads."""
        o = self.predicted_readings(frames)
        off = self.value - o.position
        if self.attitude is None:
            return np.asarray(off)
        turn = se3.rotation_vector(self.attitude @ np.swapaxes(o.rotation, 1, 2))
        return np.concatenate([off, turn], axis=1)


@dataclass(frozen=True, eq=False)
class Placement:
    """Frames and the data that they are fitted to: a point of `minimise`."""

    data: FrameData
    frames: Frames
    free: Bools  # (P,) the parameters that are estimated, K of them
    prior_targets: Floats | None = None  # (T, 4, 4) targets with a prior of the ordinary sizes
    prior_weight: float = 1.0  # of a target an ordinary size off, in units of whitened misfit

    @cached_property
    def misfit(self) -> Floats:
        """(N, m) misfit, m and rad."""
        return self.data.misfit(self.frames)

    @cached_property
    def white(self) -> Floats:
        """(N, m) whitened misfit."""
        return np.asarray(np.einsum("nij,nj->ni", self.data.root, self.misfit))

    @property
    def square(self) -> float:
        """Whitened sum of squares."""
        return float(np.sum(self.white**2))

    @property
    def residual(self) -> Floats:
        """(R,) whitened misfit, and that of the prior."""
        if self.prior_targets is None:
            return self.white.reshape(-1)
        t, away = self.frames.targets, np.zeros(len(self.free))
        shift = (t[:, :3, 3] - self.prior_targets[:, :3, 3]) / TARGET_M
        back = np.swapaxes(self.prior_targets[:, :3, :3], 1, 2)
        turn = se3.rotation_vector(t[:, :3, :3] @ back) / np.pi
        away[6 : 6 + 6 * len(t)] = np.concatenate([shift, turn], axis=1).reshape(-1)
        return np.concatenate([self.white.reshape(-1), -self.prior_weight * away[self.free]])

    def jacobian(self) -> Floats:
        """(R, K) derivative of the prediction."""
        rows = self.columns().reshape(self.white.size, int(np.count_nonzero(self.free)))
        if self.prior_targets is None:
            return rows
        slopes, count = np.zeros(len(self.free)), len(self.prior_targets)
        slopes[6 : 6 + 6 * count] = np.tile(np.repeat([1.0, 1.0 / np.pi], 3), count)
        return np.concatenate([rows, self.prior_weight * np.diag(slopes[self.free])])

    def columns(self) -> Floats:
        """(N, m, K) whitened derivative of the predicted readings."""
        data, frames, r = self.data, self.frames, self.frames.base[:3, :3]
        turned, m = r @ data.rotation, data.m
        out = np.zeros((len(data), m, len(self.free)))
        out[:, :3, :3] = r
        out[:, :3, 3:6] = -r @ se3.skew(data.points(frames) - self._centre)
        out[:, 3:, 3:6] = r[: m - 3]
        for k in range(len(frames.targets)):
            rows, first = data.target == k, 6 + 6 * k
            out[rows, :3, first : first + 3] = turned[rows]
            out[rows, 3:, first + 3 : first + 6] = turned[rows, : m - 3]
        if data.observer is not None:
            o = data.predicted_readings(frames)
            out[:, :3] = o.axes @ out[:, :3]
            if m == 6:
                turns = np.stack([x.frame[:3, :3] for x in frames.observers])
                out[:, 3:] = turns[data.observer] @ out[:, 3:]
            moved = by_observer_frame(o, m)
            for k in range(len(frames.observers)):
                rows, first = data.observer == k, 6 + 6 * (len(frames.targets) + k)
                out[rows, :, first : first + 6] = moved[rows]
        return np.asarray(data.root @ out[:, :, self.free] * frames.sizes[self.free])

    @property
    def linear(self) -> ReadingModel:
        """The linear model of the readings."""
        none, columns = np.zeros(np.count_nonzero(self.free)), self.columns()
        return ReadingModel(self.white, columns, none, none, self.data.root)

    def moved(self, step: Floats) -> "Placement":
        """Return the placement after a step (K,)."""
        full = np.zeros(len(self.free))
        full[self.free] = self.frames.sizes[self.free] * step
        targets, parts = self.frames.targets.copy(), full.reshape(-1, 6)
        of_targets, of_observers = np.split(parts[1:], [len(targets)])
        targets[:, :3, 3] += of_targets[:, :3]
        targets[:, :3, :3] = se3.rotation(of_targets[:, 3:]) @ targets[:, :3, :3]
        about, back = np.eye(4), np.eye(4)
        about[:3, 3], back[:3, 3] = self._centre, -self._centre
        base = self.frames.base @ about @ se3.matrix(se3.rotation(full[3:6]), full[:3]) @ back
        pairs = zip(self.frames.observers, of_observers, strict=True)
        return replace(self, frames=Frames(base, targets, tuple(_shifted(o, x) for o, x in pairs)))

    def determined(self, spread: float) -> tuple[Floats, Floats]:
        """Undetermined directions (P, U) by the misfit; the step (K,) along the others."""
        a = self.jacobian()
        # Squared singular values up to 1e12 leave rounding of 1e-2 in those that decide, about 10.
        squares, vectors = np.linalg.eigh(a.T @ a)
        visible = squares > (spread / DETERMINED_SHARE) ** 2
        null = np.zeros((len(self.free), np.count_nonzero(~visible)))
        null[self.free] = vectors[:, ~visible]
        part = vectors[:, visible]
        return null, part @ ((part.T @ (a.T @ self.residual)) / squares[visible])

    @cached_property
    def _centre(self) -> Floats:
        """(3,) the point of the base axes that the base turns about, m."""
        return np.asarray(self.data.position.mean(axis=0))


def _shifted(o: Observer, six: Floats) -> Observer:
    """Return an observer whose frame moved by a twist (6,), a point by its offset at 3."""
    if o.name.kind == "point":
        o, six = replace(o, offset=o.offset + float(six[3])), np.append(six[:3], np.zeros(3))
    return replace(o, frame=se3.matrix(*se3.exp(six)) @ o.frame)


def minimise(at: Placement, steps: int = MOST_STEPS) -> Placement:
    """Return the point of least squares that is reached from a start (Levenberg, Marquardt).

        minimise ‖r(p)‖²,    r(p ⊕ δ) = r(p) − J δ + …,    (JᵀJ + λ diag JᵀJ) δ = Jᵀr

    p ⊕ δ need not be a sum, as frames rotate. A prior about zero is a further row of r.
    """
    square, normal, damping = float(at.residual @ at.residual), None, DAMPING
    for _ in range(steps):
        if normal is None:
            a = at.jacobian()
            normal = a.T @ a, a.T @ at.residual
        h, gradient = normal
        if not len(h):
            break
        # Damped in units of each column, too, so that no coordinate diverges.
        largest = h.diagonal().max()
        guard = damping * (h.diagonal() + 1e-6 * largest) + 1e-12 * largest + 1e-300
        step: Floats = np.asarray(np.linalg.solve(h + np.diag(guard), gradient), dtype=float)
        trial = at.moved(step)
        reduced = float(trial.residual @ trial.residual)
        if reduced > square:
            damping *= 8.0
            if damping > 1e8:
                break
            continue
        done = square - reduced <= SETTLED * square + 1e-12 * len(a) and damping <= DAMPING
        at, square, normal = trial, reduced, None
        damping = max(0.1 * damping, 1e-9)
        if done or np.abs(step).max() < LEAST_STEP:
            break
    return at


def best_placement(
    data: FrameData, frames: Frames, free: Bools, good: float, steps: int, rotated: int
) -> Placement:
    """Return the best placement from several starts: closed forms, then rotations of a cube.

    The search ends where a closed form leaves at most the whitened rms misfit `good` per reading;
    otherwise the best `rotated` rotations are followed as well. A start takes at most `steps`.
    """
    placements: list[Placement] = []
    for start in _closed_forms(data, frames, free):
        placements.append(minimise(Placement(data, start, free), steps))
        if placements[-1].square <= good**2 * len(data):
            return min(placements, key=lambda p: p.square)
    if rotated and free[:6].any():
        turns = (_with_translations(data, frames, turn, free) for turn in cube_rotations())
        ranked = sorted((Placement(data, f, free) for f in turns), key=lambda p: p.square)
        placements += [minimise(placement, steps) for placement in ranked[:rotated]]
    return min(placements, key=lambda p: p.square)


def settled(placement: Placement, frames: Frames) -> tuple[Placement, Floats]:
    """Return the minimum, its undetermined part held near the targets of `frames`; and that part.

    The prior has the ordinary sizes as standard deviations. It acts along the undetermined
    directions (P, U) alone: along the others, the last steps go to the minimum without it.
    """
    read = np.count_nonzero(np.any(placement.data.root != 0, axis=2))
    dof = max(int(read) - int(np.count_nonzero(placement.free)), 1)
    spread = max(float(np.sqrt(placement.square / dof)), 1.0)
    null, _ = placement.determined(spread)
    if null.size:
        held = replace(placement, prior_targets=frames.targets, prior_weight=spread)
        placement = replace(minimise(held), prior_targets=None)
    for _ in range(3):
        null, step = placement.determined(spread)
        placement = placement.moved(step)
    return placement, null


def fitted_placement(data: FrameData, frames: Frames, free: Bools) -> tuple[Placement, Floats]:
    """Return the best frames, by a part of the readings, then by all; and undetermined directions.

    The directions (P, U) are of unit length, in ordinary sizes.
    """
    if data.observer is None:
        part = data[np.unique(np.linspace(0, len(data) - 1, START_READINGS).astype(int))]
        best = best_placement(
            part, frames, free, GOOD_RMS * np.sqrt(part.m), START_STEPS, MOST_ROTATIONS
        )
    else:
        rows = (np.flatnonzero(data.observer == k) for k in np.unique(data.observer))
        few = [r[np.linspace(0, len(r) - 1, START_READINGS_EACH).astype(int)] for r in rows]
        part = data[np.unique(np.concatenate(few))]
        starts = [Placement(part, start, free) for start in _starts(data, part, frames, free)]
        starts.sort(key=lambda p: p.square)
        tried = [minimise(start, START_STEPS_SEVERAL) for start in starts[:MOST_FOLLOWED]]
        best = min(tried, key=lambda p: p.square)
    return settled(minimise(Placement(data, best.frames, free)), frames)


def nearest_rotation(m: Floats) -> Floats:
    """Return the rotation (..., 3, 3) nearest to a matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(m)
    flip = np.ones(m.shape[:-1])
    flip[..., 2] = np.sign(np.linalg.det(u @ vt))
    return np.asarray((u * flip[..., None, :]) @ vt)


def rotation_of_attitudes(attitude: Floats, flange: Floats) -> Floats:
    """(3, 3) A of M_i Bᵀ = A R_i, attitudes M and flange orientations R (N, 3, 3)."""
    # A linear system, vec by rows: (M_i ⊗ I) vec(Bᵀ) = (I ⊗ R_iᵀ) vec(A)
    eye = np.eye(3)
    left = np.einsum("nij,kl->nikjl", attitude, eye).reshape(-1, 9)
    right = np.einsum("ij,nlk->nikjl", eye, flange).reshape(-1, 9)
    gram = np.concatenate([left, -right], axis=1)
    a = np.linalg.eigh(gram.T @ gram)[1][9:, 0].reshape(3, 3)
    return nearest_rotation(a * (np.sign(np.linalg.det(a)) or 1.0))


def cube_rotations() -> Floats:
    """(24, 3, 3) the rotations that take a cube to itself."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.asarray(np.round(Rotation.create_group("O").as_matrix()))


def _closed_forms(data: FrameData, frames: Frames, free: Bools) -> Iterator[Frames]:
    """Yield base and targets from attitudes and from positions."""
    if not free[:6].any():
        yield _with_translations(data, frames, frames.base[:3, :3], free)
        return
    if data.attitude is not None:
        first = data.target == data.target[0]
        base = rotation_of_attitudes(data.attitude[first], data.rotation[first])
        yield _with_translations(data, frames, base, free)
    # Positions alone: Procrustes for R, then linear for τ and t, a few times.
    out, y = frames, data.value - data.value.mean(axis=0)
    for _ in range(ALTERNATIONS):
        x, previous = data.points(out), out.targets
        turn = nearest_rotation(y.T @ (x - x.mean(axis=0)))
        out = _with_translations(data, frames, turn, free)
        if np.abs(out.targets - previous).max() < 1e-6:
            break
    yield out


def _with_translations(data: FrameData, frames: Frames, rotation: Floats, free: Bools) -> Frames:
    """Complete a rotation of the base by the best translations and the targets' axes."""
    count, size = len(data), len(frames.targets)
    turned, rows_of = rotation @ data.rotation, [data.target == k for k in range(size)]
    a = np.zeros((count, 3, 3 + 3 * size))
    a[:, :, :3] = np.eye(3)
    for k, rows in enumerate(rows_of):
        a[rows, :, 3 + 3 * k : 6 + 3 * k] = turned[rows]
    live = np.repeat(free[::6], 3)
    x = np.concatenate([frames.base[:3, 3], *frames.targets[:, :3, 3]])
    hold = np.repeat([START_WEIGHT / BASE_M] + [START_WEIGHT / TARGET_M] * size, 3)
    flat = a.reshape(-1, len(x))
    remainder = (data.value - data.position @ rotation.T).reshape(-1) - flat @ x
    if live.any():
        system = np.concatenate([flat, np.diag(hold * np.sqrt(count))])[:, live]
        x[live] += np.linalg.lstsq(system, np.append(remainder, np.zeros(len(x))), rcond=None)[0]
    targets = frames.targets.copy()
    targets[:, :3, 3] = x[3:].reshape(size, 3)
    if data.attitude is not None:
        means = [np.einsum("nji,njk->ik", turned[rows], data.attitude[rows]) for rows in rows_of]
        targets[:, :3, :3] = nearest_rotation(np.array(means))
    return replace(frames, base=se3.matrix(rotation, x[:3]), targets=targets)


def _starts(data: FrameData, part: FrameData, frames: Frames, free: Bools) -> Iterator[Frames]:
    """Yield starts for several observers, which are placed by `part` of the readings.

    Base and targets are placed by stations of known place where there are enough readings of them,
    else by rotations of a cube.
    """
    known = [k for k, o in enumerate(frames.observers) if o.name.kind == "station" and not o.free]
    rows, bases = np.isin(np.asarray(data.observer), known), [frames]
    if len(np.unique(np.round(data.position[rows], 9), axis=0)) >= MIN_POSES:
        by_stations = replace(data[rows], observer=None)
        of_both = free[: 6 + 6 * len(frames.targets)]
        good = GOOD_RMS * np.sqrt(data.m)
        alone = replace(frames, observers=())
        best = best_placement(by_stations, alone, of_both, good, START_STEPS, MOST_ROTATIONS).frames
        bases = [replace(best, observers=frames.observers)]
    elif free[:6].any():
        tied = [o.frame for o in frames.observers if o.tied]
        centre = np.mean([-f[:3, :3].T @ f[:3, 3] for f in tied], axis=0)
        bases = [replace(frames, base=se3.matrix(turn, centre)) for turn in cube_rotations()]
    for f in bases:
        p, observers = part.points(f) @ f.base[:3, :3].T + f.base[:3, 3], []
        for k, o in enumerate(frames.observers):
            read_by = part.observer == k
            placed = bool(o.free) and bool(np.any(read_by))
            observers.append(_observer_placed(o, p[read_by], part.value[read_by]) if placed else o)
        yield replace(f, observers=tuple(observers))


def _observer_placed(o: Observer, p: Floats, value: Floats) -> Observer:
    """Place an observer by its readings (N, 3) of positions (N, 3), sensor axes."""
    middle, read = p.mean(axis=0), value.mean(axis=0)
    x = p - middle
    if o.name.kind == "station":
        turn = nearest_rotation((value - read).T @ x)
        return replace(o, frame=se3.matrix(turn, read - turn @ middle))
    if o.name.kind == "point":
        # |p|² − d² = 2 p·c − |c|², d the reading less its offset, which is linear in it, too.
        if not set(o.free) & {0, 1, 2}:
            return o
        open_offset = 3 in o.free
        d = value[:, 0] - (0.0 if open_offset else o.offset)
        columns = [2 * x, np.ones((len(p), 1))] + ([-2 * d[:, None]] if open_offset else [])
        solution = np.linalg.lstsq(np.hstack(columns), np.sum(x**2, axis=1) - d**2, rcond=1e-6)[0]
        frame = se3.matrix(np.eye(3), -(solution[:3] + middle))
        return replace(o, frame=frame, offset=-float(solution[4]) if open_offset else o.offset)
    if 4 not in o.free:  # the direction of the gauge is known
        frame = o.frame.copy()
        frame[0, 3] = read[0] - frame[0, :3] @ middle
        return replace(o, frame=frame)
    # G = n·p − h: linear in n and h; where nearly all points lie in a plane, its normal.
    g = value[:, 0] - read[0]
    axes, linear = np.linalg.svd(x, full_matrices=True)[2], np.linalg.lstsq(x, g, rcond=1e-6)[0]
    tried = [n / np.linalg.norm(n) for n in (linear, axes[2], -axes[2]) if np.linalg.norm(n) > 1e-9]
    best = min(tried, key=lambda n: float(np.sum((x @ n - g) ** 2)))
    return replace(o, frame=plane_frame(best, middle - read[0] * best))
