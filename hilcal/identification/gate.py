"""Whether the readings fit the description of the arm at all, and what is wrong where they do not.

After registration the nominal arm misses readings by its geometric errors, some mm at most. What
is far more is no effect but a wrong description. Single changes of it are tried on some of the
readings, then the best of them in combination (beam search), until one explains the readings.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.description import Change, Described, Kind, changes, pairs
from hilcal.identification.registration import Registration, angles
from hilcal.identification.registration_starts import closed_forms, rotated
from hilcal.identification.rigid_frames import (
    Frames,
    Free,
    Minimum,
    Seen,
    derivative,
    minimise,
    misfit,
)
from hilcal.readings.readings import Readings
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

GATE_M = 0.010
GATE_REACH = 0.01
"""The gate: rms misfit in m, and as a share of the reach, whichever is more. Arms before
calibration are 0.1 to 3 mm off, old or large ones up to 1 % of their reach."""
LOOK = 0.3
"""Share of the gate above which single changes are tried: a wrong description may hide behind the
frames, or concern a joint that hardly turns. A choice."""
GATE_EXTENT = 0.03
"""Share of the extent of the positions that counts as a misfit where they lie close together; a
choice: a joint that counts wrongly moves a target as far as the poses do."""
LEVER = 0.3
"""Lever by which attitude errors count as position errors, m: an ordinary tool; a choice."""
ROWS = 40
"""Readings that changes are tried on, spread over all; a choice: seven times the unknowns."""
DEPTH = 3
"""Most changes in combination; a choice."""
BEAM = (6, 3)
"""Best ones that a second and a third change is tried on; a choice."""
FACTOR = 4.0
"""How many times smaller a change must make the misfit; a choice."""
CAREFUL = 10
"""Best ones by a rough search that are searched with care; a choice."""
ALIKE = 2.0
"""Changes that leave less than so many times the least misfit do equally well; a choice."""
WRONG_ROWS = 0.2
"""Largest share of rows that may be wrong by themselves; a choice."""
FIRST: tuple[Kind, ...] = ("shift", "columns")
"""Changes that others are combined with where they help by themselves, for speed."""
OFF_DEG = 0.2
"""Zero of a single joint, degrees, from which on it is worth a word; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Changes of the description that explain the readings.

    Attributes:
        changes: what is otherwise.
        rms: misfit with them, m; attitudes count with `LEVER`.
    """

    changes: tuple[Change, ...]
    rms: float


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """What is wrong with the description.

    Attributes:
        rms: misfit as described, m; attitudes count with `LEVER`.
        gate: misfit above which nothing is fitted, m.
        explanations: what explains the readings, best first; several do equally well.
        rows: (N,) readings that do not fit, while most do.
        swapped: pairs of them that fit each other's place.
        tried: number of descriptions that were tried.
    """

    rms: float
    gate: float
    explanations: tuple[Explanation, ...]
    rows: Bools
    swapped: tuple[tuple[int, int], ...]
    tried: int

    @property
    def refused(self) -> bool:
        """Whether nothing should be fitted to these readings as described.

        Below the gate the zero of a joint is something that effects can estimate.
        """
        zeros = all(e.changes[0].is_zero and len(e.changes) == 1 for e in self.explanations)
        return self.rms > self.gate or not zeros


def gate_of(reach: float) -> float:
    """Rms misfit above which nothing is fitted, m."""
    return max(GATE_M, GATE_REACH * reach)


def examine(registered: Registration, readings: Readings) -> Finding | None:
    """Return what is wrong with the description; None where the readings fit it.

    Args:
        registered: the registration of the nominal arm.
        readings: the readings.
    """
    cell, gate = registered.cell, gate_of(registered.cell.arm.reach)
    # A base that is told shows the whole geometric error, however close the positions lie.
    extent = np.inf if cell.registration_known else _extent(readings.value[:, :3])
    noise = float(np.sqrt(np.mean(np.trace(readings.covariance[:, :3, :3], axis1=1, axis2=2))))
    far, rms = registered.far, _size(registered.off)
    if far.any():
        others = _size(registered.off[~far])
        search = _Search(cell, readings, max(3.0 * noise, others))
        shifted = search.shifted()
        if shifted:
            return Finding(rms, gate, shifted, np.zeros_like(far), (), search.tried)
        swapped = search.swapped(search.robust(()), np.flatnonzero(far))
        return Finding(rms if swapped else others, gate, (), far, swapped, 1)
    if rms <= min(LOOK * gate, max(GATE_EXTENT * extent, 5.0 * noise)):
        return None
    close = max(0.02 * min(extent, cell.arm.reach), rms / 50.0)
    search = _Search(cell, readings, max(3.0 * noise, min(0.25 * gate, close)))
    whole = search.robust(())
    bad = whole.far
    if bad.any() and (shifted := search.shifted()):
        return Finding(rms, gate, shifted, np.zeros_like(bad), (), search.tried)
    if bad.any() and bad.mean() <= WRONG_ROWS and whole.rms <= search.enough:
        return Finding(rms, gate, (), bad, search.swapped(whole, np.flatnonzero(bad)), 1)
    found = search.explain(gate, DEPTH if rms > gate else 1)
    if not found and rms <= gate:
        return None
    if not found and search.within(gate, whole):
        return Finding(rms, gate, (), bad, (), search.tried)
    nothing = np.zeros(len(readings), dtype=bool)
    rows = search.robust(found[0].changes).far if found else nothing
    return Finding(
        rms, gate, found, rows if rows.mean() <= WRONG_ROWS else nothing, (), search.tried
    )


def _size(off: Floats) -> float:
    """Rms of misfits (N, m), attitudes with `LEVER`, m."""
    weight = np.repeat([1.0, LEVER], 3)[: off.shape[1]]
    return float(np.sqrt(np.mean(np.sum((off * weight) ** 2, axis=1))))


@dataclass(frozen=True, slots=True, eq=False)
class _Robust:
    """A registration by most of the rows.

    Attributes:
        rms: of the rows that fit, m.
        far: (N,) those that do not.
        seen: what it was made from.
        at: the frames.
    """

    rms: float
    far: Bools
    seen: Seen
    at: Minimum


class _Search:
    """Descriptions that are tried on the same readings."""

    def __init__(self, cell: Cell, readings: Readings, enough: float) -> None:
        self._cell, self._readings = cell, readings
        self.enough, self.tried = enough, 0
        turn = readings.value[:, 3:] if readings.m == 6 else None
        self._whole = Described(
            cell.arm,
            angles(readings),
            readings.value[:, :3],
            turn,
            not cell.registration_known,
            not all(cell.known_targets),
        )
        self._few = np.unique(np.linspace(0, len(readings) - 1, ROWS).astype(int))
        flange = chains.evaluate(cell.arm, self._whole.q).position[-1]
        self._extent = min(_extent(readings.value[:, :3]), _extent(flange))
        self.score = lru_cache(maxsize=None)(self._score)

    def explain(self, gate: float, most: int) -> tuple[Explanation, ...]:
        """Return the shortest combination of changes that explains the readings, and its likes."""
        base = self.score(())
        singles = tuple(changes(self._whole))
        beam: list[tuple[Change, ...]] = [()]
        tried: dict[tuple[Change, ...], float] = {}
        for depth in range(most):
            others = [c for c in singles if depth == 0 or c.kind not in FIRST]
            ways = [(*begun, c) for begun in beam for c in others if not _excluded(c, begun)]
            if depth == 1:
                ways += pairs(self._cell.arm.n)
            rough = {w: self.score(w, True) for w in {tuple(sorted(w, key=_order)) for w in ways}}
            best = sorted(rough, key=lambda w: (rough[w], _cost(w)))[:CAREFUL]
            now = {**rough, **{w: self.score(w) for w in best}}
            if depth < 2 and min(now.values()) > self.enough:
                now.update(self._zeros(beam[:2]))
            tried.update(now)
            found = self._enough(now, base)
            if found:
                return found
            beam = sorted(now, key=lambda w: (now[w], _cost(w)))[: BEAM[min(depth, 1)]]
        way = min(tried, key=lambda w: tried[w])
        good = tried[way] <= min(gate, base / FACTOR)
        return (Explanation(way, tried[way]),) if good else ()

    def shifted(self) -> tuple[Explanation, ...]:
        """Return the shift of rows that explains the readings, where one does.

        Where a pose has many readings, only its last one is wrong, and looks like a gross error.
        """
        tried = {(c,): self.score((c,)) for c in changes(self._whole) if c.kind == "shift"}
        way = min(tried, key=lambda w: tried[w])
        good = tried[way] <= min(self.enough, self.score(()) / FACTOR)
        return (Explanation(way, tried[way]),) if good else ()

    def _enough(
        self, tried: dict[tuple[Change, ...], float], base: float
    ) -> tuple[Explanation, ...]:
        """Those that explain the readings: the simplest of each kind, best first."""
        least = min(tried.values())
        if least > min(self.enough, base / FACTOR):
            return ()
        # What can be left out without loss is a gauge, or was a wrong turn.
        for way in [w for w in tried if tried[w] <= ALIKE * least + 1e-6]:
            for change in way:
                rest = tuple(c for c in way if c != change)
                if rest and rest not in tried and self.score(rest) <= ALIKE * least + 1e-6:
                    tried = {**tried, rest: self.score(rest)}
        alike = [w for w, rms in tried.items() if rms <= ALIKE * least + 1e-6]
        alike.sort(key=lambda w: (_cost(w), tried[w]))
        out: list[tuple[Change, ...]] = []
        for way in alike:
            what = [_thing(c) for c in way]
            if _cost(way) <= _cost(alike[0]) and what not in [[_thing(c) for c in w] for w in out]:
                out.append(way)
        return tuple(Explanation(w, tried[w]) for w in out)

    def _zeros(self, ways: list[tuple[Change, ...]]) -> dict[tuple[Change, ...], float]:
        """Try any constant as the zero of each joint, beside what is changed already."""
        out = {}
        for way in ways:
            for j in range(1, self._cell.arm.n + 1):
                if any(c.kind == "joint" and c.joint == j for c in way):
                    continue
                offset, rms = self.zero_of(way, j)
                if abs(np.degrees(offset)) > OFF_DEG:
                    new = (*way, Change("joint", j, 1, offset))
                    out[tuple(sorted(new, key=_order))] = rms
        return out

    def zero_of(self, way: tuple[Change, ...], joint: int) -> tuple[float, float]:
        """Return the best zero of one joint, rad, and the misfit with it, m."""
        grid = [float(np.radians(d)) for d in (0.0, 45.0, -45.0, 135.0, -135.0)]
        begin = min(grid, key=lambda o: self.score((*way, Change("joint", joint, 1, o)), True))
        return self._slide(way, joint, begin)

    def _slide(self, way: tuple[Change, ...], joint: int, offset: float) -> tuple[float, float]:
        """Gauss-Newton over the zero of a joint, the frames estimated throughout."""
        step, rms, kept = 1e-4, np.inf, offset
        for _ in range(6):
            seen, given, free = self._problem((*way, Change("joint", joint, 1, offset)), self._few)
            at = self._best(seen, given, free, rough=True)
            now = float(np.sqrt(at.square / len(seen)))
            if now < rms:
                rms, kept = now, offset
            elif now > 0.999 * rms:
                break
            ahead, _, _ = self._problem((*way, Change("joint", joint, 1, offset + step)), self._few)
            slope = (misfit(ahead, at.frames) - at.off) / step
            offset = _wrapped(offset + self._newton(seen, at, free, slope))
        return kept, rms

    @staticmethod
    def _newton(seen: Seen, at: Minimum, free: Free, slope: Floats) -> float:
        """Step of a parameter that moves the misfit by `slope` (N, m), frames projected out."""
        a = (seen.root @ derivative(seen, at.frames, at.centre)).reshape(-1, len(free.mask))
        a = a[:, free.mask]
        column = np.einsum("nij,nj->ni", seen.root, slope).reshape(-1)
        off = np.einsum("nij,nj->ni", seen.root, at.off).reshape(-1)
        if a.shape[1]:
            column = column - a @ np.linalg.lstsq(a, column, rcond=1e-9)[0]
        length = float(column @ column)
        return float(np.clip(-(column @ off) / length, -0.5, 0.5)) if length > 1e-9 else 0.0

    def _score(self, way: tuple[Change, ...], rough: bool = False) -> float:
        """Misfit of the nominal arm under some changes, m; in units of the positions as given.

        Args:
            way: the changes.
            rough: in few steps from few starts.
        """
        self.tried += 1
        seen, given, free = self._problem(way, self._few)
        rms = float(np.sqrt(self._best(seen, given, free, rough).square / len(seen)))
        return rms * max(1.0, self._extent / max(_extent(seen.value), 1e-12))

    def _best(self, seen: Seen, given: Frames, free: Free, rough: bool = False) -> Minimum:
        steps = 6 if rough else 15
        best: Minimum | None = None
        for start in closed_forms(seen, given, free):
            found = minimise(seen, start, free, steps=steps)
            best = found if best is None or found.square < best.square else best
            if best.square <= self.enough**2 * len(seen):
                return best
        if best is None or not rough:

            def square(frames: Frames) -> float:
                return float(np.sum((seen.root @ misfit(seen, frames)[..., None]) ** 2))

            begun = sorted(rotated(seen, given, free), key=square)[:2]
            found_too = [minimise(seen, s, free, steps=steps) for s in begun]
            best = min([*found_too, *([best] if best else [])], key=lambda m: m.square)
        return best

    def _problem(self, way: tuple[Change, ...], rows: Ints) -> tuple[Seen, Frames, Free]:
        """Flange poses and readings of some rows under some changes."""
        d = self._described(way)
        rows = rows[d.paired[rows]]
        chain = chains.evaluate(d.arm, d.q[rows])
        m = 3 if d.turn is None else 6
        root = np.diag(np.repeat([1.0, LEVER], 3)[:m])
        seen = Seen(
            np.ascontiguousarray(chain.rotation[-1]),
            np.ascontiguousarray(chain.position[-1]),
            d.value[rows],
            None if d.turn is None else se3.rotation(d.turn[rows]),
            np.broadcast_to(root, (len(rows), m, m)),
            self._readings.target[rows],
        )
        cell = self._cell
        known = np.array(cell.known_targets) & (not d.target_unknown)
        axes = m == 6 and (d.base_unknown or not known.all())
        # What was estimated with the wrong description is no start for another one.
        base = cell.registration if cell.registration_known else np.eye(4)
        own = np.array(cell.known_targets)[:, None, None]
        given = Frames(base, np.where(own, cell.all_targets, np.eye(4)))
        return seen, given, Free.of(d.base_unknown, ~known, axes)

    def _described(self, way: tuple[Change, ...]) -> Described:
        d = self._whole
        for change in way:
            d = change.applied(d)
        return d

    def robust(self, way: tuple[Change, ...]) -> _Robust:
        """Registration by most of the rows: reweighted until the others do not matter."""
        seen, given, free = self._problem(way, np.arange(len(self._readings)))
        at = self._best(seen, given, free)
        weight = np.repeat([1.0, LEVER], 3)[: seen.m]
        scale = np.inf
        for _ in range(12):
            distance = np.sqrt(np.sum((at.off * weight) ** 2, axis=1))
            scale = min(scale, max(float(np.median(distance)), self.enough / 10))
            weights = 1.0 / (1.0 + (distance / (2.0 * scale)) ** 2) ** 2
            at = minimise(seen, at.frames, free, weights, steps=5)
        distance = np.sqrt(np.sum((at.off * weight) ** 2, axis=1))
        scale = max(float(np.median(distance)), self.enough / 10)
        far = distance > 8.0 * scale
        near = distance[~far]
        everywhere = np.zeros(len(self._readings), dtype=bool)
        everywhere[self._described(way).paired] = far
        return _Robust(float(np.sqrt(np.mean(near**2))), everywhere, seen, at)

    def within(self, gate: float, whole: _Robust) -> bool:
        """Whether most rows fit to within the gate, so that the others are to blame."""
        share = float(whole.far.mean())
        return 0 < share <= WRONG_ROWS and whole.rms <= gate

    def swapped(self, whole: _Robust, rows: Ints) -> tuple[tuple[int, int], ...]:
        """Pairs of rows whose readings fit each other's place."""
        out: list[tuple[int, int]] = []
        for k, i in enumerate(rows[:30]):
            for j in rows[k + 1 : 30]:
                pair = np.array([i, j])
                there, back = whole.seen[pair], whole.seen[pair[::-1]]
                crossed = Seen(
                    there.rotation,
                    there.position,
                    back.value,
                    back.attitude,
                    there.root,
                    there.target,
                )
                if _size(misfit(crossed, whole.at.frames)) <= 3.0 * max(self.enough, whole.rms):
                    out.append((int(i), int(j)))
        return tuple(out)


def _cost(way: tuple[Change, ...]) -> int:
    return sum(c.cost for c in way)


def _wrapped(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _thing(change: Change) -> tuple[object, ...]:
    """What a change is about, whatever zero it says."""
    return (change.kind, change.joint, change.follows, change.arm, change.sign)


def _order(change: Change) -> tuple[object, ...]:
    """Changes of the arm come first, then those of joints, then couplings."""
    rank = {"arm": 0, "joint": 1, "coupling": 2}.get(change.kind, 3)
    return (rank, change.kind, change.joint, change.follows, change.sign, change.offset)


def _excluded(a: Change, way: tuple[Change, ...]) -> bool:
    """Whether a change is of something that is changed already."""
    return any((a.kind, a.joint, a.follows) == (b.kind, b.joint, b.follows) for b in way)


def _extent(positions: Floats) -> float:
    """Rms distance of positions (N, 3) from their mean, m."""
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))
