"""The order of chosen readings: short, and little correlated with drift.

The poses under one load are a block of loops from the reference, along straight motions that are
clear.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import InitVar, asdict, dataclass, field, replace
from itertools import pairwise, permutations
from typing import Literal

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design import tour
from hilcal.design.tour import NEVER
from hilcal.errors import CannotAnswerError
from hilcal.measuring.route import duration, durations, route, seconds_at_rest
from hilcal.robot.arm import Arm
from hilcal.store.plan import ARM, REFERENCE, UNLOADED, Plan, Step
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True)
class Pace:
    """Speeds of motions, and times of readings and load changes."""

    speed: float  # of the leading joint, rad/s
    acceleration: float  # of the leading joint, rad/s²
    reading_s: float  # time at rest for one step: the readings of all targets
    change_s: float  # time of a person for changing the load


@dataclass(frozen=True, slots=True)
class Duration:
    """Seconds of a campaign."""

    motion: float
    readings: float  # at rest
    load_changes: float  # by hand

    @property
    def total(self) -> float:
        """Total time, s."""
        return self.motion + self.readings + self.load_changes

    def about(self) -> dict[str, float]:
        """Return the durations for a plan's file, s."""
        split = {"total": self.total, **asdict(self)}
        return {key: round(value, 1) for key, value in split.items()}


def pace(config: CellConfig) -> Pace:
    """Return the pace of a cell, from [motion], [planning] and [acquire]."""
    motion, change = config.motion, config.planning.load_change_s
    return Pace(motion.speed_rad_s, motion.acceleration_rad_s2, seconds_at_rest(config), change)


def timeline(plan: Plan, arm: Arm, margin: float, pace: Pace) -> tuple[Duration, Floats]:
    """Return the duration of a plan and the middle (S,) of each step's reading, s."""
    motion = readings = changes = 0.0
    times = []
    for previous, stop in pairwise(route(plan, arm, margin)):
        motion += duration(previous.q, stop.q, pace.speed, pace.acceleration)
        if stop.change_to is not None:
            changes += pace.change_s
        if stop.step is not None:
            times.append(motion + readings + changes + pace.reading_s / 2)
            readings += pace.reading_s
    return Duration(motion, readings, changes), np.array(times)


_WRENCH = ("fx", "fy", "fz", "mx", "my", "mz")


@dataclass(frozen=True, slots=True)
class Confounding:
    """Confounding of time with the model's regressors, and the error of a linear drift.

    The lag of a deflection is the time from its unloaded to its loaded reading.
    """

    deflections: int  # outside of the reference pose; 0: lags below are times of readings
    # the largest |correlation| ρ of the lag with a regressor; ρ² is the share of information that a
    # parameter with this regressor loses if a drift is estimated, too
    correlation: float
    regressor: str  # e.g. "fz cos q3"
    lag_mean_s: float
    lag_rms_s: float  # root mean square
    drift: float  # rate of the assumed drift in one coordinate, m/s
    error_m: float  # RMS error of a deflection from that drift
    bias_m: float  # mean error
    drift_std: float | None  # of a rate estimated at the reference pose, m/s

    def about(self) -> dict[str, object]:
        """Return the figures for a plan's file."""
        rate = self.drift_std
        remaining = None if rate is None else rate * self.lag_rms_s
        return {
            "deflections": self.deflections, "correlation": round(self.correlation, 4),
            "correlated_with": self.regressor, "lag_mean_s": round(self.lag_mean_s, 1),
            "lag_rms_s": round(self.lag_rms_s, 1), "drift_m_per_h": 3600.0 * self.drift,
            "error_m": self.error_m, "bias_m": self.bias_m, "error_with_returns_m": remaining,
            "drift_std_m_per_h": None if rate is None else 3600.0 * rate,
        }  # fmt: skip


