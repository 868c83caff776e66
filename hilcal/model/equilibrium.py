"""Derivative of the static equilibrium: how a reading moves as the arm yields to its motion.

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
from hilcal.model.observe import ReadingDerivative
from hilcal.robot import se3
from hilcal.robot.chain import Chain
from hilcal.robot.se3 import along_states, zeros
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

    slot: int  # index of the slot of the wrench
    deviating: int  # index of the joint or slot that deviates
    joint: bool  # whether it is a joint displacement, else a twist
    components: slice  # range of the components of the wrench: of its force, or of its moment
    elements: slice  # range of the elements of the deviation
    values: Floats  # (N, I, E) or (1, I, E)


def compliance(parts: Sequence[tuple[Effect, Floats]], s: Situation) -> list[SlotResponse]:
    """Derivative of the elastic deviations by the slot wrenches, without what is zero."""
    blocks = (b for e, theta in parts if theta.any() for b in _responses_of(e, theta, s))
    nonzero = (pruned for b in blocks if (pruned := _pruned(b)) is not None)
    halves = [part for b in nonzero for part in _halves(b)]
    drive = s.cell.arm.drive
    if drive is None:
        return halves
    borne = np.where(s.cell.arm.slides, ALONG, TORQUE).tolist()
    return [c for b in halves for c in _by_chain_joints(b, drive, borne)]


def _halves(b: SlotResponse) -> Iterator[SlotResponse]:
    first, last = b.components.start, b.components.stop
    if first >= MOMENT.start or last <= FORCE.stop:
        yield b
        return
    middle = MOMENT.start - first
    yield replace(b, components=slice(first, FORCE.stop), values=b.values[:, :middle])
    yield replace(b, components=slice(MOMENT.start, last), values=b.values[:, middle:])


def _by_chain_joints(b: SlotResponse, drive: Floats, borne: list[int]) -> Iterator[SlotResponse]:
    """Compliance of the chain's joints, from that of the drives: D C Dᵀ by torques.

    Forces and moments across an axis are those of the slot itself; drives bear the components
    `borne`.
    """
    if not b.joint:
        yield b
        return
    by_torque = b.slot < len(drive) and b.components.stop == borne[b.slot] + 1
    last = b.components.stop - by_torque
    for joint in np.flatnonzero(drive[:, b.deviating]):
        block = replace(b, deviating=int(joint), values=drive[joint, b.deviating] * b.values)
        if last > b.components.start:
            across = slice(b.components.start, last)
            yield replace(block, components=across, values=block.values[:, : last - across.start])
        if by_torque:
            for slot in np.flatnonzero(drive[:, b.slot]):
                values = drive[slot, b.slot] * block.values[:, -1:]
                component = slice(borne[slot], borne[slot] + 1)
                yield replace(block, slot=int(slot), components=component, values=values)


def at_equilibrium(
    moves: ReadingDerivative, stiffness: GeometricStiffness, blocks: list[SlotResponse]
) -> ReadingDerivative:
    """Add the yielding of the arm to the motions of a reading at fixed wrenches."""
    term = wrench_form(moves, blocks)
    form, total = dict(term), _norm(term)
    previous = total
    for _ in range(MAX_TERMS):
        gradient = stiffness.gradient(term)

        def by_slot(k: int, g: MotionGradient = gradient) -> Floats:
            return moves.by_twist(k, g.displacement(k), g.turn(k))

        term = by_wrenches(blocks, gradient.joint, by_slot)
        for place, b in term.items():
            form[place] = form[place] + b
        size = _norm(term)
        # The terms shrink by one factor; the error of B is about the next term, that of A
        # smaller by that factor once more.
        if size**3 <= TOLERANCE * total * previous**2:
            break
        previous = size
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
    by_slot: Callable[[int], Floats],  # (N, m, 6) by a slot's twist
) -> dict[tuple[int, bool], Floats]:
    """Derivatives (N, m, 3) by the force (False) and moment (True) of each slot, without zeros."""
    twists = {slot: by_slot(slot) for slot in {b.deviating for b in blocks if not b.joint}}
    out: dict[tuple[int, bool], Floats] = {}
    for b in blocks:
        rows = by_joint(b.deviating)[..., None] if b.joint else twists[b.deviating][..., b.elements]
        moment = b.components.start >= MOMENT.start
        first = MOMENT.start if moment else FORCE.start
        if (b.slot, moment) not in out:
            out[b.slot, moment] = zeros(*rows.shape[:2], 3)
        part = out[b.slot, moment][..., b.components.start - first : b.components.stop - first]
        if len(b.values) > 1:
            part += np.einsum("nme,nie->nmi", rows, b.values)
            continue
        for i, element in zip(*np.nonzero(b.values[0]), strict=True):
            part[..., i] += rows[..., element] * b.values[0, i, element]
    return out


def _norm(form: Mapping[tuple[int, bool], Floats]) -> float:
    flat = (b.ravel(order="K") for b in form.values())
    return math.sqrt(sum(float(b @ b) for b in flat))


def _responses_of(effect: Effect, theta: Floats, s: Situation) -> Iterator[SlotResponse]:
    """Compliance of one effect, from its response to unit wrenches."""
    slots = range(s.wrench.shape[1])
    groups = [slots] if effect.local_response else [range(k, k + 1) for k in slots]
    for group in groups:
        units = zeros(1 if effect.local_response else len(s.wrench), 6, len(slots), 6)
        for i in range(6):
            units[:, i, group, i] = 1.0
        r = effect.response(theta, s, units)
        for k in slots:
            slot = k if effect.local_response else group[0]
            if r.twist is not None:
                yield SlotResponse(slot, k, False, slice(0, 6), slice(0, 6), r.twist[:, :, k])
            # measured torques do not change with the motion
            if r.dq is not None and not s.torque_measured and k < r.dq.shape[2]:
                yield SlotResponse(slot, k, True, slice(0, 6), slice(0, 1), r.dq[:, :, k, None])


def _pruned(b: SlotResponse) -> SlotResponse | None:
    """Return the block without components and elements that are zero in all states."""
    if not b.values.any():
        return None
    nonzero = np.any(b.values, axis=0)
    i, e = np.flatnonzero(nonzero.any(axis=1)), np.flatnonzero(nonzero.any(axis=0))
    components, elements = slice(i[0], i[-1] + 1), slice(e[0], e[-1] + 1)
    return replace(
        b, components=components, elements=elements, values=b.values[:, components, elements]
    )


class ReadingColumns:
    """The derivative (N, m, L) of a chunk of readings by L parameters, sensor axes.

    The motion of a reading by each joint, slot, frame or wrench is computed once for all effects,
    then multiplied by the derivative of that joint, slot, frame or wrench by each parameter.
    """

    def __init__(
        self,
        moves: ReadingDerivative,
        blocks: list[SlotResponse],
        load: Load,
        out: Floats,  # (N, m, L), to be written
        scale: Floats | None = None,  # (L,) units of the parameters, SI by default
    ) -> None:
        self._moves, self._blocks, self._load, self._out = moves, blocks, load, out
        self._scale = np.ones(out.shape[2]) if scale is None else scale
        self._sums = zeros(*out.shape)
        self._motions: dict[str | int, Floats] = {}

    def add(self, c: Columns, places: Ints) -> None:
        """Add columns of an effect; `places`: number of each parameter among the L, −1 for none."""
        c = c.only(places[c.parameter] >= 0)
        place = places[c.parameter]
        if c.field == "dq":
            for joint, run in c.runs():
                moved = self._moves.drives[:, :, joint, None]
                self._add(moved * along_states(c.values[:, run])[:, None], place[run])
        elif c.field == "twist":
            for slot, run in c.runs():
                moved = self._motion(slot, partial(self._moves.by_slot, slot))
                self._add(_times(moved, c.values[:, run]), place[run])
        else:
            moved = self._motion(c.field, getattr(self._moves, f"by_{c.field}"))
            values = c.values[..., None] if c.field == "scale" else c.values
            self._add(_times(moved, values), place)

    def add_wrench_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, n + 1, 6) of the slot wrenches by the P parameters of an effect."""
        used = place >= 0
        for (slot, moment), rows in self._form.items():
            half = change[:, used, slot, MOMENT if moment else FORCE]
            self._add(rows_times(rows, half, transposed=True), place[used])

    def add_load_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, 6) of the load's wrench at the load point, base axes."""
        used = place >= 0
        moved = by_load(self._form, self._moves.chain, self._load, self._moves.m)
        self._add(rows_times(moved, change[:, used], transposed=True), place[used])

    def write(self) -> None:
        """Write the derivative by all that was added."""
        np.multiply(self._sums, self._scale, out=self._out)

    @cached_property
    def _form(self) -> dict[tuple[int, bool], Floats]:
        return wrench_form(self._moves, self._blocks)

    def _motion(self, key: str | int, find: Callable[[], Floats]) -> Floats:
        if key not in self._motions:
            self._motions[key] = find()
        return self._motions[key]

    def _add(self, block: Floats, places: Ints) -> None:
        """Add columns (N, m, P) at their places (P,), which may be the same."""
        for k, place in enumerate(places.tolist()):
            self._sums[:, :, place] += block[:, :, k]


def _times(moved: Floats, values: Floats) -> Floats:
    """Motion (N, m, P) by P changes (N or 1, P, E), from the motion (N, m, E) per element."""
    if len(values) == 1:
        return rows_times_constant(moved, values[0].T)
    used = np.flatnonzero(values.any(axis=(0, 1)))
    part = slice(used[0], used[-1] + 1) if len(used) else slice(0, 1)
    return rows_times(moved[..., part], along_states(values[..., part]), transposed=True)
