"""The derivative of readings by the parameters of several effects at once.

What moves a reading, that is joints, slots, frames and wrenches, moves it by every effect that acts
there. Its motion is computed once, then multiplied by each parameter's share of it.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from hilcal.effects.protocol import Columns
from hilcal.model.equilibrium import SlotResponse, by_load, by_wrench_changes, wrench_form
from hilcal.model.observe import ReadingDerivative
from hilcal.robot.batch import along_states, empty
from hilcal.robot.geometric_stiffness import rows_times, rows_times_constant
from hilcal.robot.statics import Load
from hilcal.types import Floats, Ints

WIDE = 64  # Successive parameters of one joint that are written as they are; a choice by timing


class ReadingColumns:
    """The derivative (N, m, L) of a chunk of readings by L parameters, sensor axes.

    Columns are computed along the states, and turned over in memory together; many successive ones
    of one joint are written where they belong at once.
    """

    def __init__(
        self,
        moves: ReadingDerivative,
        blocks: list[SlotResponse],
        load: Load,
        scale: Floats | None = None,  # (L,) units of the parameters; SI unless given
    ) -> None:
        """Begin without any."""
        self._moves, self._blocks, self._load, self._scale = moves, blocks, load, scale
        self._columns: list[tuple[Columns, Ints]] = []
        self._wrenches: list[tuple[Floats, Ints]] = []
        self._loads: list[tuple[Floats, Ints]] = []

    def add(self, c: Columns, place: Ints) -> None:
        """Add one block of an effect's columns.

        place: which of the L each parameter of the effect is; −1 for none.
        """
        c = c.only(place[c.parameter] >= 0)
        at = place[c.parameter]
        self._columns.append((c if self._scale is None else _scaled(c, self._scale[at]), at))

    def add_wrench_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, n + 1, 6) of the slot wrenches by the P parameters of an effect."""
        wanted = place >= 0
        self._wrenches.append((change if wanted.all() else change[:, wanted], place[wanted]))

    def add_load_changes(self, change: Floats, place: Ints) -> None:
        """Add changes (N, P, 6) of the load's wrench at the load point, base axes."""
        wanted = place >= 0
        self._loads.append((change if wanted.all() else change[:, wanted], place[wanted]))

    def write(self, out: Floats) -> None:
        """Write the derivative (N, m, L) by all that was added; zero where nothing was."""
        places = [at for _, at in (*self._columns, *self._wrenches, *self._loads)]
        uses = np.bincount(np.concatenate([np.zeros(0, int), *places]), minlength=out.shape[2])
        sums = _Sums(out, uses)
        fields: dict[str, list[tuple[Columns, list[int]]]] = {}
        for c, at in self._columns:
            fields.setdefault(c.field, []).append((c, at.tolist()))
        if "dq" in fields:
            self._by_joints(fields.pop("dq"), sums)
        self._by_slots(fields.pop("twist", []), sums)
        for field, some in fields.items():
            self._by_side(field, some, sums)
        self._by_wrenches(sums)
        sums.write()

    def _by_joints(self, some: list[tuple[Columns, list[int]]], sums: "_Sums") -> None:
        """Add displacements of joints."""
        drives = self._moves.drives
        for c, to in some:
            element = c.element.tolist()
            for mine in _pieces(element, to):
                joints = slice(element[mine.start], element[mine.stop - 1] + 1)
                place = slice(to[mine.start], to[mine.stop - 1] + 1)
                sums.add_products(drives[:, :, joints], c.values[:, mine], place)

    def _by_slots(self, some: list[tuple[Columns, list[int]]], sums: "_Sums") -> None:
        """Add twists of slots, each slot's motion computed once."""
        used: dict[int, slice] = {}
        ranges = [_range(c.values) for c, _ in some]
        for (c, _), mine in zip(some, ranges, strict=True):
            for slot in set(c.element.tolist()):
                known = used.get(slot, mine)
                used[slot] = slice(min(known.start, mine.start), max(known.stop, mine.stop))
        moves = {slot: self._moves.by_slot(slot, elements) for slot, elements in used.items()}
        for (c, to), elements in zip(some, ranges, strict=True):
            for slot, mine in c.runs():
                shift = used[slot].start
                moved = moves[slot][:, :, elements.start - shift : elements.stop - shift]
                sums.add(_times(moved, c.values[:, mine, elements]), to[mine])

    def _by_side(self, field: str, some: list[tuple[Columns, list[int]]], sums: "_Sums") -> None:
        """Add what moves base, station or target, or scales the positions."""
        moves = self._moves
        if field == "scale":
            moved = moves.by_scale()
            for c, to in some:
                sums.add(moved * along_states(c.values)[:, None], to)
            return
        sides = {
            "base": moves.by_base,
            "station": moves.by_station,
            "target": moves.by_target,
            "observer": moves.by_observer,
        }
        moved = sides[field]()
        for c, to in some:
            sums.add(_times(moved, c.values), to)

    def _by_wrenches(self, sums: "_Sums") -> None:
        """Add changes of the slot wrenches, and of the load's."""
        moves = self._moves
        if not self._wrenches and not self._loads:
            return
        form = wrench_form(moves, self._blocks)
        found = [(by_wrench_changes(form, change, moves.m), at) for change, at in self._wrenches]
        if self._loads:
            moved = by_load(form, moves.chain, self._load, moves.m)
            found += [(rows_times(moved, by, transposed=True), at) for by, at in self._loads]
        for block, at in found:
            sums.add(block if self._scale is None else block * self._scale[at], at.tolist())


