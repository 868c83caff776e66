"""The static equilibrium differentiated: how a reading moves where the arm yields to its motion.

The elastic deviation f depends on the slot wrenches W, these on the deviated chain, and the chain
on the deviation D: D = f(θ, W(D)). With the reading y(D), the derivatives C = ∂f/∂W (compliance)
and K = ∂W/∂D (geometric stiffness),

    dy/dθ = A ∂f/∂θ + B ∂W/∂θ,     A = ∂y/∂D + B K,     B = A C = Σ_i ∂y/∂D C (K C)^i

The factor K C is about deflection/reach, so that few terms of the series are needed. B has as many
rows as the reading, however many parameters there are.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Situation
from hilcal.model.observe import ReadingDerivative, SlotFrames
from hilcal.robot import se3
from hilcal.robot.batch import along_states, zeros
from hilcal.robot.chain import Chain
from hilcal.robot.statics import (
    GeometricStiffness,
    Load,
    MotionGradient,
    rows_times,
    rows_times_constant,
)
from hilcal.types import Floats, Ints

TOLERANCE = 1e-8  # part of the derivative (rms) that may be missing; a choice
MAX_TERMS = 40
TORQUE, ALONG = 5, 2  # Components of a slot's wrench about the axis of its joint, and along it
FORCE, MOMENT = slice(0, 3), slice(3, 6)  # Components of a slot's wrench


@dataclass(frozen=True, slots=True, eq=False)
class SlotResponse:
    """Derivative of the deviation at one slot by the wrench through one slot."""

    slot: int  # whose wrench
    to: int  # which joint (index) or slot deviates
    joint: bool  # whether it is a joint displacement, else a twist
    components: slice  # range of the components of the wrench: of its force, or of its moment
    elements: slice  # range of the elements of the deviation
    values: Floats  # (N, I, E) or (1, I, E)


def compliance(parts: Sequence[tuple[Effect, Floats]], s: Situation) -> list[SlotResponse]:
    """Derivative of the elastic deviations by the slot wrenches, without what is zero."""
    blocks = (b for e, theta in parts if theta.any() for b in _of_effect(e, theta, s))
    whole = (pruned for b in blocks if (pruned := _pruned(b)) is not None)
    found = [part for b in whole for part in _halves(b)]
    drive = s.cell.arm.drive
    if drive is None:
        return found
    borne = np.where(s.cell.arm.slides, ALONG, TORQUE).tolist()
    return [c for b in found for c in _of_joints(b, drive, borne)]


def _halves(b: SlotResponse) -> Iterator[SlotResponse]:
    first, last = b.components.start, b.components.stop
    if first >= MOMENT.start or last <= FORCE.stop:
        yield b
        return
    middle = MOMENT.start - first
    yield replace(b, components=slice(first, FORCE.stop), values=b.values[:, :middle])
    yield replace(b, components=slice(MOMENT.start, last), values=b.values[:, middle:])


def _of_joints(b: SlotResponse, drive: Floats, borne: list[int]) -> Iterator[SlotResponse]:
    """Compliance of the chain's joints, from that of the drives: D C Dᵀ by torques.

    Forces and moments across an axis are those of the slot itself; drives bear the components
    `borne`.
    """
    if not b.joint:
        yield b
        return
    by_torque = b.slot < len(drive) and b.components.stop == borne[b.slot] + 1
    last = b.components.stop - by_torque
    for to in np.flatnonzero(drive[:, b.to]):
        moved = replace(b, to=int(to), values=drive[to, b.to] * b.values)
        if last > b.components.start:
            rest = slice(b.components.start, last)
            yield replace(moved, components=rest, values=moved.values[:, : last - rest.start])
        if by_torque:
            for slot in np.flatnonzero(drive[:, b.slot]):
                values = drive[slot, b.slot] * moved.values[:, -1:]
                at = slice(borne[slot], borne[slot] + 1)
                yield replace(moved, slot=int(slot), components=at, values=values)


def at_equilibrium(
    moves: ReadingDerivative, stiffness: GeometricStiffness, blocks: list[SlotResponse]
) -> ReadingDerivative:
    """Add to the motions of a reading, wrenches held, how the arm yields to their change."""
    term = wrench_form(moves, blocks)
    form, whole = dict(term), _norm(term)
    before = whole
    for _ in range(MAX_TERMS):
        gradient = stiffness.gradient(term)
        term = by_wrenches(blocks, gradient.joint, partial(_by_twist, gradient, moves.frames))
        for place, b in term.items():
            form[place] = form[place] + b
        now = _norm(term)
        # The terms shrink by one factor; what is missing of B is about the next one, and of A
        # smaller by that factor once more.
        if now**3 <= TOLERANCE * whole * before**2:
            break
        before = now
    yielding = stiffness.gradient(form)
    dq = moves.dq.copy(order="F")
    for j in range(dq.shape[2]):
        dq[:, :, j] += yielding.joint(j)
    return replace(moves, dq=dq, yielding=yielding)


def wrench_form(
    moves: ReadingDerivative, blocks: list[SlotResponse]
) -> dict[tuple[int, bool], Floats]:
    """Derivatives (N, m, 3) of a reading by the force (False) and moment (True) of each slot."""
    return by_wrenches(blocks, lambda j: moves.dq[:, :, j], moves.by_slot)


def by_wrench_changes(form: Mapping[tuple[int, bool], Floats], change: Floats, m: int) -> Floats:
    """Motion (N, m, P) of a reading by changes (N, P, n + 1, 6) of the wrenches; `wrench_form`."""
    out = zeros(len(change), m, change.shape[1])
    for (slot, moment), rows in form.items():
        half = change[:, :, slot, MOMENT if moment else FORCE]
        out += rows_times(rows, half, transposed=True)
    return out


def by_load(form: Mapping[tuple[int, bool], Floats], chain: Chain, load: Load, m: int) -> Floats:
    """Derivative (N, m, 6) of a reading by the load's wrench at the load point, base axes.

    A force f and a moment t there are R_kᵀ f and R_kᵀ (t + d_k × f) in slot k, d_k the lever.
    """
    point = chain.point(load.point)
    out = zeros(len(point), m, 6)
    for (slot, moment), rows in form.items():
        turned = rows_times(rows, chain.rotation[slot], transposed=True)
        if moment:
            out[..., MOMENT] += turned
            turned = se3.cross(turned, (point - chain.position[slot])[:, None])
        out[..., FORCE] += turned
    return out


def by_wrenches(
    blocks: list[SlotResponse],
    by_joint: Callable[[int], Floats],  # (N, m) by the displacement of a joint
    by_slot: Callable[[int, slice], Floats],  # (N, m, E) by elements of a slot's twist
) -> dict[tuple[int, bool], Floats]:
    """Derivatives (N, m, 3) by the force (False) and moment (True) of each slot, without zeros."""
    used: dict[int, slice] = {}
    for b in blocks:
        if not b.joint:
            old = used.get(b.to, b.elements)
            start, stop = min(old.start, b.elements.start), max(old.stop, b.elements.stop)
            used[b.to] = slice(start, stop)
    twists = {to: by_slot(to, elements) for to, elements in used.items()}
    out: dict[tuple[int, bool], Floats] = {}
    for b in blocks:
        if b.joint:
            found = by_joint(b.to)[..., None]
        else:
            e = used[b.to].start
            found = twists[b.to][..., b.elements.start - e : b.elements.stop - e]
        moment = b.components.start >= MOMENT.start
        first = MOMENT.start if moment else FORCE.start
        if (b.slot, moment) not in out:
            out[b.slot, moment] = zeros(*found.shape[:2], 3)
        to = out[b.slot, moment][..., b.components.start - first : b.components.stop - first]
        if len(b.values) > 1:
            to += np.einsum("nme,nie->nmi", found, b.values)
            continue
        for i, element in zip(*np.nonzero(b.values[0]), strict=True):
            to[..., i] += found[..., element] * b.values[0, i, element]
    return out


def _by_twist(gradient: MotionGradient, frames: SlotFrames, slot: int, elements: slice) -> Floats:
    """Derivative (N, m, E) by elements of the twist of a slot, from that by its motion."""
    v = gradient.displacement(slot) if frames.need_displacement(slot, elements) else None
    return frames.by_twist(slot, v, gradient.turn(slot), elements)


def _norm(form: Mapping[tuple[int, bool], Floats]) -> float:
    flat = (b.ravel(order="K") for b in form.values())
    return math.sqrt(sum(float(b @ b) for b in flat))


def _of_effect(effect: Effect, theta: Floats, s: Situation) -> Iterator[SlotResponse]:
    """Compliance of one effect, from its response to unit wrenches."""
    slots = s.wrench.shape[1]
    every = range(slots)
    groups = [every] if effect.local_response else [range(k, k + 1) for k in every]
    for group in groups:
        units = zeros(1 if effect.local_response else len(s.wrench), 6, slots, 6)
        for i in range(6):
            units[:, i, group, i] = 1.0
        r = effect.response(theta, s, units)
        for to in every:
            slot = to if effect.local_response else group[0]
            if r.twist is not None:
                yield SlotResponse(slot, to, False, slice(0, 6), slice(0, 6), r.twist[:, :, to])
            follows = r.dq is not None and not s.torque_measured  # measured torques stay
            if r.dq is not None and follows and to < r.dq.shape[2]:
                yield SlotResponse(slot, to, True, slice(0, 6), slice(0, 1), r.dq[:, :, to, None])


def _pruned(b: SlotResponse) -> SlotResponse | None:
    """Return the block without components and elements that are zero in all states."""
    if not b.values.any():
        return None
    there = np.any(b.values, axis=0)
    i, e = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    components, elements = slice(i[0], i[-1] + 1), slice(e[0], e[-1] + 1)
    return replace(
        b, components=components, elements=elements, values=b.values[:, components, elements]
    )


WIDE = 64  # Successive parameters of one joint that are written as they are; a choice by timing


class ReadingColumns:
    """The derivative (N, m, L) of a chunk of readings by L parameters, sensor axes.

    What moves a reading, that is joints, slots, frames and wrenches, moves it by every effect that
    acts there: its motion is computed once, then multiplied by each parameter's share of it.
    """

    def __init__(
        self,
        moves: ReadingDerivative,
        blocks: list[SlotResponse],
        load: Load,
        out: Floats,  # (N, m, L), to be written
        scale: Floats | None = None,  # (L,) units of the parameters, SI by default
    ) -> None:
        """Begin with zeros."""
        self._moves, self._blocks, self._load, self._out = moves, blocks, load, out
        self._scale = np.ones(out.shape[2]) if scale is None else scale
        self._sums = zeros(*out.shape)
        # which columns were added to, and which of them are written already
        self._used, self._written = np.zeros((2, out.shape[2]), dtype=np.bool_)
        self._known: dict[str | int, Floats] = {}

    def add(self, c: Columns, place: Ints) -> None:
        """Add columns of an effect; `place`: which of the L each parameter is, −1 for none."""
        c = c.only(place[c.parameter] >= 0)
        at = place[c.parameter]
        if c.field == "dq":
            for joint, mine in c.runs():
                self._add_joint(self._moves.drives[:, :, joint, None], c.values[:, mine], at[mine])
        elif c.field == "twist":
            for slot, mine in c.runs():
                moved = self._motion(slot, partial(self._moves.by_slot, slot))
                self._add(_times(moved, c.values[:, mine]), at[mine])
        else:
            moved = self._motion(c.field, getattr(self._moves, f"by_{c.field}"))
            values = c.values[..., None] if c.field == "scale" else c.values
            self._add(_times(moved, values), at)

    def add_wrench_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, n + 1, 6) of the slot wrenches by the P parameters of an effect."""
        wanted = place >= 0
        self._add(by_wrench_changes(self._form, change[:, wanted], self._moves.m), place[wanted])

    def add_load_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, 6) of the load's wrench at the load point, base axes."""
        wanted = place >= 0
        moved = by_load(self._form, self._moves.chain, self._load, self._moves.m)
        self._add(rows_times(moved, change[:, wanted], transposed=True), place[wanted])

    def write(self) -> None:
        """Write the derivative by all that was added."""
        ends = np.flatnonzero(np.diff(np.concatenate([[True], self._written, [True]])))
        for start, stop in ends.reshape(-1, 2).tolist():
            part = (slice(None), slice(None), slice(start, stop))
            np.multiply(self._sums[part], self._scale[start:stop], out=self._out[part])

    @cached_property
    def _form(self) -> dict[tuple[int, bool], Floats]:
        return wrench_form(self._moves, self._blocks)

    def _motion(self, key: str | int, find: Callable[[], Floats]) -> Floats:
        if key not in self._known:
            self._known[key] = find()
        return self._known[key]

    def _add_joint(self, moved: Floats, values: Floats, at: Ints) -> None:
        """Add the motion (N, m, 1) by a joint, times (N or 1, P); many go where they belong."""
        place = slice(int(at[0]), int(at[0]) + len(at))
        if len(at) >= WIDE and np.all(np.diff(at) == 1) and not self._used[place].any():
            np.multiply(moved, (values * self._scale[place])[:, None], out=self._out[:, :, place])
            self._used[place] = self._written[place] = True
        else:
            self._add(moved * along_states(values)[:, None], at)

    def _add(self, block: Floats, at: Ints) -> None:
        """Add columns (N, m, P) at their places (P,), which may be the same."""
        self._used[at] = True
        for k, column in enumerate(at.tolist()):
            if self._written[column]:
                self._out[:, :, column] += self._scale[column] * block[:, :, k]
            else:
                self._sums[:, :, column] += block[:, :, k]


def _times(moved: Floats, values: Floats) -> Floats:
    """Motion (N, m, P) by P changes (N or 1, P, E), from the motion (N, m, E) per element."""
    if len(values) == 1:
        return rows_times_constant(moved, values[0].T)
    used = np.flatnonzero(values.any(axis=(0, 1)))
    part = slice(used[0], used[-1] + 1) if len(used) else slice(0, 1)
    return rows_times(moved[..., part], along_states(values[..., part]), transposed=True)