def confounding(
    plan: Plan,
    times: Floats,  # (S,) of the steps, s
    wrenches: Mapping[str, Floats],  # (6,) by load
    drift: float,
    reading_std: float,  # standard uncertainty of a reading in one coordinate, m
) -> Confounding:
    """Return how a plan's time is confounded with its joints and loads.

    A drift v moves a deflection by v τ, with the lag τ = t_loaded - t_unloaded. Regressors are the
    components of the load's wrench and their products with cos and sin of every joint. The
    correlation is uncentred, since a deflection has no constant term:

        ρ = |τᵀx| / (|τ| |x|)

    Estimating v, too, leaves a parameter with the column x a share 1 - ρ² of its information.
    Without deflections, ρ is the centred correlation of t with cos, sin and the wrench. A drift
    fitted to readings at the reference pose, with a mean for each load, has the variance σ²/Σ(t -
    t̄)².
    """
    time_of = dict(zip(plan.steps, times.tolist(), strict=True))
    unloaded = {(s.pose, s.cycle): t for s, t in time_of.items() if s.load == UNLOADED}
    measured = [s for s in plan.steps if s.pose != REFERENCE]
    pairs = [s for s in measured if s.load != UNLOADED and (s.pose, s.cycle) in unloaded]
    rows = pairs or measured
    lag = np.array([time_of[s] - (unloaded[s.pose, s.cycle] if pairs else 0.0) for s in rows])
    q = np.array([plan.joints(s.pose) for s in rows]).reshape(len(rows), plan.q.shape[1])
    wrench = np.array([wrenches[s.load] if s.load != UNLOADED else np.zeros(6) for s in rows])
    slope = _slope_std(plan, times, reading_std)
    names, columns = _regressors(q, wrench.reshape(-1, 6), product=bool(pairs))
    if not rows or not names:
        return Confounding(0, 0.0, "", 0.0, 0.0, drift, 0.0, 0.0, slope)
    if not pairs:
        lag, columns = lag - lag.mean(), columns - columns.mean(axis=0)
    size = np.linalg.norm(lag) * np.linalg.norm(columns, axis=0)
    floor = 1e-12 * np.linalg.norm(lag) * np.sqrt(len(lag))
    rho = np.abs(lag @ columns) / np.where(size > floor, size, np.inf)
    worst, mean, rms = int(np.argmax(rho)), float(lag.mean()), float(np.sqrt(np.mean(lag**2)))
    most, error, bias = float(rho[worst]), drift * rms, drift * mean
    return Confounding(len(pairs), most, names[worst], mean, rms, drift, error, bias, slope)


def _regressors(q: Floats, wrench: Floats, *, product: bool) -> tuple[list[str], Floats]:
    """Return names and columns (N, k); with `product`, cos and sin multiply the wrench."""
    turns = (("cos", np.cos), ("sin", np.sin))
    turned = [(f"{w} q{j + 1}", f(q[:, j])) for w, f in turns for j in range(q.shape[1])]
    live = np.flatnonzero(np.any(wrench != 0, axis=0)).tolist()
    out = [(_WRENCH[k], wrench[:, k]) for k in live]
    if product:
        out += [(f"{_WRENCH[k]} {name}", wrench[:, k] * x) for k in live for name, x in turned]
    else:
        out += turned
    return [name for name, _ in out], np.array([x for _, x in out]).reshape(len(out), -1).T


def _slope_std(plan: Plan, times: Floats, reading_std: float) -> float | None:
    """Return the standard uncertainty, m/s, of a drift from readings at the reference pose."""
    by_load: dict[str, list[float]] = {}
    for s, t in zip(plan.steps, times.tolist(), strict=True):
        if s.pose == REFERENCE:
            by_load.setdefault(s.load, []).append(t)
    moment = sum(len(load_times) * float(np.var(load_times)) for load_times in by_load.values())
    return reading_std / float(np.sqrt(moment)) if moment > 0 else None


_SHRINK = 0.75  # factor on the additional time after a draw that is too long; a choice
_TRIES = 10  # draws of one order at most, until it is short enough; a choice
_MOVES = 30  # steps of a random walk per stop; a choice
Passable = Callable[[Floats, Floats, str], Bools]  # start (n,), ends (M, n), load -> (M,)
N_NEIGHBOURS = 24  # nearest poses with tested motions; to others via the reference; a choice
_ALL = 6  # number of loads up to which every order is tried