class _Sums:
    """Sums of columns along the states, and where they are to be written."""

    def __init__(self, out: Floats, uses: Ints) -> None:
        """Begin with nothing; `uses` (L,): how often each column will be added to."""
        self._out, self._along = out, empty(*out.shape)
        self._alone = uses == 1
        self._first = uses > 0  # whether nothing was added yet
        self._summed = np.ones(len(uses), dtype=np.bool_)  # else written where it belongs
        self._along[:, :, uses == 0] = 0.0

    def add(self, block: Floats, to: list[int]) -> None:
        """Add columns (N, m, P) at their places."""
        successive = bool(to) and to == list(range(to[0], to[0] + len(to)))
        place = slice(to[0], to[-1] + 1) if successive else slice(0, 0)
        if successive and self._first[place].all():
            self._along[:, :, place] = block
            self._first[place] = False
            return
        for column, at in enumerate(to):
            if self._first[at]:
                self._along[:, :, at] = block[:, :, column]
                self._first[at] = False
            else:
                self._along[:, :, at] += block[:, :, column]

    def add_products(self, moved: Floats, values: Floats, place: slice) -> None:
        """Add motions (N, m, P or 1) times values (N or 1, P) at successive places."""
        first = self._first[place]
        if moved.shape[2] == 1 and len(first) >= WIDE and self._alone[place].all():
            np.multiply(moved, values[:, None], out=self._out[:, :, place])
            self._summed[place] = False
            return
        by = along_states(values)[:, None]
        if first.all():
            np.multiply(moved, by, out=self._along[:, :, place])
            first[:] = False
            return
        self.add(moved * by, list(range(place.start, place.stop)))

    def write(self) -> None:
        """Write the sums; zero where nothing was added."""
        ends = np.flatnonzero(np.diff(np.concatenate([[False], self._summed, [False]])))
        for start, stop in ends.reshape(-1, 2).tolist():
            self._out[:, :, start:stop] = self._along[:, :, start:stop]


def _scaled(c: Columns, by: Floats) -> Columns:
    """Columns times a factor (P,) each."""
    return replace(c, values=c.values * (by if c.values.ndim == 2 else by[:, None]))


def _pieces(element: list[int], to: list[int]) -> Iterator[slice]:
    """Yield columns with successive places, all of one joint or each of the next joint."""
    start, count = 0, len(to)
    while start < count:
        stop = start + 1
        step = element[stop] - element[start] if stop < count else 0
        if step in (0, 1):
            while stop < count and (to[stop], element[stop]) == (
                to[stop - 1] + 1,
                element[stop - 1] + step,
            ):
                stop += 1
        yield slice(start, stop)
        start = stop


def _range(values: Floats) -> slice:
    """Range of the elements of a twist that values (N, P, 6) have; one where they are all zero."""
    used = np.flatnonzero(values.any(axis=(0, 1)))
    return slice(int(used[0]), int(used[-1]) + 1) if len(used) else slice(5, 6)


def _times(moved: Floats, values: Floats) -> Floats:
    """Motion (N, m, P) by P changes (N or 1, P, E), from the motion (N, m, E) per element."""
    if len(values) == 1:
        return rows_times_constant(moved, values[0].T)
    return rows_times(moved, along_states(values), transposed=True)
