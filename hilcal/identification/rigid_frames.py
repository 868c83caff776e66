"""Base and target frames by whitened least squares on positions and attitudes together.

With the nominal flange poses (R_i, p_i), readings y_i obey

    y_i = R (p_i + R_i τ) + t,      M_i = R R_i R_τ  (attitude, where read)

R, t: the base in the sensor's frame; τ, R_τ: the target k(i) on the flange.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

ROUGH_M = 1e-4
ROUGH_RAD = 1e-4
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
STEPS = 40
"""Most damped Gauss-Newton steps; a choice."""
SMALL = 1e-12
"""A step below this in units of the ordinary sizes ends the search; rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
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

    @property
    def m(self) -> int:
        """Elements per reading: 3 or 6."""
        return 3 if self.attitude is None else 6

    def __len__(self) -> int:
        """Return the number of readings."""
        return len(self.value)

    def __getitem__(self, rows: Ints | Bools | slice) -> "Seen":
        """Return the chosen readings."""
        attitude = None if self.attitude is None else self.attitude[rows]
        return Seen(
            self.rotation[rows],
            self.position[rows],
            self.value[rows],
            attitude,
            self.root[rows],
            self.target[rows],
        )


def inverse_roots(covariance: Floats) -> Floats:
    """(N, m, m) lower triangular W with W V Wᵀ = I, V the covariance with the roughness added.

    A covariance may have an eigenvalue below zero by rounding (`tables.checks`), which can be
    larger than the roughness; it counts as zero.
    """
    m = covariance.shape[-1]
    rough = np.diag(np.repeat([ROUGH_M**2, ROUGH_RAD**2], 3)[:m])
    try:
        root = np.linalg.cholesky(covariance + rough)
    except np.linalg.LinAlgError:
        value, axes = np.linalg.eigh(covariance)
        whole = (axes * np.maximum(value, 0.0)[:, None, :]) @ np.swapaxes(axes, 1, 2)
        root = np.linalg.cholesky(whole + rough)
    return np.asarray(np.linalg.inv(root))


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
class Free:
    """Which of the 6 + 6 T frame parameters are estimated.

    Parameters: shift of the base at the centroid of the readings and turn, base axes; per target
    shift and turn, flange axes.

    Attributes:
        mask: (6 + 6 T,) the estimated ones.
    """

    mask: Bools

    @classmethod
    def of(cls, base: bool, targets: Bools, attitudes: bool) -> "Free":
        """Return what is free where base and targets (T,) are or are not unknown.

        A target's axes show in attitudes alone, and are estimated from them also where its offset
        is known.
        """
        mask = [np.full(6, base)]
        mask += [np.repeat([bool(t), attitudes], 3) for t in targets]
        return cls(np.concatenate(mask))


def misfit(seen: Seen, frames: Frames) -> Floats:
    """(N, m) measured minus predicted, sensor axes, m and rad."""
    r, t = frames.base[:3, :3], frames.base[:3, 3]
    target = frames.targets[seen.target]
    x = seen.position + np.einsum("nij,nj->ni", seen.rotation, target[:, :3, 3])
    off = seen.value - x @ r.T - t
    if seen.attitude is None:
        return np.asarray(off)
    predicted = r @ seen.rotation @ target[:, :3, :3]
    turn = se3.rotation_vector(seen.attitude @ np.swapaxes(predicted, 1, 2))
    return np.concatenate([off, turn], axis=1)


def derivative(seen: Seen, frames: Frames, centre: Floats) -> Floats:
    """(N, m, 6 + 6 T) derivative of the predicted readings by the parameters."""
    r = frames.base[:3, :3]
    target = frames.targets[seen.target]
    x = seen.position + np.einsum("nij,nj->ni", seen.rotation, target[:, :3, 3]) - centre
    turned = r @ seen.rotation
    count, size = len(seen), len(frames.targets)
    out = np.zeros((count, seen.m, 6 + 6 * size))
    out[:, :3, :3] = r
    out[:, :3, 3:6] = -r @ se3.skew(x)
    if seen.m == 6:
        out[:, 3:, 3:6] = r
    for k in range(size):
        mine = seen.target == k
        at = 6 + 6 * k
        out[mine, :3, at : at + 3] = turned[mine]
        if seen.m == 6:
            out[mine, 3:, at + 3 : at + 6] = turned[mine]
    return out


def moved(frames: Frames, step: Floats, centre: Floats) -> Frames:
    """Return the frames after a step of the parameters (6 + 6 T,)."""
    about, back = np.eye(4), np.eye(4)
    about[:3, 3], back[:3, 3] = centre, -centre
    turn = se3.matrix(se3.rotation(step[3:6]), step[:3])
    targets = frames.targets.copy()
    own = step[6:].reshape(-1, 6)
    targets[:, :3, 3] += own[:, :3]
    targets[:, :3, :3] = se3.rotation(own[:, 3:]) @ targets[:, :3, :3]
    return Frames(frames.base @ about @ turn @ back, targets)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum:
    """The frames of least squares.

    Attributes:
        frames: base and targets.
        off: (N, m) misfit.
        square: whitened sum of squares.
        null: (6 + 6 T, U) unit directions of the parameters, in ordinary sizes, that the readings
            do not determine.
        centre: (3,) the point of the base axes that the base turns about in the parameters, m.
    """

    frames: Frames
    off: Floats
    square: float
    null: Floats
    centre: Floats


def sizes(targets: int) -> Floats:
    """(6 + 6 T,) ordinary sizes of the parameters, m and rad."""
    own = [TARGET_M] * 3 + [1.0] * 3
    return np.array([BASE_M] * 3 + [1.0] * 3 + own * targets)


