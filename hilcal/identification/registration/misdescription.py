"""Whether the readings fit the description of the arm, and what is wrong where they do not.

After registration the nominal arm misses readings by its geometric errors, some mm at most. A far
larger misfit is no effect but a wrong description. Single hypotheses (`KINDS`) are tried on some of
the readings, then the best of them in combination (beam search), until one explains the readings.

Arms of one size differ by millimetres from one generation to the next, which is not too much for an
arm before calibration. So every arm of the catalogue with as many joints is registered to the
readings, too (`other_arm`). With e the displacements by the errors of the true arm and d those from
one description to the other, the frames projected off, the wrong description leaves |e + d| and the
right one |e|. One that leaves less than half of what the described one leaves is named. If the
described arm were the right one, then |e − d| ≤ |e|/2: its errors would be larger than 2/3 |d|, and
lie along d.
"""

from dataclasses import asdict, dataclass, replace
from functools import lru_cache, reduce
from itertools import combinations

import numpy as np
import scipy

from hilcal.cell import Cell
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.registration.hypotheses import (
    Combination,
    Description,
    Hypothesis,
    correction,
    hypotheses,
    pairs,
    robot_keys,
    shifts,
)
from hilcal.identification.registration.placement import (
    FrameData,
    Frames,
    Placement,
    angles,
    best_placement,
    free_parameters,
    given_and_free,
    minimise,
)
from hilcal.identification.registration.registration import (
    LEAST_SCATTER_M,
    Registration,
    computed_from_joints,
    register,
    scatters_less_than_arms,
)
from hilcal.identification.residual import noise_floor
from hilcal.numbers import length
from hilcal.readings.readings import Readings
from hilcal.robot.arm import Arm, with_controller_conventions
from hilcal.robot.catalogue import other_arms
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
GATE_M, GATE_REACH = 0.010, 0.01  # the gate: rms misfit, m, or as a share of the reach if more;
# arms before calibration are 0.1 to 3 mm off, old or large ones up to 1 % of their reach
SEARCH_SHARE = 0.3  # share of the gate above which hypotheses are tried: frames may hide a part
GATE_EXTENT = 0.03  # share of the positions' extent that counts as a misfit where they are close
EXACT_M = 1e-11  # rms below which positions are computed to the last digit; a choice
EXTENT_LEFT = 0.1  # share of that extent that an explanation may leave
LEVER = 0.3  # m, by which attitude errors count as position errors: an ordinary tool
ROWS = 40  # readings that hypotheses are tried on, spread over all: seven times the unknowns
DEPTH, BEAM = 3, (6, 3)  # most hypotheses together; best ones that a 2nd and a 3rd are tried on
LEAST_IMPROVEMENT = 4.0  # how many times smaller a hypothesis must make the misfit
MOST_CAREFUL = 10  # best ones by a rough search that are searched with care
EQUALLY_GOOD = 2.0  # hypotheses that leave less than so many times the least misfit do equally well
MOST_WRONG_ROWS = 0.2  # largest share of rows that may be wrong by themselves
SEPARATE_FIRST = ("shift", "columns")
"""Hypotheses that are combined with others only where they help by themselves; for speed."""
LEAST_ZERO_DEG = 0.2  # zero of a single joint, degrees, that is worth mentioning
FEWEST_BY_THEMSELVES = 10  # readings that determine a place of the tracker alone; a choice
MOST_NAMED = 8  # rows, or explanations, that are named
ZERO_STARTS = tuple(np.radians([0.0, 45.0, -45.0, 135.0, -135.0]).tolist())  # where searches begin
ZERO_WIDTH, ZERO_EXACT = np.pi / 4, 1e-7  # range of a search to both sides, and its tolerance, rad
OTHER_ARM_SHARE = 0.5
"""Share of the described arm's misfit that another may leave to be named; of 900 simulated arms off
by 1 and 3 mm and mrad none was named another one (test_other_arm keeps some)."""
BEYOND_NOISE = 3.0  # misfit in standard deviations from which on other arms are tried
ARM_ROWS, ARM_STEPS = 100, 10  # readings that every arm is tried on; steps of its registration
HYPOTHESES_IN_WORDS = (
    "signs, zeros, couplings and columns of the joints, units, shifted rows, mirrored axes, "
    "inverse poses, other arms, alone and in combination"
)


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    """Hypotheses that together explain the readings."""

    changes: Combination
    rms: float  # misfit with them, m; attitudes count with `LEVER`


