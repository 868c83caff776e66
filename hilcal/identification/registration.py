"""The tracker's registration and the target's offset, before anything else is fitted.

Positions and attitudes register together, by whitened least squares over the frames of the nominal
arm from several starts (`rigid_frames`); readings that are centimetres off are found from a robust
start, and left out. What the poses cannot tell stays near the cell's target and is listed.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell, Observer
from hilcal.errors import CannotAnswerError
from hilcal.identification.common_cause import off_alike
from hilcal.identification.least_trimmed_squares import MOST, limit, robust_start, variance
from hilcal.identification.observers import Sightings, placed
from hilcal.identification.rigid_frames import (
    FrameData,
    Frames,
    Placement,
    angles,
    best_placement,
    given_and_free,
    settled,
    sizes,
)
from hilcal.identification.solver import minimise
from hilcal.readings.readings import Readings
from hilcal.robot import se3
from hilcal.types import Bools, Floats

MIN_POSES = 4
NARROW = 1e-3
"""Rms distance from a line, m, below which positions are collinear; a choice."""
FEW = 100
"""Readings that the starts are tried on, spread over all; a choice: 17 times the unknowns."""
GOOD = 10.0
"""Rms misfit, in units of noise with roughness, at which no other start is tried: about 1 mm and
1 mrad. A choice: arms are so accurate before calibration."""
STEPS, TRIED = 15, 5
"""Steps from each start, and rotations of a cube that are tried; choices."""
DISTURBED = 3e-3
"""Rms misfit, m, from which on readings that are far off are looked for: nominal arms are off by
less. A choice, a third of what is fitted at least (`misdescription.GATE_M`)."""
BEYOND = 10.0
"""Times the median misfit from which on a reading of several observers is far off; a choice."""
LEAST_FAR = 1e-4
"""Misfit that is never far off, m; a choice."""
SEED = 0
"""Of the random subsets, so that equal readings give equal frames."""
ROUNDS = 5
"""Most rounds in which readings join and leave; a choice."""
TURNED = 1e-3
"""Range of a joint's angle, rad, below which it counts as never turned; a choice."""
TOLD = 0.05
"""Component of an undetermined direction, in ordinary sizes, that is worth mentioning; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Undetermined:
    """Frame parameters that can move together without any reading telling it.

    Attributes:
        target: index of the target that moves, or None where the base alone moves.
        target_shift: (3,) its shift, flange axes, m.
        target_turn: (3,) its turn, flange axes, rad.
        base_shift: (3,) shift of the base that goes with it, base axes, m; at the middle of the
            flange's positions.
        base_turn: (3,) turn of the base, base axes, rad.
        observers: what of several observers moves with it, as "point P" .
    """

    target: int | None
    target_shift: Floats
    target_turn: Floats
    base_shift: Floats
    base_turn: Floats
    observers: tuple[str, ...] = ()

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
    """Where base and target ended, and what the poses could not tell.

    Attributes:
        cell: the cell with base and target in place.
        off: (N, m) measured minus predicted by the nominal arm, sensor axes, m and rad.
        rms: root mean square of the 3-D position error, m, of the readings that are not far off.
        turn_rms: root mean square of the attitude's error, rad; None for positions alone.
        far: (N,) readings far off while the others fit, which the frames are not fitted to.
        undetermined: what the poses cannot tell.
        still: (n,) joints that never turned.
        estimated: whether anything was unknown.
    """

    cell: Cell
    off: Floats
    rms: float
    turn_rms: float | None
    far: Bools
    undetermined: tuple[Undetermined, ...]
    still: Bools
    estimated: bool

    def to_json(
        self, base: Floats | None = None, targets: Floats | None = None
    ) -> dict[str, object]:
        """Return its JSON.

        Args:
            base: (4, 4) as a fit has it.
            targets: (T, 4, 4) the same.
        """
        cell = self.cell
        own = cell.all_targets if targets is None else targets
        several = cell.target_names if cell.targets is not None else ()
        each = {name: _pose(t) for name, t in zip(several, own, strict=False)}
        return {
            "base": _pose(cell.registration if base is None else base),
            "target": _pose(own[0]),
            **({"targets": each} if each else {}),
            "estimated": self.estimated,
            "rms_m": self.rms,
            "rms_rad": self.turn_rms,
            "undetermined": [u.to_json() for u in self.undetermined],
            "joints_never_turned": (np.flatnonzero(self.still) + 1).tolist(),
        }


def _pose(t: Floats) -> dict[str, Sequence[float]]:
    return {"xyz_m": t[:3, 3].tolist(), "rotvec_rad": se3.rotation_vector(t[:3, :3]).tolist()}


def register(cell: Cell, readings: Readings) -> Registration:
    """Estimate the registration and the target's offset where they are unknown.

    Raises:
        CannotAnswerError: where the poses do not determine it (fewer than four distinct positions,
            or all on one line).
    """
    if readings.states.observer is not None:
        return _of_several(cell.observed_by(readings.observers), readings)
    angle, seen = angles(readings), FrameData.of(cell.arm, readings)
    given, free = given_and_free(cell, seen.m == 6)
    known = cell.registration_known and cell.target_known
    if known:
        at, null = Placement(seen, given, np.zeros_like(free)), np.zeros((len(free), 0))
        far = _far(readings, at)
    else:
        distinct = len(np.unique(np.round(angle, 9), axis=0))
        if distinct < MIN_POSES:
            raise CannotAnswerError(
                f"registration: {distinct} distinct poses; measure at least {MIN_POSES}, better "
                "10, that turn the flange and do not lie on a line"
            )
        at, null = _fitted(seen, given, free)
        far = _far(readings, at)
        if far.any():
            at, null = _fitted(seen[~far], given, free)
        if seen.m == 3 and not cell.registration_known:
            _refuse_lines(seen, at.frames)
        cell = replace(cell.with_targets(at.frames.targets), registration=at.frames.base)
    off = seen.misfit(at.frames)
    near = off[~far]
    turn_rms = float(np.sqrt(np.mean(np.sum(near[:, 3:] ** 2, axis=1))))
    return Registration(
        cell=cell,
        off=off,
        rms=float(np.sqrt(np.mean(np.sum(near[:, :3] ** 2, axis=1)))),
        turn_rms=turn_rms if seen.m == 6 else None,
        far=far,
        undetermined=_undetermined(null),
        still=np.ptp(angle, axis=0) < TURNED,
        estimated=not known,
    )


def _of_several(cell: Cell, readings: Readings) -> Registration:
    """Register readings of several observers.

    Raises:
        CannotAnswerError: fewer readings of an observer than what is unknown of it.
    """
    angle = angles(readings)
    for k, o in enumerate(cell.observers):
        mine = readings.observer == k
        count = len(np.unique(angle[mine], axis=0)) * (3 if o.name.kind == "station" else 1)
        if 0 < count < len(o.free):
            raise CannotAnswerError(
                f"registration: {o.name} has readings of {mine.sum()} poses, too few for the "
                f"{len(o.free)} unknowns of its place; measure more, or state its place"
            )
    found, off, null = placed(cell, readings)
    size = np.linalg.norm(off[:, :3], axis=1)
    far = size > max(LEAST_FAR, BEYOND * float(np.median(size)))
    if 0 < far.mean() <= MOST:
        found, _, null = placed(cell, readings[~far])
        off = Sightings.of(cell, readings).off(found)
        size = np.linalg.norm(off[:, :3], axis=1)
        far = size > max(LEAST_FAR, BEYOND * float(np.median(size)))
    near = off[~far]
    targets = ~np.array(cell.known_targets)
    count, base = len(targets), not cell.registration_known
    whole = np.zeros((6 + 6 * count, null.shape[1]))
    at = 6 * base
    whole[:at] = null[:at]
    for k in np.flatnonzero(targets).tolist():
        whole[6 + 6 * k : 9 + 6 * k] = null[at : at + 3]
        at += 3
    moved = [tuple[str, ...](str(o.name) for o, v in _parts(cell, null[at:, u]) if v)
             for u in range(null.shape[1])]  # fmt: skip
    told = []
    for u, names in enumerate(moved):
        one = _direction(whole[:, u] / np.abs(whole[:, u]).max(initial=TOLD))
        told.append(replace(one, observers=names))
    turn = near[:, 3:]
    return Registration(
        cell=found,
        off=off,
        rms=float(np.sqrt(np.mean(np.sum(near[:, :3] ** 2, axis=1)))),
        turn_rms=float(np.sqrt(np.mean(np.sum(turn**2, axis=1)))) if readings.m == 6 else None,
        far=far if far.mean() <= MOST else np.zeros_like(far),
        undetermined=tuple(told),
        still=np.ptp(angle, axis=0) < TURNED,
        estimated=base or bool(targets.any()) or any(o.free for o in cell.observers),
    )


def _parts(cell: Cell, v: Floats) -> Iterator[tuple[Observer, bool]]:
    """Yield each observer, and whether a direction (E,) of all moves it."""
    at = 0
    for o in cell.observers:
        yield o, bool(np.any(np.abs(v[at : at + len(o.free)]) > TOLD))
        at += len(o.free)


def _fitted(seen: FrameData, given: Frames, free: Bools) -> tuple[Placement, Floats]:
    """Return the best frames by a part of the readings, then all, and what they do not determine.

    The undetermined directions (6 + 6 T, U) are of unit length, in ordinary sizes.
    """
    part = seen[np.unique(np.linspace(0, len(seen) - 1, FEW).astype(int))]
    best = best_placement(part, given, free, GOOD * np.sqrt(part.m), STEPS, TRIED)
    return settled(minimise(Placement(seen, best.frames, free)), given)


def _far(readings: Readings, at: Placement) -> Bools:
    """(N,) readings far off while the others fit to within `DISTURBED`; none in other cases.

    Args:
        readings: N readings.
        at: the frames of all of them.
    """
    seen, none = at.seen, np.zeros(len(readings), dtype=np.bool_)

    def fits(off: Floats) -> bool:
        return bool(np.mean(np.sum(off[:, :3] ** 2, axis=1)) <= DISTURBED**2)

    if fits(at.off):
        return none
    at, used = robust_start(at, np.random.default_rng(SEED))
    for _ in range(ROUNDS):
        of = at.linear
        d2, _ = of.near(np.zeros(of.columns.shape[2]))
        far = d2 > limit(seen.m, len(seen), variance(of, d2, none))
        if far.mean() > MOST:
            return none
        frames = minimise(Placement(seen[~far], at.frames, at.free)).frames
        at = Placement(seen, frames, at.free)
        if np.array_equal(far, ~used):
            break
        used = ~far
    rows, base = np.flatnonzero(far), at.frames.base[:3, :3]
    axes = base @ seen.rotation[rows] @ at.frames.targets[seen.target[rows], :3, :3]
    alike = off_alike(readings, ~none, rows, at.off[rows, :3], axes)
    return far if fits(at.off[~far]) and not len(alike) else none


def _undetermined(null: Floats) -> tuple[Undetermined, ...]:
    """Return the undetermined directions, each with as few of a target's parameters as can be."""
    if not null.size:
        return ()
    # Reduced echelon form: targets' shifts first, then turns of base and targets.
    size = len(null) // 6 - 1
    shifts = [6 + 6 * k + i for k in range(size) for i in range(3)]
    rest = [3, 4, 5, *(9 + 6 * k + i for k in range(size) for i in range(3)), 0, 1, 2]
    rows, done = null.T.copy(), 0
    for block in (shifts, rest):
        while done < len(rows):
            sub = np.abs(rows[done:][:, block])
            i, j = np.unravel_index(int(np.argmax(sub)), sub.shape)
            if sub[i, j] < TOLD:
                break
            pivot = block[int(j)]
            rows[[done, done + int(i)]] = rows[[done + int(i), done]]
            rows[done] /= rows[done, pivot]
            others = np.arange(len(rows)) != done
            rows[others] -= rows[others, pivot][:, None] * rows[done]
            done += 1
    return tuple(_direction(row / np.abs(row).max()) for row in rows)


def _direction(row: Floats) -> Undetermined:
    """Return one direction, in ordinary sizes, in m and rad."""
    shifts = row * (np.abs(row) >= TOLD)
    moved = shifts * sizes(len(row) // 6 - 1)
    own = moved[6:].reshape(-1, 6)
    active = np.flatnonzero(np.abs(own).any(axis=1))
    target = int(active[0]) if len(active) else None
    mine = own[target] if target is not None else np.zeros(6)
    return Undetermined(target, mine[:3], mine[3:], moved[:3], moved[3:6])


def _refuse_lines(seen: FrameData, frames: Frames) -> None:
    """Refuse positions that do not tell how the base is turned."""
    x = seen.points(frames)
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if spread[1] < NARROW * np.sqrt(len(x)):
        raise CannotAnswerError(
            "registration: all positions lie in one point or on one line; measure poses "
            "spread in space"
        )