def minimise(
    seen: Seen,
    start: Frames,
    free: Free,
    weights: Floats | None = None,
    steps: int = STEPS,
    hold: "Hold | None" = None,
) -> Minimum:
    """Damped Gauss-Newton (Levenberg, Marquardt) from a start.

    Args:
        seen: flange poses and readings.
        start: base and targets to start from.
        free: what is estimated.
        weights: (N,) of the readings, all 1 unless given.
        steps: most steps.
        hold: prior of the targets; none unless given.
    """
    centre = np.asarray(seen.position.mean(axis=0))
    root = seen.root if weights is None else seen.root * np.sqrt(weights)[:, None, None]
    scale = sizes(len(start.targets)) * free.mask
    frames, damping = start, 1e-3
    off = misfit(seen, frames)
    white = np.einsum("nij,nj->ni", root, off)
    away = _away(frames, hold, scale)
    square = float(np.sum(white**2) + np.sum(away**2))
    h, g = np.eye(len(scale)), np.zeros(len(scale))
    fresh = True
    for _ in range(steps):
        if fresh:
            a = (root @ derivative(seen, frames, centre)).reshape(-1, len(scale)) * scale
            h, g = a.T @ a, a.T @ white.reshape(-1)
            if hold is not None:
                slope = hold.slopes(free)
                h, g = h + np.diag(slope**2), g - slope * away
        # Damped in ordinary sizes and in units of each column, so that nothing runs away.
        guard = damping * (np.diag(h) + 1e-6 * h.max()) + 1e-12 * h.max()
        step = np.linalg.solve(h + np.diag(guard + ~free.mask), g)
        trial = moved(frames, scale * step, centre)
        trial_off = misfit(seen, trial)
        trial_white = np.einsum("nij,nj->ni", root, trial_off)
        trial_away = _away(trial, hold, scale)
        now = float(np.sum(trial_white**2) + np.sum(trial_away**2))
        fresh = now <= square
        if fresh:
            done = square - now <= 1e-9 * square + 1e-12 * len(seen) and damping <= 1e-3
            frames, off, white, away, square = trial, trial_off, trial_white, trial_away, now
            damping = max(0.1 * damping, 1e-9)
            if done or np.abs(step).max() < SMALL:
                break
        else:
            damping *= 8.0
            if damping > 1e8:
                break
    return Minimum(frames, off, float(np.sum(white**2)), np.zeros((len(scale), 0)), centre)


@dataclass(frozen=True, slots=True, eq=False)
class Hold:
    """Prior of the targets: as given, to within the ordinary sizes.

    Attributes:
        given: base and targets as configured, or the nominal ones.
        weight: of a target that is an ordinary size off, in units of whitened misfit.
    """

    given: Frames
    weight: float

    def slopes(self, free: Free) -> Floats:
        """(6 + 6 T,) derivative of the weighted distance by the parameters, in ordinary sizes."""
        each = np.repeat([1.0, 1 / np.pi], 3)
        own = np.tile(each, len(self.given.targets)) * free.mask[6:]
        return np.concatenate([np.zeros(6), self.weight * own])


def settled(seen: Seen, at: Minimum, free: Free, given: Frames) -> Minimum:
    """Return the minimum with what the readings do not determine held near the given targets.

    The prior has the ordinary sizes as standard deviations. It acts along the undetermined
    directions alone: along the others, the last steps go to the minimum without it.
    """
    count = max(seen.m * len(seen) - int(np.count_nonzero(free.mask)), 1)
    spread = max(float(np.sqrt(at.square / count)), 1.0)
    begin, scale = at, sizes(len(given.targets)) * free.mask
    null, _ = _determined(seen, at, scale, spread)
    if null.size:
        held = minimise(seen, at.frames, free, hold=Hold(given, spread))
        begin = replace(held, centre=at.centre)
    for _ in range(3):
        null, step = _determined(seen, begin, scale, spread)
        frames = moved(begin.frames, scale * step, at.centre)
        off = misfit(seen, frames)
        square = float(np.sum(np.einsum("nij,nj->ni", seen.root, off) ** 2))
        begin = Minimum(frames, off, square, null, at.centre)
    return begin


def _determined(seen: Seen, at: Minimum, scale: Floats, spread: float) -> tuple[Floats, Floats]:
    """Undetermined directions (P, U), and the Gauss-Newton step (P,) along the others."""
    live = np.flatnonzero(scale)
    a = (seen.root @ derivative(seen, at.frames, at.centre)).reshape(-1, len(scale))[:, live]
    white = np.einsum("nij,nj->ni", seen.root, at.off).reshape(-1)
    a *= scale[live]
    # Squared singular values up to 1e12 leave rounding of 1e-2 in those that decide, of about 10.
    squares, vectors = np.linalg.eigh(a.T @ a)
    told = squares > (spread / TELL) ** 2
    null, step = np.zeros((len(scale), int((~told).sum()))), np.zeros(len(scale))
    null[live] = vectors[:, ~told]
    part = vectors[:, told]
    step[live] = part @ ((part.T @ (a.T @ white)) / squares[told])
    return null, step


def _away(frames: Frames, hold: Hold | None, scale: Floats) -> Floats:
    """(6 + 6 T,) weighted distance of the targets from the given ones; zero without a prior."""
    out = np.zeros(len(scale))
    if hold is not None:
        shift = frames.targets[:, :3, 3] - hold.given.targets[:, :3, 3]
        back = np.swapaxes(hold.given.targets[:, :3, :3], 1, 2)
        turn = se3.rotation_vector(frames.targets[:, :3, :3] @ back)
        whole = np.concatenate([shift / TARGET_M, turn / np.pi], axis=1).reshape(-1)
        there = np.flatnonzero(scale[6:])
        out[6 + there] = hold.weight * whole[there]
    return out