@dataclass(frozen=True, slots=True, eq=False)
class DescriptionFinding:
    """What is wrong with the description."""

    rms: float  # misfit as described, m; attitudes count with `LEVER`
    gate: float  # misfit above which nothing is fitted, m
    explanations: tuple[Explanation, ...]  # best first; several do equally well
    rows: Bools  # (N,) readings that do not fit, while most do
    swapped: tuple[tuple[int, int], ...] = ()  # pairs of them that fit each other's place
    moved: int = 0  # first reading from another place of the tracker, where that explains them
    tried: int = 0  # number of descriptions that were tried
    computed: bool = False  # the positions are computed from the joint values, not measured
    too_exact: bool = False  # the positions scatter by less than those of any arm
    apart: tuple[int, int] | None = None  # two readings of one state, where such are far apart

    @property
    def refused(self) -> bool:
        """Whether nothing should be fitted to these readings as described.

        Below the gate the zero of a joint is something that effects can estimate.
        """
        if self.too_exact:
            return False  # somebody simulates without noise
        zeros = all(e.changes[0].is_zero and len(e.changes) == 1 for e in self.explanations)
        return self.computed or self.apart is not None or self.rms > self.gate or not zeros

    def words(self, cell: Cell, readings: Readings) -> str:
        """Return in one line what is wrong, and what to write instead."""
        size, rows = length(self.rms), self._rows_named(readings)
        if self.computed:
            return (
                "these positions seem to be computed from the joint values, not measured: the "
                f"nominal arm leaves {size} rms, which is their rounding. Take the columns of what "
                "the tracker measured; if these are, write more digits"
            )
        if self.too_exact:
            return (
                "these positions are no measurements, it seems, but desired or computed ones, or "
                "simulated without noise: an arm of slightly other lengths leaves less than "
                f"{length(LEAST_SCATTER_M)} of them, and no arm repeats to that. What is fitted to "
                "them says nothing of an arm; take the columns of what the tracker measured"
            )
        if self.moved:
            last, first = (self._name(readings, self.moved + k) for k in (-1, 0))
            return (
                f"the readings up to {last} and those from {first} on fit, but not together "
                f"({size} rms after registration): was the tracker or the base moved between "
                "them? In a column 'station' each place of the tracker has a name"
            )
        note = f"({size} rms after registration)"
        if self.apart is not None:
            i, j = self.apart
            distance = length(float(np.linalg.norm(readings.value[i, :3] - readings.value[j, :3])))
            return (
                "rows of the same joint values and load have positions far apart (two of "
                f"{self._name(readings, i)}: {distance}), which no arm explains {note}: are they "
                "of several reflectors, or was the tracker moved? In a column 'target' each "
                "reflector has a name, in a column 'station' each place of the tracker"
            )
        begin = f"the readings do not fit the description of the arm {note}"
        if self.explanations:
            causes = [
                f"{' and '.join(h.words for h in e.changes)}: {size} → {length(e.rms)} with it"
                f"{correction(e.changes, cell)}"
                for e in self.explanations[:MOST_NAMED]
            ]
            line = f"{begin}: {'; or, as well: '.join(causes)}"
            return f"{line}; besides, {rows}" if rows else line
        if rows and not self.refused:
            aside = "A fit sets aside those that it finds to be gross errors"
            return f"{rows}; the others fit {note}. {aside}"
        if rows:
            return f"{begin}: {rows}; the others fit. Correct or remove them"
        return (
            f"{begin}; at most {length(self.gate)} is fitted. Nothing that was tried explains it "
            f"({self.tried} descriptions: {HYPOTHESES_IN_WORDS}). Check the robot's "
            "model, and that joints and positions in one row belong together"
        )

    def _rows_named(self, readings: Readings) -> str:
        which = np.flatnonzero(self.rows).tolist()
        if not which:
            return ""
        if self.swapped:
            crossed = [
                f"{self._name(readings, i)} with {self._name(readings, j)}"
                for i, j in self.swapped[:MOST_NAMED]
            ]
            return f"rows are swapped ({', '.join(crossed)})"
        suffix = f" and {len(which) - MOST_NAMED} more" if len(which) > MOST_NAMED else ""
        named = ", ".join(self._name(readings, k) for k in which[:MOST_NAMED])
        return f"{len(which)} of {len(readings)} rows do not fit: {named}{suffix}"

    @staticmethod
    def _name(readings: Readings, k: int) -> str:
        pose = readings.pose_names[readings.pose[k]]
        label = f"{pose}/{readings.load_names[readings.load[k]]}"
        several = readings.states.target is not None
        return f"{label} {readings.target_names[readings.target[k]]}" if several else label

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
                    "robot": robot_keys(e.changes, cell),
                }
                for e in self.explanations
            ],
            "rows": np.flatnonzero(self.rows).tolist(),
            "swapped": [list(pair) for pair in self.swapped],
            "moved": self.moved,
            "computed": self.computed or self.too_exact,
            "apart": None if self.apart is None else list(self.apart),
            "tried": self.tried,
        }


