"""Whether the readings fit the description of the arm at all, and what is wrong where they do not.

After registration the nominal arm misses readings by its geometric errors, some mm at most. What
is far more is no effect but a wrong description. Single hypotheses (`hypotheses`) are tried on some
of the readings, then the best of them in combination (beam search), until one explains the
readings.

Arms of one size differ by millimetres from one generation to the next, and registration hides part
of that: readings of a UR10 leave some 4 mm with the description of a UR10e, which is not too much
for an arm before calibration. So every arm of the catalogue with as many joints is registered to
the readings as the described one was (`other_arm`). With e the displacements by the errors of the
true arm and d those from one description to the other, the frames projected off, the wrong
description leaves |e + d| and the right one |e|. One that leaves less than half of what the
described one leaves is named. For the described arm to be the right one then, |e − d| ≤ |e|/2: its
errors would be larger than 2/3 |d|, and lie along d.
"""

from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.optimize import minimize_scalar

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.hypotheses import (
    TRIED,
    Described,
    Hypothesis,
    hypotheses,
    keys,
    mended,
    pairs,
)
from hilcal.identification.registration import Registration, register
from hilcal.identification.residual import noise_floor
from hilcal.identification.rigid_frames import (
    FrameData,
    Frames,
    Placement,
    angles,
    best_placement,
    free_parameters,
    given_and_free,
)
from hilcal.identification.solver import minimise
from hilcal.numbers import length
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm
from hilcal.robot.catalogue import other_arms
from hilcal.robot.chain import evaluate
from hilcal.robot.conventions import as_counted
from hilcal.types import Bools, Floats, Ints

GATE_M = 0.010
GATE_REACH = 0.01
"""The gate: rms misfit in m, and as a share of the reach, whichever is more. Arms before
calibration are 0.1 to 3 mm off, old or large ones up to 1 % of their reach."""
LOOK = 0.3
"""Share of the gate above which hypotheses are tried: a wrong description may hide behind the
frames, or concern a joint that hardly turns. A choice."""
GATE_EXTENT = 0.03
"""Share of the extent of the positions that counts as a misfit where they lie close together; a
choice: a joint that counts wrongly moves a target as far as the poses do."""
LEVER = 0.3
"""Lever by which attitude errors count as position errors, m: an ordinary tool; a choice."""
ROWS = 40
"""Readings that hypotheses are tried on, spread over all; a choice: seven times the unknowns."""
DEPTH = 3
"""Most hypotheses in combination; a choice."""
BEAM = (6, 3)
"""Best ones that a second and a third hypothesis is tried on; a choice."""
FACTOR = 4.0
"""How many times smaller a hypothesis must make the misfit; a choice."""
CAREFUL = 10
"""Best ones by a rough search that are searched with care; a choice."""
ALIKE = 2.0
"""Hypotheses that leave less than so many times the least misfit do equally well; a choice."""
WRONG_ROWS = 0.2
"""Largest share of rows that may be wrong by themselves; a choice."""
FIRST = ("shift", "columns")
"""Kinds that others are combined with where they help by themselves, for speed."""
OFF_DEG = 0.2
"""Zero of a single joint, degrees, from which on it is worth a word; a choice."""
MOST_NAMED = 8
"""Rows, or explanations, that are named; a choice."""
HALF = 0.5
"""Share of the described arm's misfit that another one may leave to be named. A choice: of 900
simulated arms off by 1 and 3 mm and mrad none was named another one
(`tests/unit/identification/test_other_arm.py` keeps a part of them)."""
ZEROS = tuple(np.radians([0.0, 45.0, -45.0, 135.0, -135.0]).tolist())
ZERO_WIDTH, ZERO_EXACT = np.pi / 4, 1e-7
"""Zeros of a joint that the search begins at, how far it goes from them, and its end, rad."""
BEYOND_NOISE = 3.0
"""Misfit in standard deviations of the readings from which on other arms are tried; a choice."""
ARM_ROWS, ARM_STEPS = 100, 10
"""Readings that every arm is tried on, the best is registered to all; and Gauss-Newton steps of a
registration from the frames of the described arm. Choices."""

