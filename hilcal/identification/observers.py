"""The places of several observers, before anything else is fitted.

Stations beside the first, points that distances are measured from, and gauges are placed by
whitened least squares on the readings of the nominal arm, together with what is unknown of base and
targets. The starts are closed forms: the rigid motion between two point sets for a station
(Kabsch), linear equations for a point (|p|² − d² is linear in the point) and for a plane.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from hilcal.cell import Cell, Observer, plane_frame
from hilcal.identification.rigid_frames import (
    BASE_M,
    ROUGH,
    TARGET_M,
    TELL,
    FrameData,
    angles,
    best_placement,
    cube,
    given_and_free,
    nearest_rotation,
)
from hilcal.model.observe import read_by
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import inverse_root
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats

FEW = 50
"""Readings of each observer that the starts are tried on; a choice."""
STARTS = 6
"""Starts that are followed to the end, of the rotations of a cube; a choice."""
GOOD, STEPS, TRIED = 10.0, 15, 5
"""As of `registration`."""
HOLD = 1e-3
"""Weight of an ordinary size in whitened rows: keeps what the readings do not tell where it began;
a choice, far below what they tell."""


@dataclass(frozen=True, eq=False)
class Sightings:
    """Readings of several observers beside the flange poses of the nominal arm.

    Attributes:
        cell: with the observers of the readings.
        readings: N readings.
        rotation: (N, 3, 3) nominal orientation of the flange.
        position: (N, 3) its nominal position, m.
        root: (N, m, m) inverse root of the covariance, roughness included; zero in the rows of
            what is not read.
        targets: which of the targets are unknown, (T,).
    """

    cell: Cell
    readings: Readings
    rotation: Floats
    position: Floats
    root: Floats
    targets: Bools

    @classmethod
    def of(cls, cell: Cell, readings: Readings) -> "Sightings":
        """Return readings beside the nominal arm."""
        chain, m = evaluate(cell.arm, angles(readings)), readings.m
        rough = np.repeat(np.square(ROUGH), 3)[:m] * np.eye(m)
        seen = np.diagonal(readings.covariance, axis1=1, axis2=2) > 0
        rough = rough * (seen[:, :, None] & seen[:, None, :])
        return cls(
            cell,
            readings,
            chain.rotation[-1],
            chain.position[-1],
            inverse_root(readings.covariance + rough),
            ~np.array(cell.known_targets),
        )

    def __getitem__(self, rows: Bools) -> "Sightings":
        """Return the chosen readings."""
        return replace(
            self,
            readings=self.readings[rows],
            rotation=self.rotation[rows],
            position=self.position[rows],
            root=self.root[rows],
        )

    @property
    def sizes(self) -> Floats:
        """(K,) ordinary sizes of what is unknown: base, targets, observers."""
        base = [] if self.cell.registration_known else [BASE_M] * 3 + [1.0] * 3
        by = [BASE_M if e < 3 else 1.0 for o in self.cell.observers for e in o.free]
        return np.array([*base, *[TARGET_M] * 3 * int(self.targets.sum()), *by])

    def sensor(self, cell: Cell) -> Floats:
        """(N, 3) predicted positions of the targets, sensor axes, m."""
        offset = cell.all_targets[self.readings.target, :3, 3]
        base = self.position + se3.apply(self.rotation, offset)
        return np.asarray(base @ cell.registration[:3, :3].T + cell.registration[:3, 3])

    def off(self, cell: Cell) -> Floats:
        """(N, m) measured minus predicted, m and rad; zero in elements that are not read."""
        r, targets = self.readings, cell.all_targets[self.readings.target]
        turn = cell.registration[:3, :3] @ self.rotation @ targets[:, :3, :3]
        position, turned = read_by(cell.observers, r.observer, self.sensor(cell), turn)
        off = r.value[:, :3] - position
        if r.m == 3:
            return np.asarray(off)
        apart = se3.rotation(r.value[:, 3:]) @ np.swapaxes(turned, 1, 2)
        return np.concatenate([off, se3.rotation_vector(apart)], axis=1)

    def moved(self, cell: Cell, step: Floats) -> Cell:
        """Return a cell moved by (K,), in ordinary sizes."""
        x, at = step * self.sizes, 0
        if not cell.registration_known:
            about, back = np.eye(4), np.eye(4)
            centre = self.position.mean(axis=0)
            about[:3, 3], back[:3, 3] = centre, -centre
            turn = se3.matrix(se3.rotation(x[3:6]), x[:3])
            cell = replace(cell, registration=cell.registration @ about @ turn @ back)
            at = 6
        poses = cell.all_targets.copy()
        for k in np.flatnonzero(self.targets):
            poses[k, :3, 3] += x[at : at + 3]
            at += 3
        observers = []
        for o in cell.observers:
            own, at = x[at : at + len(o.free)], at + len(o.free)
            six = np.zeros(6)
            six[list(o.free)] = own
            more = six[3] if o.name.kind == "point" else 0.0
            six[3] -= more
            frame = se3.matrix(*se3.exp(six)) @ o.frame
            observers.append(replace(o, frame=frame, offset=o.offset + more))
        return replace(cell.with_targets(poses), observers=tuple(observers))

    def white(self, cell: Cell) -> Floats:
        """(N·m,) whitened misfit."""
        return np.asarray((self.root @ self.off(cell)[:, :, None]).reshape(-1))

    def settled(self, begun: Cell, steps: int | None = None) -> tuple[Cell, float, Floats]:
        """Return the minimum near a start, its sum of squares, and the Jacobian (R, K) there."""

        def residual(x: Floats) -> Floats:
            return np.concatenate([self.white(self.moved(begun, x)), HOLD * x])

        count = len(self.sizes)
        if not count:
            return begun, float(np.sum(self.white(begun) ** 2)), np.zeros((self.root[0].size, 0))
        found = least_squares(residual, np.zeros(count), method="trf", max_nfev=steps)
        jacobian = np.asarray(found.jac, dtype=float)[: len(found.fun) - count]
        return self.moved(begun, found.x), 2.0 * float(found.cost), jacobian


def placed(cell: Cell, readings: Readings) -> tuple[Cell, Floats, Floats]:
    """Place base, targets and observers as far as they are unknown.

    Args:
        cell: with the observers of the readings, see `Cell.observed_by`.
        readings: N readings.

    Returns:
        The cell with all in place; (N, m) measured minus predicted; directions (K, U) of unit
        length, in ordinary sizes, that the readings do not determine.
    """
    seen = Sightings.of(cell, readings)
    part = np.zeros(len(readings), dtype=bool)
    for k in range(len(cell.observers)):
        own = np.flatnonzero(readings.observer == k)
        part[own[np.unique(np.linspace(0, len(own) - 1, FEW).astype(int))] if len(own) else own] = 1
    few = seen if part.all() else seen[part]
    begun = [_observed(few, start) for start in _starts(cell, readings)]
    begun.sort(key=lambda c: float(np.sum(few.white(c) ** 2)))
    tried = [few.settled(c, 50) for c in begun[:STARTS]]
    found, square, jacobian = seen.settled(min(tried, key=lambda t: t[1])[0])
    rank = int(np.count_nonzero(np.any(seen.root != 0, axis=2)))
    spread = max(np.sqrt(square / max(rank - jacobian.shape[1], 1)), 1.0)
    squares, vectors = np.linalg.eigh(jacobian.T @ jacobian)
    return found, seen.off(found), vectors[:, squares <= (spread / TELL) ** 2]


def _starts(cell: Cell, readings: Readings) -> Iterator[Cell]:
    """Yield where base and targets may be: by the first station's readings, else all round."""
    main = [k for k, o in enumerate(cell.observers) if o.name.kind == "station" and not o.free]
    rows = np.isin(readings.observer, main)
    if rows.any() and len(np.unique(readings.pose[rows])) >= 4:
        given, free = given_and_free(cell, readings.m == 6)
        of = FrameData.of(cell.arm, readings[rows])
        at = best_placement(of, given, free, GOOD * np.sqrt(of.m), STEPS, TRIED).frames
        yield replace(cell.with_targets(at.targets), registration=at.base)
    elif cell.registration_known:
        yield cell
    else:
        known = [o.frame for o in cell.observers if o.tied]
        centre = np.mean([-f[:3, :3].T @ f[:3, 3] for f in known], axis=0)
        for turn in cube():
            base = se3.matrix(turn, centre)
            yield replace(cell, registration=base)