PlannedStop = tuple[int, int]  # a reading: pose, from 1 (0 is the reference), and cycle


@dataclass(frozen=True, slots=True)
class LoadBlock:
    """The readings under one load."""

    load: str
    loops: tuple[tuple[PlannedStop, ...], ...]  # stops of each loop from the reference
    seconds: float  # of all loops

    def __len__(self) -> int:
        """Return the number of stops."""
        return sum(map(len, self.loops))


@dataclass(frozen=True, slots=True)
class PoseReadings:
    """Readings to take at a pose."""

    pose: str
    loads: tuple[str, ...]  # "none" for an unloaded reading
    cycles: int = 1


@dataclass(frozen=True, slots=True)
class Ordering:
    """Options of the order."""

    # additional time of a random order as a share of the shortest; 0: the shortest order. With 40
    # poses and four loads, ρ falls from 0.64 to 0.14 for 2 %, and no further for 30 %.
    slack: float = 0.05
    # "around": half of the unloaded readings before the loads and half after; "first": all before,
    # so that deflections are available during the loads
    unloaded: Literal["around", "first"] = "around"
    reference_every_s: float = 900.0  # longest time between two readings at the reference pose
    repeats: int = 2  # poses with a second unloaded reading, for the arm's repeatability
    draws: int = 16  # random orders, of which the least confounded is chosen
    # assumed rate of drift in one coordinate, m/s. No figure holds for all cells; 20 µm/h is a
    # tenth of the ordinary drift of the effect `tracker_drift` in a campaign of an hour.
    drift: float = 20e-6 / 3600
    reading_std: float = 15e-6  # standard uncertainty of a reading in one coordinate, m


@dataclass(frozen=True, slots=True, eq=False)
class Ordered:
    """A plan, with duration and confounding of its order."""

    plan: Plan  # its `about` holds these figures, too
    duration: Duration
    shortest: Duration  # of the shortest order of the same readings
    confounding: Confounding
    confounding_shortest: Confounding  # of the shortest order

    @property
    def longer(self) -> float:
        """Share of time lost to the random order."""
        return self.duration.total / self.shortest.total - 1.0


def order_plan(
    cell: Cell,
    names: Sequence[str],  # (P) names of poses
    q: Floats,  # (P, n) their joint angles, rad
    reference: Floats,  # (n,) joint angles of the reference pose, rad
    chosen: Sequence[PoseReadings],
    passable: Passable,
    rng: np.random.Generator,
    ordering: Ordering | None = None,
) -> Ordered:
    """Put chosen readings in order.

    Every load is hung once. Under a load, the arm follows a short tour in the metric of the leading
    joint's time. The tour is cut into loops from the reference pose, which limits the time between
    readings there. Where no straight motion is clear, the arm moves via the reference pose and is
    read there.

    Readings of a pose under different loads are far apart in time, so that a drift resembles the
    effect of a load, or of a pose. The loss of information is ρ², see `Confounding`. It is reduced
    by
    - half of the unloaded readings, drawn at random, after the loads: lags of both signs;
    - the order of loads that is least correlated with time;
    - random orders that take at most 1 + slack times the shortest; of several draws, the one with
      the least ρ (rerandomisation, Morgan & Rubin 2012, Ann. Statist. 40, 1263), which is still
      random with respect to other variables, such as temperatures.
    """
    ordering = ordering or Ordering()
    used = [name for name in names if any(c.pose == name for c in chosen)]
    indices = np.array([names.index(name) for name in used])
    poses, stops = np.vstack([reference, q[indices]]), stops_of(used, chosen, ordering.repeats, rng)
    draws = OrderDraws(cell, tuple(used), poses, ordering, rng, stops, passable)
    shortest = draws.plan(draws.short_tours, half=False, mixed=False)
    shortest_time, shortest_loss = draws.duration_and_confounding(shortest)
    best = (shortest_loss.correlation, shortest, shortest_time, shortest_loss)
    allowance = ordering.slack * shortest_time.total
    for _ in range(ordering.draws if ordering.slack > 0 else 0):
        extra = allowance * rng.random()
        for _ in range(_TRIES):
            plan = draws.draw(extra)
            time, loss = draws.duration_and_confounding(plan)
            if time.total <= shortest_time.total + allowance:
                if loss.correlation < best[0]:
                    best = loss.correlation, plan, time, loss
                break
            extra *= _SHRINK
    _, plan, time, loss = best
    about: dict[str, object] = {
        ARM: cell.arm.name,
        "duration_s": time.about(),
        "order": {
            **loss.about(),
            "reference_every_s": ordering.reference_every_s,
            "shortest_s": round(shortest_time.total, 1),
            "longer": round(time.total / shortest_time.total - 1.0, 4),
            "correlation_shortest": round(shortest_loss.correlation, 4),
        },
    }
    return Ordered(replace(plan, about=about), time, shortest_time, loss, shortest_loss)