Way = tuple[Hypothesis, ...]
"""Hypotheses that are tried together."""


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Hypotheses that together explain the readings.

    Attributes:
        changes: what is otherwise than described.
        rms: misfit with them, m; attitudes count with `LEVER`.
    """

    changes: Way
    rms: float


@dataclass(frozen=True, slots=True, eq=False)
class DescriptionFinding:
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

    def words(self, cell: Cell, readings: Readings) -> str:
        """Return in one line what is wrong, and what to write instead."""
        size, rows = length(self.rms), self._rows_named(readings)
        after = f"({size} rms after registration)"
        begin = f"the readings do not fit the description of the arm {after}"
        if self.explanations:
            said = [
                f"{' and '.join(h.words for h in e.changes)}: {size} → {length(e.rms)} with it"
                f"{mended(e.changes, cell)}"
                for e in self.explanations[:MOST_NAMED]
            ]
            line = f"{begin}: {'; or, as well: '.join(said)}"
            return f"{line}; besides, {rows}" if rows else line
        if rows and not self.refused:
            return f"{rows}; the others fit {after}. They are left out of a fit"
        if rows:
            return f"{begin}: {rows}; the others fit. Correct or remove them"
        return (
            f"{begin}; at most {length(self.gate)} is fitted. Nothing that was tried explains it "
            f"({self.tried} descriptions: {TRIED}). Check the robot's model, and that joints and "
            "positions in one row belong together"
        )

    def _rows_named(self, readings: Readings) -> str:
        """Name the rows that do not fit while most do."""
        which = np.flatnonzero(self.rows)
        if not len(which):
            return ""

        def name(k: int) -> str:
            at = f"{readings.pose_names[readings.pose[k]]}/{readings.load_names[readings.load[k]]}"
            several = readings.states.target is not None
            return f"{at} {readings.target_names[readings.target[k]]}" if several else at

        if self.swapped:
            crossed = [f"{name(i)} with {name(j)}" for i, j in self.swapped[:MOST_NAMED]]
            return f"rows are swapped ({', '.join(crossed)})"
        named = ", ".join(name(int(k)) for k in which[:MOST_NAMED])
        more = f" and {len(which) - MOST_NAMED} more" if len(which) > MOST_NAMED else ""
        return f"{len(which)} of {len(readings)} rows do not fit: {named}{more}"

    def to_json(self, cell: Cell, readings: Readings) -> dict[str, object]:
        """Return its JSON."""
        return {
            "message": self.words(cell, readings),
            "rms_m": self.rms,
            "gate_m": self.gate,
            "explanations": [
                {
                    "rms_m": e.rms,
                    "changes": [asdict(h) for h in e.changes],
                    "robot": keys(e.changes, cell),
                }
                for e in self.explanations
            ],
            "rows": np.flatnonzero(self.rows).tolist(),
            "swapped": [list(pair) for pair in self.swapped],
            "tried": self.tried,
        }


def gate_of(reach: float) -> float:
    """Rms misfit above which nothing is fitted, m."""
    return max(GATE_M, GATE_REACH * reach)


def refuse_misdescribed(registered: Registration, readings: Readings) -> None:
    """Refuse readings that do not fit the description of the arm, before anything is fitted.

    Raises:
        InputError: says what is wrong with the description, where that was found.
    """
    finding = examine(registered, readings)
    if finding is not None and finding.refused:
        raise InputError(finding.words(registered.cell, readings))


def examine(registered: Registration, readings: Readings) -> DescriptionFinding | None:
    """Return what is wrong with the description; None where the readings fit it.

    Args:
        registered: the registration of the nominal arm.
        readings: the readings.
    """
    cell, gate = registered.cell, gate_of(registered.cell.arm.reach)
    # A base that is told shows the whole geometric error, however close the positions lie.
    extent = np.inf if cell.registration_known else _extent(readings.value[:, :3])
    far, rms, noise = registered.far, _size(registered.off), noise_floor(readings.covariance)
    nothing = np.zeros_like(far)
    if cell.observers:  # what else the arm may be is told by positions in one frame
        rest = _size(registered.off[~far])
        return DescriptionFinding(rest, gate, (), far, (), 0) if far.any() or rest > gate else None
    if far.any():
        others = _size(registered.off[~far])
        search = _DescriptionSearch(cell, readings, max(3.0 * noise, others))
        shifted = search.shifted()
        if shifted:
            return DescriptionFinding(rms, gate, shifted, nothing, (), search.tried)
        swapped = search.swapped(far)
        return DescriptionFinding(rms if swapped else others, gate, (), far, swapped, 1)
    if rms <= min(LOOK * gate, max(GATE_EXTENT * extent, 5.0 * noise)):
        return None
    close = max(0.02 * min(extent, cell.arm.reach), rms / 50.0)
    search = _DescriptionSearch(cell, readings, max(3.0 * noise, min(0.25 * gate, close)))
    near, bad, _ = search.robust(())
    if bad.any() and (shifted := search.shifted()):
        return DescriptionFinding(rms, gate, shifted, nothing, (), search.tried)
    few = bool(bad.any() and bad.mean() <= WRONG_ROWS)
    if few and near <= search.enough:
        return DescriptionFinding(rms, gate, (), bad, search.swapped(bad), 1)
    found = search.explain(gate, DEPTH if rms > gate else 1)
    if not found and rms <= gate:
        return None
    if not found and few and near <= gate:
        return DescriptionFinding(rms, gate, (), bad, (), search.tried)
    rows = search.robust(found[0].changes)[1] if found else nothing
    rows = rows if rows.mean() <= WRONG_ROWS else nothing
    return DescriptionFinding(rms, gate, found, rows, (), search.tried)


class _DescriptionSearch:
    """Descriptions that are tried on the same readings."""

    def __init__(self, cell: Cell, readings: Readings, enough: float) -> None:
        self._cell, self._readings = cell, readings
        self.enough, self.tried = enough, 0
        self._whole = Described(
            cell.arm,
            angles(readings),
            readings.value[:, :3],
            readings.value[:, 3:] if readings.m == 6 else None,
            not cell.registration_known,
            not all(cell.known_targets),
            conventions=None if cell.config is None else cell.config.robot,
        )
        self._few = np.unique(np.linspace(0, len(readings) - 1, ROWS).astype(int))
        flange = evaluate(cell.arm, self._whole.q).position[-1]
        self._extent = min(_extent(readings.value[:, :3]), _extent(flange))
        self.score = lru_cache(maxsize=None)(self._score)
        self.robust = lru_cache(maxsize=None)(self._robust)

    def explain(self, gate: float, most: int) -> tuple[Explanation, ...]:
        """Return the shortest combination that explains the readings, and its likes."""
        base = self.score(())
        singles = tuple(hypotheses(self._whole))
        beam: list[Way] = [()]
        tried: dict[Way, float] = {}
        for depth in range(most):
            others = [h for h in singles if depth == 0 or h.kind not in FIRST]
            ways = [
                (*begun, h)
                for begun in beam
                for h in others
                if h.subject not in [other.subject for other in begun]
            ]
            if depth == 1:
                slides = self._cell.arm.slides
                ways += [
                    way
                    for way in pairs(self._cell.arm.n)
                    if not any(h.offset and slides[h.joint - 1] for h in way)
                ]
            rough = {w: self.score(w, True) for w in dict.fromkeys(map(_sorted, ways))}
            best = sorted(rough, key=lambda w: (rough[w], _cost(w)))[:CAREFUL]
            now = {**rough, **{w: self.score(w) for w in best}}
            if depth < 2 and min(now.values()) > self.enough:
                now.update(self._zeros(beam[:2]))
            tried.update(now)
            found = self._enough(now, base)
            if found:
                return found
            beam = sorted(now, key=lambda w: (now[w], _cost(w)))[: BEAM[min(depth, 1)]]
        return _explained(tried, min(gate, base / FACTOR))

    def shifted(self) -> tuple[Explanation, ...]:
        """Return the shift of rows that explains the readings, where one does.

        Where a pose has many readings, only its last one is wrong, and looks like a gross error.
        """
        ways: list[Way] = [(h,) for h in hypotheses(self._whole) if h.kind == "shift"]
        tried = {way: self.score(way) for way in ways}
        return _explained(tried, min(self.enough, self.score(()) / FACTOR))

    def _enough(self, tried: dict[Way, float], base: float) -> tuple[Explanation, ...]:
        """Those that explain the readings: the simplest of each kind, best first."""
        least = min(tried.values())
        if least > min(self.enough, base / FACTOR):
            return ()
        alike = ALIKE * least + 1e-6
        # What can be left out without loss is a gauge, or was a wrong turn.
        for way in [w for w in tried if tried[w] <= alike]:
            for h in way:
                rest = tuple(other for other in way if other != h)
                if rest and rest not in tried and self.score(rest) <= alike:
                    tried = {**tried, rest: self.score(rest)}
        good = sorted((w for w in tried if tried[w] <= alike), key=lambda w: (_cost(w), tried[w]))
        out: dict[tuple[object, ...], Way] = {}
        for way in good:  # of those that differ by their zeros alone, one
            if _cost(way) <= _cost(good[0]):
                out.setdefault(tuple((*h.subject, h.arm, h.sign) for h in way), way)
        return tuple(Explanation(w, tried[w]) for w in out.values())

    def _zeros(self, ways: list[Way]) -> dict[Way, float]:
        """Try any constant as the zero of each joint, beside what is otherwise already."""
        out = {}
        for way in ways:
            counted = [h.joint for h in way if h.kind == "joint"]
            for j in range(1, self._cell.arm.n + 1):
                if j in counted or self._cell.arm.slides[j - 1]:
                    continue
                zero, rms = self._zero_of(way, j)
                if abs(np.degrees(zero)) > OFF_DEG:
                    out[_sorted((*way, Hypothesis("joint", j, 1, zero)))] = rms
        return out

    def _zero_of(self, way: Way, joint: int) -> tuple[float, float]:
        """Return the best zero of one joint, rad, and the misfit with it, m."""

        def zeroed(zero: float) -> Way:
            return (*way, Hypothesis("joint", joint, 1, zero))

        def placed(zero: float) -> Placement:
            return self._best(*self._problem(zeroed(zero), self._few), rough=True)

        begin = min(ZEROS, key=lambda zero: self.score(zeroed(zero), True))
        found = minimize_scalar(
            lambda zero: placed(zero).square,
            bounds=(begin - ZERO_WIDTH, begin + ZERO_WIDTH),
            method="bounded",
            options={"xatol": ZERO_EXACT},
        )
        return _wrapped(found.x), _rms(placed(found.x))

    def _score(self, way: Way, rough: bool = False) -> float:
        """Misfit of the nominal arm under some hypotheses, m; in units of the positions as given.

        Args:
            way: the hypotheses.
            rough: in few steps from few starts.
        """
        self.tried += 1
        at = self._best(*self._problem(way, self._few), rough)
        return _rms(at) * max(1.0, self._extent / max(_extent(at.seen.value), 1e-12))

    def _best(self, seen: FrameData, given: Frames, free: Bools, rough: bool = False) -> Placement:
        steps, rotated = (6, 0) if rough else (15, 2)
        return best_placement(seen, given, free, self.enough, steps, rotated)

    def _problem(self, way: Way, rows: Ints) -> tuple[FrameData, Frames, Bools]:
        """Flange poses and readings of some rows under some hypotheses, and what is estimated."""
        d = self._described(way)
        rows = rows[d.paired[rows]]
        turn, m = (None, 3) if d.turn is None else (d.turn[rows], 6)
        root = np.broadcast_to(np.diag(_levers(m)), (len(rows), m, m))
        seen = FrameData.at(
            d.arm, d.q[rows], d.value[rows], turn, root, self._readings.target[rows]
        )
        cell = self._cell
        # What was estimated with the wrong description is no start for another one.
        base = cell.registration if cell.registration_known else np.eye(4)
        own = np.array(cell.known_targets)
        given = Frames(base, np.where(own[:, None, None], cell.all_targets, np.eye(4)))
        known = own & (not d.target_unknown)
        axes = m == 6 and (d.base_unknown or not known.all())
        return seen, given, free_parameters(d.base_unknown, ~known, axes)

    def _described(self, way: Way) -> Described:
        d = self._whole
        for h in way:
            d = h.applied(d)
        return d

    def _robust(self, way: Way) -> tuple[float, Bools, Placement]:
        """Registration by most of the rows: reweighted until the others do not matter.

        Returns:
            Rms of the rows that fit, m; (N,) those that do not; and the frames.
        """
        seen, given, free = self._problem(way, np.arange(len(self._readings)))
        at = self._best(seen, given, free)
        scale = np.inf
        for _ in range(12):
            distance = np.linalg.norm(at.white, axis=1)
            scale = min(scale, max(float(np.median(distance)), self.enough / 10))
            weights = 1.0 / (1.0 + (distance / (2.0 * scale)) ** 2)
            weighted = replace(seen, root=seen.root * weights[:, None, None])
            frames = minimise(Placement(weighted, at.frames, free), steps=5).frames
            at = Placement(seen, frames, free)
        distance = np.linalg.norm(at.white, axis=1)
        far = distance > 8.0 * max(float(np.median(distance)), self.enough / 10)
        everywhere = np.zeros(len(self._readings), dtype=bool)
        everywhere[self._described(way).paired] = far
        return float(np.sqrt(np.mean(distance[~far] ** 2))), everywhere, at

    def swapped(self, far: Bools) -> tuple[tuple[int, int], ...]:
        """Pairs of rows that do not fit (N,) whose readings fit each other's place."""
        near, _, at = self.robust(())
        out = []
        for i, j in combinations(np.flatnonzero(far)[:30].tolist(), 2):
            there, back = at.seen[np.array([i, j])], at.seen[np.array([j, i])]
            crossed = replace(there, value=back.value, attitude=back.attitude)
            if _size(crossed.misfit(at.frames)) <= 3.0 * max(self.enough, near):
                out.append((i, j))
        return tuple(out)