def refuse_misdescribed(registered: Registration, readings: Readings) -> None:
    """Refuse readings that do not fit the description of the arm, and say what is wrong with it.

    Exact positions of the nominal arm are not refused: somebody simulates without noise.
    """
    finding = examine(registered, readings)
    exact = finding is not None and finding.computed and registered.rms < EXACT_M
    if finding is not None and finding.refused and not exact:
        raise InputError(finding.words(registered.cell, readings))


def examine(registered: Registration, readings: Readings) -> DescriptionFinding | None:
    """Return what is wrong with the description, by the registered nominal arm; or None."""
    finding = _examine(registered, readings)
    if finding is None and scatters_less_than_arms(registered, readings):
        none = np.zeros_like(registered.far)
        return DescriptionFinding(registered.rms, _gate(registered), (), none, too_exact=True)
    return finding


def _gate(registered: Registration) -> float:
    return max(GATE_M, GATE_REACH * registered.cell.arm.reach)


def _examine(registered: Registration, readings: Readings) -> DescriptionFinding | None:
    cell, gate = registered.cell, _gate(registered)
    # A known base shows the whole geometric error, however close the positions lie.
    extent = np.inf if cell.registration_known else _extent(readings.value[:, :3])
    far, rms, noise = registered.far, _size(registered.residual), noise_floor(readings.covariance)
    none, fitting_rms = np.zeros_like(far), _size(registered.residual[~far])
    if computed_from_joints(registered, readings):
        return DescriptionFinding(rms, gate, (), none, computed=True)
    if cell.observers:  # hypotheses are tried on positions in one frame only
        fits = not (far.any() or fitting_rms > gate)
        return None if fits else DescriptionFinding(fitting_rms, gate, (), far)
    if far.any():
        search = _DescriptionSearch(cell, readings, max(3.0 * noise, fitting_rms))
        shifted = search.shifted()
        if shifted:
            return DescriptionFinding(rms, gate, shifted, none, tried=search.tried)
        swapped = search.swapped(far)
        return DescriptionFinding(rms if swapped else fitting_rms, gate, (), far, swapped, tried=1)
    if rms <= min(SEARCH_SHARE * gate, max(GATE_EXTENT * extent, 5.0 * noise)):
        return None
    close = max(0.02 * min(extent, cell.arm.reach), rms / 50.0)
    search = _DescriptionSearch(cell, readings, max(3.0 * noise, min(0.25 * gate, close)))
    near, bad, _ = search.robust(())
    if bad.any() and (shifted := search.shifted()):
        return DescriptionFinding(rms, gate, shifted, none, tried=search.tried)
    few = bool(bad.any() and bad.mean() <= MOST_WRONG_ROWS)
    if few and near <= search.enough:
        return DescriptionFinding(rms, gate, (), bad, search.swapped(bad), tried=1)
    if apart := _far_apart(readings, search.enough):
        moved = _moved(cell, readings, gate)
        apart = None if moved else apart
        return DescriptionFinding(rms, gate, (), none, moved=moved, tried=1, apart=apart)
    alone: Combination = (Hypothesis("attitudes"),)
    in_attitudes = readings.m == 6 and search.score(alone) <= search.enough
    explanations = search.explain(gate, DEPTH if rms > gate and not in_attitudes else 1)
    if not explanations and rms > gate and readings.m == 6:
        explanations = search.explain(gate, DEPTH, alone)
    if not explanations and rms <= gate:
        return None
    if not explanations and (moved := _moved(cell, readings, gate)):
        return DescriptionFinding(rms, gate, (), none, moved=moved, tried=search.tried)
    if not explanations and few and near <= gate:
        return DescriptionFinding(rms, gate, (), bad, tried=search.tried)
    rows = search.robust(explanations[0].changes)[1] if explanations else none
    rows = rows if rows.mean() <= MOST_WRONG_ROWS else none
    return DescriptionFinding(rms, gate, explanations, rows, tried=search.tried)