def _observed(seen: Sightings, cell: Cell) -> Cell:
    """Return a cell with each observer where its readings have it, by closed forms."""
    p, out = seen.sensor(cell), []
    for k, o in enumerate(cell.observers):
        mine = seen.readings.observer == k
        begin = _BEGIN[o.name.kind]
        begun = o.free and mine.any()
        out.append(begin(o, p[mine], seen.readings.value[mine, :3]) if begun else o)
    return replace(cell, observers=tuple(out))


def _station(o: Observer, p: Floats, value: Floats) -> Observer:
    middle, read = p.mean(axis=0), value.mean(axis=0)
    turn = nearest_rotation((value - read).T @ (p - middle))
    return replace(o, frame=se3.matrix(turn, read - turn @ middle))


def _point(o: Observer, p: Floats, value: Floats) -> Observer:
    """|p|² − d² = 2 p·c − |c|², d the reading less its offset, which is linear in it, too."""
    if not set(o.free) & {0, 1, 2}:
        return o
    d = value[:, 0] - (0.0 if 3 in o.free else o.offset)
    middle = p.mean(axis=0)
    x = p - middle
    columns = [2 * x, np.ones((len(p), 1))] + ([-2 * d[:, None]] if 3 in o.free else [])
    found = np.linalg.lstsq(np.hstack(columns), np.sum(x**2, axis=1) - d**2, rcond=1e-6)[0]
    frame = np.eye(4)
    frame[:3, 3] = -(found[:3] + middle)
    return replace(o, frame=frame, offset=-float(found[4]) if 3 in o.free else o.offset)


def _gauge(o: Observer, p: Floats, value: Floats) -> Observer:
    """G = n·p − h: linear in n and h; where hardly anything but a plane is touched, its normal."""
    middle, read = p.mean(axis=0), float(value[:, 0].mean())
    x, g = p - middle, value[:, 0] - read
    if 4 not in o.free:
        return replace(o, frame=_shifted(o.frame, read, middle))
    _, _, axes = np.linalg.svd(x, full_matrices=True)
    linear = np.linalg.lstsq(x, g, rcond=1e-6)[0]
    tried = [n / np.linalg.norm(n) for n in (linear, axes[2], -axes[2]) if np.linalg.norm(n) > 1e-9]
    best = min(tried, key=lambda n: float(np.sum((x @ n - g) ** 2)))
    return replace(o, frame=plane_frame(best, middle - read * best))


def _shifted(frame: Floats, read: float, middle: Floats) -> Floats:
    """Return a frame moved along its x so that the mean reading is right."""
    out = frame.copy()
    out[0, 3] = read - frame[0, :3] @ middle
    return out


_BEGIN: dict[str, Callable[[Observer, Floats, Floats], Observer]] = {
    "station": _station,
    "point": _point,
    "gauge": _gauge,
}