def _explained(tried: dict[Way, float], most: float) -> tuple[Explanation, ...]:
    """Return the best of some trials where it leaves no more than `most`, m."""
    way = min(tried, key=lambda w: tried[w])
    return (Explanation(way, tried[way]),) if tried[way] <= most else ()


def _cost(way: Way) -> int:
    return sum(h.cost for h in way)


def _sorted(way: Way) -> Way:
    return tuple(sorted(way, key=lambda h: h.order_of_trial))


def _wrapped(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _levers(m: int) -> Floats:
    return np.repeat([1.0, LEVER], 3)[:m]


def _size(off: Floats) -> float:
    """Rms of misfits (N, m), attitudes with `LEVER`, m."""
    return float(np.sqrt(np.mean(np.sum((off * _levers(off.shape[1])) ** 2, axis=1))))


def _rms(at: Placement) -> float:
    """The same of a placement whose whitened misfit has the levers."""
    return float(np.sqrt(at.square / len(at.seen)))


def _extent(positions: Floats) -> float:
    """Rms distance of positions (N, 3) from their mean, m."""
    return float(np.sqrt(np.mean(np.sum((positions - positions.mean(axis=0)) ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class OtherArm:
    """An arm of the catalogue that fits better than the described one.

    Attributes:
        name: its name.
        rms: what the described arm leaves after registration, m.
        rms_with: what this one leaves, m.
    """

    name: str
    rms: float
    rms_with: float

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {"arm": self.name, "rms_m": self.rms, "rms_with_m": self.rms_with}


def other_arm(registered: Registration, readings: Readings) -> OtherArm | None:
    """Return the arm of the catalogue that these readings are of; None where none fits better.

    Args:
        registered: the registration of the described arm.
        readings: the readings.
    """
    cell = registered.cell
    if cell.observers or registered.rms <= BEYOND_NOISE * noise_floor(readings.covariance):
        return None
    spread = np.unique(np.linspace(0, len(readings) - 1, ARM_ROWS).astype(int))
    tried = [(_left(cell, arm, readings[spread]), arm) for arm in _others(cell)]
    if not tried:
        return None
    least, arm = min(tried, key=lambda each: each[0])
    if least > HALF * registered.rms:
        return None
    left = _left(cell, arm, readings)
    return OtherArm(arm.name, registered.rms, left) if left <= HALF * registered.rms else None


def other_arm_of(cell: Cell, readings: Readings) -> OtherArm | None:
    """Register the described arm, and return the one that fits better; see `other_arm`."""
    try:
        return other_arm(register(cell, readings), readings)
    except CannotAnswerError:
        return None


def _others(cell: Cell) -> Iterator[Arm]:
    """Yield the other arms of the catalogue with as many joints, as the controller counts them."""
    robot = None if cell.config is None else cell.config.robot
    for arm in other_arms(cell.arm):
        yield arm if robot is None else as_counted(arm, robot)


def _left(cell: Cell, arm: Arm, readings: Readings) -> float:
    """Rms misfit of the positions with another arm, from the frames of the described one, m."""
    seen = FrameData.of(arm, readings)
    off = minimise(Placement(seen, *given_and_free(cell, seen.m == 6)), ARM_STEPS).off
    return float(np.sqrt(np.mean(np.sum(off[:, :3] ** 2, axis=1))))