def _far_apart(readings: Readings, least: float) -> tuple[int, int] | None:
    """Return two readings of one state, where most readings of such states are `least` m apart."""
    states = np.column_stack([angles(readings), readings.states.wrench, readings.target])
    state, count = np.unique(states, axis=0, return_inverse=True, return_counts=True)[1:]
    position, several = readings.value[:, :3], count[state] > 1
    mean = np.stack([np.bincount(state, x) for x in position.T], axis=1) / count[:, None]
    off = np.where(several, np.linalg.norm(position - mean[state], axis=1), 0.0)
    if not several.any() or np.median(off[several]) <= least / 2:
        return None
    i = int(np.argmax(off))
    distance = np.where(state == state[i], np.linalg.norm(position - position[i], axis=1), 0.0)
    return i, int(np.argmax(distance))


def _moved(cell: Cell, readings: Readings, gate: float) -> int:
    """Return the first reading from another place of the tracker, where two explain all; else 0.

    The first and the last third are registered separately; all rows before the returned one fit
    the first place, all others the second.
    """
    third, m6 = len(readings) // 3, readings.m == 6
    if cell.registration_known or third < FEWEST_BY_THEMSELVES:
        return 0
    try:
        parts = [register(cell, part) for part in (readings[:third], readings[-third:])]
    except CannotAnswerError:
        return 0
    data, off = FrameData.of(cell.arm, readings), []
    for part in parts:
        frames, _ = given_and_free(part.cell, m6)
        off.append(np.linalg.norm(data.misfit(frames) * _levers(readings.m), axis=1))
    later = off[1] < off[0]
    first = int(np.argmax(later))
    fits = float(np.sqrt(np.mean(np.minimum(*off) ** 2))) <= gate
    return first if fits and later[first:].all() and first > 0 else 0