def stops_of(
    used: Sequence[str], chosen: Sequence[PoseReadings], repeats: int, rng: np.random.Generator
) -> dict[str, list[PlannedStop]]:
    """Return the stops by load; each visit gets the first cycle without any of its loads."""
    cycles_of: dict[tuple[int, str], set[int]] = {}
    for c in chosen:
        pose = used.index(c.pose) + 1
        for _ in range(c.cycles):
            used_cycles = [cycles_of.setdefault((pose, load), set()) for load in c.loads]
            cycle = next(k for k in range(10**9) if not any(k in cycles for cycles in used_cycles))
            for cycles in used_cycles:
                cycles.add(cycle)
    single = [p for (p, load), cycles in cycles_of.items() if load == UNLOADED and len(cycles) == 1]
    repeated = sum(load == UNLOADED and len(cycles) > 1 for (_, load), cycles in cycles_of.items())
    added = min(max(repeats - repeated, 0), len(single))
    for pose in rng.choice(single, added, replace=False) if added else ():
        of_pose = [cycles for (p, _), cycles in cycles_of.items() if p == pose]
        cycles_of[int(pose), UNLOADED].add(max(max(cycles) for cycles in of_pose) + 1)
    out: dict[str, list[PlannedStop]] = {}
    for (pose, load), cycles in cycles_of.items():
        out.setdefault(load, []).extend((pose, cycle) for cycle in sorted(cycles))
    return out


