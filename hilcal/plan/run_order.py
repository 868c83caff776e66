"""Plans of the same readings in different orders: short ones and random ones."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.plan import REFERENCE, UNLOADED, Plan
from hilcal.errors import CannotAnswerError
from hilcal.plan import tour
from hilcal.plan.blocks import Block, Stop, assembled, load_order
from hilcal.plan.confounding import Confounding, confounding
from hilcal.plan.ordering import Ordering
from hilcal.plan.passages import Passable, Ways, ways
from hilcal.plan.timing import Duration, Pace, pace, timeline
from hilcal.types import Floats

_MOVES = 30  # steps of a random walk per stop


@dataclass(slots=True)
class Maker:
    """Makes plans of the same readings.

    Attributes:
        cell: the cell.
        config: its loads, motion and acquisition.
        names: (P) names of the poses that are measured.
        q: (P + 1, n) joint angles of the reference and of these, rad.
        how: settings.
        rng: generator.
        stops: by load.
        ways: between the stops under each load.
        short: shortest order of the stops under each load, counted from 1.
    """

    cell: Cell
    config: CellConfig
    names: tuple[str, ...]
    q: Floats
    how: Ordering
    rng: np.random.Generator
    stops: dict[str, list[Stop]] = field(default_factory=dict)
    ways: dict[str, Ways] = field(default_factory=dict)
    short: dict[str, list[int]] = field(default_factory=dict)

    @property
    def pace(self) -> Pace:
        """Seconds of motions, readings and load changes."""
        return pace(self.config)

    @property
    def wrenches(self) -> Mapping[str, Floats]:
        """(6,) wrench at the load point by load, base axes, N and N·m."""
        return {load.name: load.wrench(self.cell.gravity) for load in self.config.loads}

    def prepare(self, stops: dict[str, list[Stop]], passable: Passable) -> None:
        """Find the ways and the shortest tour under each load."""
        self.stops = stops
        for load, here in stops.items():
            poses = np.array([s.pose for s in here])
            every = np.unique(poses)
            found = ways(self.q[[0, *every]], load, passable, self.pace)
            self.ways[load] = found.among(np.searchsorted(every, poses) + 1)
            self.short[load] = tour.shortest(self.ways[load].seconds, self.rng)
            way = [0, *self.short[load], 0]
            legs = self.ways[load].seconds[way[:-1], way[1:]]
            if legs.max() >= tour.NEVER:
                k = int(np.argmax(legs >= tour.NEVER))
                pose = self.names[here[max(way[k], way[k + 1]) - 1].pose - 1]
                raise CannotAnswerError(
                    f"pose {pose} is not reached from the reference pose along clear straight "
                    f"motions under {load}; leave it out or move the reference"
                )

    def shortest(self) -> Plan:
        """Return the plan of the shortest tours, all unloaded readings before the loads."""
        return self._plan(self.short, half=False, mixed=False)

    def _plan(self, orders: Mapping[str, Sequence[int]], *, half: bool, mixed: bool) -> Plan:
        """Return the plan for an order of the stops under each load.

        Args:
            orders: by load.
            half: whether the second half of the unloaded order comes after the loads.
            mixed: whether loops come in random order and direction.
        """
        loads = [load for load in self.stops if load != UNLOADED]
        free = list(orders.get(UNLOADED, ()))
        cut = (len(free) + 1) // 2 if half else len(free)
        before = self._block(UNLOADED, free[:cut], mixed)
        after = self._block(UNLOADED, free[cut:], mixed)
        loaded = [self._block(load, orders[load], mixed) for load in loads]
        turn = load_order(before, loaded, after, self.wrenches, self.pace)
        steps = assembled(self.names, before, [loaded[k] for k in turn], after)
        return Plan((REFERENCE, *self.names), self.q, steps)

    def draw(self, extra: float) -> Plan:
        """Return a random plan that takes about so many seconds longer than the shortest."""
        total = sum(len(here) for here in self.stops.values())
        half = self.how.unloaded == "around"
        orders = {}
        for load, short in self.short.items():
            seconds = self.ways[load].seconds
            spare = extra * len(short) / total
            if load != UNLOADED or not half or len(short) < 2:
                orders[load] = self._walk(seconds, short, spare)
                continue
            first = set(self.rng.permutation(short)[: (len(short) + 1) // 2].tolist())
            parts = [
                self._part(seconds, [k for k in short if (k in first) == own])
                for own in (True, False)
            ]
            now = [tour.length(seconds, part) for part in parts]
            if max(now) >= tour.NEVER:  # a pose was parted from the only one that leads to it
                half, orders[load] = False, self._walk(seconds, short, spare)
                continue
            spare -= sum(now) - tour.length(seconds, short)
            orders[load] = [k for part in parts for k in self._walk(seconds, part, spare / 2)]
        return self._plan(orders, half=half, mixed=True)

    def _part(self, seconds: Floats, part: list[int]) -> list[int]:
        """Return a short tour of some of the stops."""
        at = [0, *part]
        return [at[k] for k in tour.improved(seconds[np.ix_(at, at)], range(1, len(at)))]

    def _walk(self, seconds: Floats, order: Sequence[int], spare: float) -> list[int]:
        """Return a random tour of some stops, at most so many seconds longer than this one."""
        budget = tour.length(seconds, order) + max(spare, 0.0)
        at = [0, *order]
        grid = seconds[np.ix_(at, at)]
        moves = _MOVES * len(order)
        walked = tour.shaken(grid, range(1, len(at)), budget, self.rng, moves)
        return [at[k] for k in walked]

    def _block(self, load: str, order: Sequence[int], mixed: bool) -> Block:
        """Cut an order into loops; mixed ones come in random order and direction."""
        if not order:
            return Block(load, (), 0.0)
        direct, pace = self.ways[load].direct, self.pace
        parts = tour.loops(direct, order, pace.reading_s, self.how.reference_every_s)
        if parts is None:  # a pose that is reached by another one only, and takes too long
            parts = tour.loops(direct, order, pace.reading_s, np.inf)
        assert parts is not None  # noqa: S101 - every way of the order exists
        if mixed:
            parts = [parts[int(k)] for k in self.rng.permutation(len(parts))]
            back = self.rng.random(len(parts)) < 0.5
            parts = [
                p[::-1] if turn and tour.length(direct, p[::-1]) < tour.NEVER else p
                for p, turn in zip(parts, back, strict=True)
            ]
        seconds = sum(tour.length(direct, p) + pace.reading_s * (len(p) + 1) for p in parts)
        here = self.stops.get(load, [])
        stops = tuple(tuple(here[k - 1] for k in part) for part in parts)
        return Block(load, stops, seconds)

    def figures(self, plan: Plan) -> tuple[Duration, Confounding]:
        """Return duration and confounding of a plan."""
        margin = self.config.limits.joint_margin_rad
        time, times = timeline(plan, self.cell.arm, margin, self.pace)
        how = self.how
        return time, confounding(plan, times, self.wrenches, how.drift, how.reading_std)