class _DescriptionSearch:
    def __init__(self, cell: Cell, readings: Readings, enough: float) -> None:
        self._cell, self._readings = cell, readings
        self.enough, self.tried = enough, 0
        self._stated = Description(
            cell.arm,
            angles(readings),
            readings.value[:, :3],
            readings.value[:, 3:] if readings.m == 6 else None,
            not cell.registration_known,
            not all(cell.known_targets),
            conventions=None if cell.config is None else cell.config.robot,
        )
        # One of each of as many equal parts, at random: an equal spacing may follow a pattern of
        # the rows, and read of two reflectors in turn only the first.
        parts = np.arange(ROWS) + np.random.default_rng(0).random(ROWS)
        self._rows = np.unique((parts * len(readings) / ROWS).astype(int))
        flange = evaluate(cell.arm, self._stated.q).position[-1]
        self._extent = min(_extent(readings.value[:, :3]), _extent(flange))
        self.score = lru_cache(maxsize=None)(self._score)
        self.robust = lru_cache(maxsize=None)(self._robust)

    def explain(self, gate: float, most: int, begin: Combination = ()) -> tuple[Explanation, ...]:
        """Return the shortest combination that explains the readings, and those that do as well.

        All of them contain the hypotheses of `begin`.
        """
        base, slides = self.score(()), self._cell.arm.slides
        singles = tuple(hypotheses(self._described(begin)))
        beam: list[Combination] = [begin]
        tried: dict[Combination, float] = {begin: self.score(begin)} if begin else {}
        if begin and (explanations := self._enough(tried, base)):
            return explanations
        for depth in range(most):
            additions = [h for h in singles if depth == 0 or h.kind not in SEPARATE_FIRST]
            combinations = [
                (*partial, h)
                for partial in beam
                for h in additions
                if h.subject not in [g.subject for g in partial]
            ]
            for combination in pairs(self._cell.arm.n) if depth == 1 else ():
                if not any(h.offset and slides[h.joint - 1] for h in combination):
                    combinations.append(combination)
            rough = {w: self.score(w, True) for w in dict.fromkeys(map(_sorted, combinations))}
            best = sorted(rough, key=lambda w: (rough[w], _cost(w)))[:MOST_CAREFUL]
            scores = {**rough, **{w: self.score(w) for w in best}}
            if depth < 2 and min(scores.values()) > self.enough:
                scores.update(self._zeros(beam[:2]))
            tried.update(scores)
            explanations = self._enough(scores, base)
            if explanations:
                return explanations
            beam = sorted(scores, key=lambda w: (scores[w], _cost(w)))[: BEAM[min(depth, 1)]]
        if most > 1 and min(tried.values()) > self.enough:
            tried.update(self._all_zeros(begin))
        most_left = EXTENT_LEFT * self._extent
        return _explained(tried, min(gate, base / LEAST_IMPROVEMENT, most_left))

    def _all_zeros(self, begin: Combination) -> dict[Combination, float]:
        """Try constants near zero as the zeros of all joints that turn together.

        An unknown base has that of joint 1, an unknown target that of the last joint.
        """
        d, n = self._described(begin), self._cell.arm.n
        hidden = {h.joint for h in begin}
        hidden |= {
            joint for joint, unknown in ((1, d.base_unknown), (n, d.target_unknown)) if unknown
        }
        turning = [int(j) for j in np.flatnonzero(~self._cell.arm.slides) + 1 if j not in hidden]

        def zeroed(zeros: Floats, least: float = 0.0) -> Combination:
            pairs = zip(turning, zeros.tolist(), strict=True)
            noticeable = [(j, z) for j, z in pairs if abs(np.degrees(z)) >= least]
            return _sorted((*begin, *(Hypothesis("joint", j, 1, z) for j, z in noticeable)))

        def white(zeros: Floats) -> Floats:
            return self._best(*self._problem(zeroed(zeros), self._rows)).white.ravel()

        solution = scipy.optimize.least_squares(white, np.zeros(len(turning)), diff_step=[1e-5])
        combination = zeroed(solution.x, LEAST_ZERO_DEG)
        return {combination: self.score(combination)}

    def shifted(self) -> tuple[Explanation, ...]:
        """Return the shift of rows that explains the readings, where one does.

        Where a pose has many readings, only its last one is wrong, and looks like a gross error.
        """
        combinations: list[Combination] = [(h,) for h in shifts(len(self._readings))]
        tried = {combination: self.score(combination) for combination in combinations}
        return (
            _explained(tried, min(self.enough, self.score(()) / LEAST_IMPROVEMENT)) if tried else ()
        )

    def _enough(self, tried: dict[Combination, float], base: float) -> tuple[Explanation, ...]:
        """Those that explain the readings: the simplest of each kind, best first."""
        least = min(tried.values())
        if least > min(self.enough, base / LEAST_IMPROVEMENT):
            return ()
        alike = EQUALLY_GOOD * least + 1e-6
        # A hypothesis that can be left out without loss is undetermined, or was a wrong step.
        for combination in [w for w in tried if tried[w] <= alike]:
            for h in combination:
                shorter = tuple(g for g in combination if g != h)
                if shorter and shorter not in tried and self.score(shorter) <= alike:
                    tried = {**tried, shorter: self.score(shorter)}
        good = sorted((w for w in tried if tried[w] <= alike), key=lambda w: (_cost(w), tried[w]))
        out: dict[tuple[object, ...], Combination] = {}
        for combination in good:  # of those that differ by their zeros alone, one
            if _cost(combination) <= _cost(good[0]):
                out.setdefault(tuple((*h.subject, h.arm, h.sign) for h in combination), combination)
        return tuple(Explanation(w, tried[w]) for w in out.values())

    def _zeros(self, combinations: list[Combination]) -> dict[Combination, float]:
        """Try any constant as the zero of each joint, in addition to each of `combinations`."""
        out = {}
        for combination in combinations:
            counted = [h.joint for h in combination if h.kind == "joint"]
            for j in range(1, self._cell.arm.n + 1):
                if j in counted or self._cell.arm.slides[j - 1]:
                    continue
                zero, rms = self._zero_of(combination, j)
                if abs(np.degrees(zero)) > LEAST_ZERO_DEG:
                    out[_sorted((*combination, Hypothesis("joint", j, 1, zero)))] = rms
        return out

    def _zero_of(self, combination: Combination, joint: int) -> tuple[float, float]:
        """Return the best zero of one joint, rad, and the misfit with it, m."""

        def zeroed(zero: float) -> Combination:
            return (*combination, Hypothesis("joint", joint, 1, zero))

        def square(zero: float) -> float:
            return self._best(*self._problem(zeroed(zero), self._rows), rough=True).square

        begin = min(ZERO_STARTS, key=lambda zero: self.score(zeroed(zero), True))
        bounds = (begin - ZERO_WIDTH, begin + ZERO_WIDTH)
        minimum = scipy.optimize.minimize_scalar(
            square, bounds=bounds, method="bounded", options={"xatol": ZERO_EXACT}
        )
        count = int(np.count_nonzero(self._described(combination).paired[self._rows]))
        rms = float(np.sqrt(minimum.fun / count))
        return float(np.arctan2(np.sin(minimum.x), np.cos(minimum.x))), rms

    def _score(self, combination: Combination, rough: bool = False) -> float:
        """Misfit of the nominal arm under hypotheses, m, scaled to the extent as stated."""
        self.tried += 1
        placement = self._best(*self._problem(combination, self._rows), rough)
        size = float(np.sqrt(placement.square / len(placement.data)))
        return size * max(1.0, self._extent / max(_extent(placement.data.value), 1e-12))

    def _best(self, data: FrameData, frames: Frames, free: Bools, rough: bool = False) -> Placement:
        steps, rotated = (6, 0) if rough else (15, 2)
        return best_placement(data, frames, free, self.enough, steps, rotated)

    def _problem(self, combination: Combination, rows: Ints) -> tuple[FrameData, Frames, Bools]:
        """Flange poses and readings of some rows under some hypotheses, and what is estimated."""
        d = self._described(combination)
        rows = rows[d.paired[rows]]
        turn, m = (None, 3) if d.turn is None else (d.turn[rows], 6)
        root = np.broadcast_to(np.diag(_levers(m)), (len(rows), m, m))
        target = self._readings.target[rows]
        data = FrameData.at(d.arm, d.q[rows], d.value[rows], turn, root, target)
        cell = self._cell
        # Frames estimated with the wrong description are no start for another one.
        base = cell.registration if cell.registration_known else np.eye(4)
        stated = np.array(cell.known_targets)
        frames = Frames(base, np.where(stated[:, None, None], cell.all_targets, np.eye(4)))
        fixed = stated & (not d.target_unknown)
        axes = m == 6 and (d.base_unknown or not fixed.all())
        return data, frames, free_parameters(d.base_unknown, ~fixed, axes)

    def _described(self, combination: Combination) -> Description:
        return reduce(lambda d, h: h.applied(d), combination, self._stated)

    def _robust(self, combination: Combination) -> tuple[float, Bools, Placement]:
        """Register with weights by which rows that do not fit lose their influence.

        Rms of the rows that fit, m; (N,) those that do not; and the placement.
        """
        data, frames, free = self._problem(combination, np.arange(len(self._readings)))
        placement, scale = self._best(data, frames, free), np.inf
        for _ in range(12):
            distance = np.linalg.norm(placement.white, axis=1)
            scale = min(scale, max(float(np.median(distance)), self.enough / 10))
            weights = 1.0 / (1.0 + (distance / (2.0 * scale)) ** 2)
            weighted = replace(data, root=data.root * weights[:, None, None])
            frames = minimise(Placement(weighted, placement.frames, free), steps=5).frames
            placement = replace(placement, frames=frames)
        distance = np.linalg.norm(placement.white, axis=1)
        far = distance > 8.0 * max(float(np.median(distance)), self.enough / 10)
        everywhere = np.zeros(len(self._readings), dtype=bool)
        everywhere[self._described(combination).paired] = far
        return float(np.sqrt(np.mean(distance[~far] ** 2))), everywhere, placement

    def swapped(self, far: Bools) -> tuple[tuple[int, int], ...]:
        """Pairs of the rows that do not fit (N,) that fit with their readings exchanged."""
        near, _, placement = self.robust(())
        out = []
        for i, j in combinations(np.flatnonzero(far)[:30].tolist(), 2):
            pair, back = placement.data[np.array([i, j])], placement.data[np.array([j, i])]
            crossed = replace(pair, value=back.value, attitude=back.attitude)
            if _size(crossed.misfit(placement.frames)) <= 3.0 * max(self.enough, near):
                out.append((i, j))
        return tuple(out)