@dataclass
class OrderDraws:
    """Plans of the same readings in different orders: short ones and random ones."""

    cell: Cell
    names: tuple[str, ...]  # (P) names of the poses
    q: Floats  # (P + 1, n) joint angles of the reference and of the poses, rad
    ordering: Ordering
    rng: np.random.Generator
    stops: dict[str, list[PlannedStop]]  # by load
    passable: InitVar[Passable]
    # by load, between the reference and the stops: see `motion_times`
    direct: dict[str, Floats] = field(default_factory=dict)
    seconds: dict[str, Floats] = field(default_factory=dict)
    # by load, shortest tours of stops, from 1
    short_tours: dict[str, list[int]] = field(default_factory=dict)

    def __post_init__(self, passable: Passable) -> None:
        """Find the ways and the shortest tour under each load."""
        config = self.cell.configured()
        self.pace = pace(config)
        self.wrenches = {load.name: load.wrench(self.cell.gravity) for load in config.loads}
        for load, load_stops in self.stops.items():
            poses = np.array([pose for pose, _ in load_stops])
            visited = np.unique(poses)
            between = motion_times(self.q[[0, *visited]], load, passable, self.pace)
            # between two stops at one pose, the arm moves via the reference, to arrive again
            place = np.concatenate([[0], np.searchsorted(visited, poses) + 1])
            self.direct[load], seconds = (way[np.ix_(place, place)] for way in between)
            self.seconds[load], self.short_tours[load] = seconds, tour.short_tour(seconds, self.rng)
            order = [0, *self.short_tours[load], 0]
            legs = seconds[order[:-1], order[1:]]
            if legs.max() >= tour.NEVER:
                k = int(np.argmax(legs >= tour.NEVER))
                pose = self.names[load_stops[max(order[k], order[k + 1]) - 1][0] - 1]
                raise CannotAnswerError(
                    f"pose {pose} is not reached from the reference pose along clear straight "
                    f"motions under {load}; leave it out or move the reference"
                )

    def plan(self, orders: Mapping[str, Sequence[int]], *, half: bool, mixed: bool) -> Plan:
        """Return the plan for an order of the stops.

        With `half`, half of the unloaded readings come after the loads; `mixed` loops are random.
        """
        loads = [load for load in self.stops if load != UNLOADED]
        free = list(orders.get(UNLOADED, ()))
        cut = (len(free) + 1) // 2 if half else len(free)
        before = self._block(UNLOADED, free[:cut], mixed)
        after = self._block(UNLOADED, free[cut:], mixed)
        loaded = [self._block(load, orders[load], mixed) for load in loads]
        order = load_order(before, loaded, after, self.wrenches, self.pace)
        steps = steps_of(self.names, before, [loaded[k] for k in order], after)
        return Plan((REFERENCE, *self.names), self.q, steps)

    def draw(self, extra: float) -> Plan:
        """Return a random plan that takes about `extra` s longer than the shortest."""
        total = sum(len(load_stops) for load_stops in self.stops.values())
        half = self.ordering.unloaded == "around"
        orders = {}
        for load, short in self.short_tours.items():
            seconds = self.seconds[load]
            spare = extra * len(short) / total
            if load != UNLOADED or not half or len(short) < 2:
                orders[load] = self._walk(seconds, short, spare)
                continue
            first = set(self.rng.permutation(short)[: (len(short) + 1) // 2].tolist())
            halves = ([k for k in short if (k in first) == before] for before in (True, False))
            parts = [tour.improved_tour(seconds, half_of) for half_of in halves]
            lengths = [tour.length(seconds, part) for part in parts]
            if max(lengths) >= tour.NEVER:  # a pose is reached only from poses of the other half
                half, orders[load] = False, self._walk(seconds, short, spare)
                continue
            spare -= sum(lengths) - tour.length(seconds, short)
            orders[load] = [k for part in parts for k in self._walk(seconds, part, spare / 2)]
        return self.plan(orders, half=half, mixed=True)

    def _walk(self, seconds: Floats, order: Sequence[int], spare: float) -> list[int]:
        """Return a random tour of some stops, at most `spare` s longer than `order`."""
        budget = tour.length(seconds, order) + max(spare, 0.0)
        return tour.random_tour(seconds, order, budget, self.rng, _MOVES * len(order))

    def _block(self, load: str, order: Sequence[int], mixed: bool) -> LoadBlock:
        """Cut an order into loops; `mixed` loops are in random order and direction."""
        if not order:
            return LoadBlock(load, (), 0.0)
        direct, pace = self.direct[load], self.pace
        parts = tour.loops(direct, order, pace.reading_s, self.ordering.reference_every_s)
        if parts is None:  # the loop of a pose without a direct way takes too long
            parts = tour.loops(direct, order, pace.reading_s, np.inf)
        assert parts is not None  # noqa: S101 - every way of the order exists
        if mixed:
            parts = [parts[int(k)] for k in self.rng.permutation(len(parts))]
            reversals = self.rng.random(len(parts)) < 0.5
            parts = [
                p[::-1] if reverse and tour.length(direct, p[::-1]) < tour.NEVER else p
                for p, reverse in zip(parts, reversals, strict=True)
            ]
        seconds = sum(tour.length(direct, p) + pace.reading_s * (len(p) + 1) for p in parts)
        load_stops = self.stops.get(load, [])
        stops = tuple(tuple(load_stops[k - 1] for k in part) for part in parts)
        return LoadBlock(load, stops, seconds)

    def duration_and_confounding(self, plan: Plan) -> tuple[Duration, Confounding]:
        """Return duration and confounding of a plan."""
        margin, how = self.cell.configured().limits.joint_margin_rad, self.ordering
        time, times = timeline(plan, self.cell.arm, margin, self.pace)
        return time, confounding(plan, times, self.wrenches, how.drift, how.reading_std)


def motion_times(q: Floats, load: str, passable: Passable, pace: Pace) -> tuple[Floats, Floats]:
    """Return times (P + 1, P + 1) between poses (P + 1, n) under a load, the reference first, s.

    First of straight motions, `NEVER` if not known to be clear; second the shorter of these and of
    the motion via the reference with a reading there.
    """
    legs = durations(q[:, None], q, pace.speed, pace.acceleration)
    count = len(q)
    close = np.argsort(legs, axis=1, kind="stable")[:, : N_NEIGHBOURS + 1]
    tested = np.zeros((count, count), dtype=np.bool_)
    tested[np.arange(count)[:, None], close] = True
    tested |= tested.T
    tested[0] = tested[:, 0] = True
    np.fill_diagonal(tested, False)
    direct = np.full((count, count), NEVER)
    for k in range(count):
        ends = np.flatnonzero(tested[k])
        if len(ends):
            clear = ends[passable(q[k], q[ends], load)]
            direct[k, clear] = legs[k, clear]
    around = direct[:, :1] + pace.reading_s + direct[:1]
    return direct, np.minimum(np.minimum(direct, around), NEVER)


def load_order(
    before: LoadBlock, loaded: Sequence[LoadBlock], after: LoadBlock,
    wrenches: Mapping[str, Floats], pace: Pace,
) -> list[int]:  # fmt: skip
    """Return the order of the loads whose wrenches are least correlated with their lags.

    It minimises the largest |Σ n w_k (t - t0)| / (|w_k| |t - t0|) of the wrench components k, with
    t_l the middle of the time of load l, n_l its number of readings, t0 the mean time of the
    unloaded readings, and norms weighted by n.
    """
    count = len(loaded)
    if count < 2:
        return list(range(count))
    span = np.array([pace.change_s + block.seconds for block in loaded])
    n = np.array([float(len(block)) for block in loaded])
    w = np.array([wrenches[block.load] for block in loaded])
    w = w[:, np.any(w != 0, axis=0)]
    if count <= _ALL:
        tries = np.array(list(permutations(range(count))))
    else:
        rng = np.random.default_rng(0)
        tries = np.array([np.arange(count), *(rng.permutation(count) for _ in range(2000))])
    end = before.seconds + np.cumsum(span[tries], axis=1)
    middle = end - span[tries] / 2
    free = len(before) * before.seconds / 2
    free += len(after) * (before.seconds + span.sum() + pace.change_s + after.seconds / 2)
    lag = middle - free / max(len(before) + len(after), 1)
    top = np.abs(np.einsum("tl,tlk->tk", n[tries] * lag, w[tries]))
    norm = np.sqrt(np.einsum("tl,tl->t", n[tries], lag**2))[:, None]
    norm = norm * np.sqrt(np.einsum("l,lk->k", n, w**2))
    worst = (top / norm).max(axis=1)
    return [int(k) for k in tries[int(np.argmin(np.round(worst, 9)))]]


def steps_of(
    names: Sequence[str], before: LoadBlock, loaded: Sequence[LoadBlock], after: LoadBlock
) -> tuple[Step, ...]:
    """Return the steps of the blocks, with a reading at the reference before and after every loop.

    Its unloaded readings are cycles 0, 1, ...; readings under a load share these cycles.
    """
    passes = max([len(block.loops) + 1 for block in loaded], default=0)
    returns = max(passes, 1 + len(before.loops) + len(after.loops) + bool(loaded))
    steps: list[Step] = []

    def read(block: LoadBlock, cycles: Iterator[int]) -> None:
        for loop in block.loops:
            steps.extend(Step(names[pose - 1], block.load, cycle) for pose, cycle in loop)
            steps.append(Step(REFERENCE, block.load, next(cycles)))

    free_cycles = iter(range(returns))
    steps.append(Step(REFERENCE, UNLOADED, next(free_cycles)))
    read(before, free_cycles)
    for block in loaded:
        share = np.round(np.linspace(0, returns - 1, len(block.loops) + 1)).astype(int).tolist()
        steps.append(Step(REFERENCE, block.load, share[0]))
        read(block, iter(share[1:]))
    if loaded:
        steps.append(Step(REFERENCE, UNLOADED, next(free_cycles)))
    read(after, free_cycles)
    return (*steps, *(Step(REFERENCE, UNLOADED, k) for k in free_cycles))
