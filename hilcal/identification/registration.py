"""The tracker's registration and the target's offset, before anything else is fitted.

Positions and attitudes register together, by whitened least squares over the frames of the nominal
arm from several starts (`rigid_frames`, `registration_starts`). What the poses cannot tell stays
near the cell's target and is listed.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError
from hilcal.identification.registration_starts import closed_forms, rotated
from hilcal.identification.rigid_frames import (
    Frames,
    Free,
    Minimum,
    Seen,
    inverse_roots,
    minimise,
    misfit,
    settled,
    sizes,
)
from hilcal.identification.robust_frames import far_readings
from hilcal.readings.readings import Readings
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Bools, Floats

MIN_POSES = 4
NARROW = 1e-3
"""Rms distance from a line, m, below which positions are collinear; a choice."""
FEW = 100
"""Readings that the starts are tried on, spread over all; a choice: 17 times the unknowns."""
GOOD = 10.0
"""Rms misfit, in units of noise with roughness, that a closed form must reach for no other start to
be tried: about 1 mm and 1 mrad. A choice: arms are so accurate before calibration."""
TRIED = 5
"""Starts, the best of all by their misfit, that least squares goes on from; a choice."""
DISTURBED = 3e-3
"""Rms misfit, m, from which on readings that are far off are looked for: nominal arms are off by
less. A choice, a third of the gate's least (`gate.GATE_M`)."""
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
    """

    target: int | None
    target_shift: Floats
    target_turn: Floats
    base_shift: Floats
    base_turn: Floats


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


def register(cell: Cell, readings: Readings) -> Registration:
    """Estimate the registration and the target's offset where they are unknown.

    Raises:
        CannotAnswerError: where the poses do not determine it (fewer than four distinct positions,
            or all on one line).
    """
    angle = angles(readings)
    chain = chains.evaluate(cell.arm, angle)
    seen = seen_of(readings, chain.rotation[-1], chain.position[-1])
    known = np.array(cell.known_targets)
    given = Frames(cell.registration, cell.all_targets)
    if cell.registration_known and cell.target_known:
        none = Free.of(False, ~known, False)
        far = far_readings(readings, seen, given, none, DISTURBED)
        return _result(cell, misfit(seen, given), angle, (), far, estimated=False)
    distinct = len(np.unique(np.round(angle, 9), axis=0))
    if distinct < MIN_POSES:
        raise CannotAnswerError(
            f"registration: {distinct} distinct poses; measure at least {MIN_POSES}, better 10, "
            "that turn the flange and do not lie on a line"
        )
    free = Free.of(not cell.registration_known, ~known, seen.m == 6)
    found = fit_frames(seen, given, free)
    far = far_readings(readings, seen, found.frames, free, DISTURBED)
    if far.any():
        good = fit_frames(seen[~far], given, free)
        found = replace(good, off=misfit(seen, good.frames))
    if seen.m == 3 and not cell.registration_known:
        _refuse_lines(seen, found.frames)
    placed = replace(cell.with_targets(found.frames.targets), registration=found.frames.base)
    return _result(placed, found.off, angle, undetermined(found), far, estimated=True)


def angles(readings: Readings) -> Floats:
    """(N, n) joint values of the readings: as the encoders reported them, else as commanded."""
    states = readings.states
    return states.q if states.q_actual is None else states.q_actual


def seen_of(readings: Readings, rotation: Floats, position: Floats) -> Seen:
    """Return what the frames are found from.

    Args:
        readings: N readings.
        rotation: (N, 3, 3) nominal orientation of the flange.
        position: (N, 3) nominal position of the flange, m.
    """
    return Seen(
        np.ascontiguousarray(rotation),
        np.ascontiguousarray(position),
        readings.value[:, :3],
        se3.rotation(readings.value[:, 3:]) if readings.m == 6 else None,
        inverse_roots(readings.covariance),
        readings.target,
    )


def fit_frames(seen: Seen, given: Frames, free: Free) -> Minimum:
    """Return the best frames from several starts, on a part of the readings, then on all.

    The rotations of a cube are tried only where no closed form leads to a good fit.
    """
    part = seen[np.unique(np.linspace(0, len(seen) - 1, FEW).astype(int))]

    def reached(begun: Iterable[Frames]) -> list[Minimum]:
        return [minimise(part, begin, free, steps=15) for begin in begun]

    def square(frames: Frames) -> float:
        return float(np.sum(np.einsum("nij,nj->ni", part.root, misfit(part, frames)) ** 2))

    found = reached(closed_forms(part, given, free))
    if min(m.square for m in found) > GOOD**2 * part.m * len(part):
        found += reached(sorted(rotated(part, given, free), key=square)[:TRIED])
    best = min(found, key=lambda m: m.square)
    return settled(seen, minimise(seen, best.frames, free), free, given)


def undetermined(found: Minimum) -> tuple[Undetermined, ...]:
    """Return the undetermined directions, each with as few of a target's parameters as can be."""
    null = found.null.copy()
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


def _result(
    cell: Cell,
    off: Floats,
    angle: Floats,
    unknown: tuple[Undetermined, ...],
    far: Bools,
    *,
    estimated: bool,
) -> Registration:
    return Registration(
        cell=cell,
        off=off,
        rms=float(np.sqrt(np.mean(np.sum(off[~far, :3] ** 2, axis=1)))),
        turn_rms=float(np.sqrt(np.mean(np.sum(off[~far, 3:] ** 2, axis=1))))
        if off.shape[1] == 6
        else None,
        far=far,
        undetermined=unknown,
        still=np.ptp(angle, axis=0) < TURNED,
        estimated=estimated,
    )


def _refuse_lines(seen: Seen, frames: Frames) -> None:
    """Refuse positions that do not tell how the base is turned."""
    offset = frames.targets[seen.target, :3, 3]
    x = seen.position + np.einsum("nij,nj->ni", seen.rotation, offset)
    spread = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)
    if spread[1] < NARROW * np.sqrt(len(x)):
        raise CannotAnswerError(
            "registration: all positions lie in one point or on one line; measure poses "
            "spread in space"
        )