def _explained(tried: dict[Combination, float], most: float) -> tuple[Explanation, ...]:
    """Return the best of some trials where it leaves no more than `most`, m."""
    combination = min(tried, key=lambda w: tried[w])
    return (Explanation(combination, tried[combination]),) if tried[combination] <= most else ()


def _cost(combination: Combination) -> int:
    return sum(h.cost for h in combination)


def _sorted(combination: Combination) -> Combination:
    """Hypotheses about the arm come first, then those about joints, then couplings."""
    rank = {"arm": 0, "joint": 1, "coupling": 2}
    return tuple(
        sorted(combination, key=lambda h: (rank.get(h.kind, 3), *h.subject, h.sign, h.offset))
    )


def _levers(m: int) -> Floats:
    return np.repeat([1.0, LEVER], 3)[:m]


def _size(off: Floats) -> float:
    """Rms of misfits (N, m), attitudes with `LEVER`, m."""
    return float(np.sqrt(np.mean(np.sum((off * _levers(off.shape[1])) ** 2, axis=1))))


def _extent(positions: Floats) -> float:
    """Rms distance of positions (N, 3) from their mean, m."""
    return _size(positions - positions.mean(axis=0))


@dataclass(frozen=True, slots=True)
class OtherArm:
    """An arm of the catalogue that fits better than the described one."""

    name: str
    rms: float  # misfit of the described arm after registration, m
    rms_with: float  # misfit of this one, m

    def to_json(self) -> dict[str, object]:
        """Return its JSON."""
        return {"arm": self.name, "rms_m": self.rms, "rms_with_m": self.rms_with}


def other_arm(registered: Registration, readings: Readings) -> OtherArm | None:
    """Return the arm of the catalogue that fits far better than the registered one, if any."""
    cell = registered.cell
    if cell.observers or registered.rms <= BEYOND_NOISE * noise_floor(readings.covariance):
        return None
    robot = None if cell.config is None else cell.config.robot
    arms = (
        arm if robot is None else with_controller_conventions(arm, robot)
        for arm in other_arms(cell.arm)
    )
    sample = readings[np.unique(np.linspace(0, len(readings) - 1, ARM_ROWS).astype(int))]
    tried = [(_misfit_with(cell, arm, sample), arm) for arm in arms]
    least, arm = min(tried, key=lambda pair: pair[0], default=(np.inf, cell.arm))
    if least > OTHER_ARM_SHARE * registered.rms:
        return None
    remaining = _misfit_with(cell, arm, readings)
    better = remaining <= OTHER_ARM_SHARE * registered.rms
    return OtherArm(arm.name, registered.rms, remaining) if better else None


def other_arm_of(cell: Cell, readings: Readings) -> OtherArm | None:
    """Register the described arm, and return the one that fits better; see `other_arm`."""
    try:
        return other_arm(register(cell, readings), readings)
    except CannotAnswerError:
        return None


def _misfit_with(cell: Cell, arm: Arm, readings: Readings) -> float:
    """Rms misfit of the positions with another arm, from the frames of the described one, m."""
    data = FrameData.of(arm, readings)
    off = minimise(Placement(data, *given_and_free(cell, data.m == 6)), ARM_STEPS).misfit
    return _size(off[:, :3])
