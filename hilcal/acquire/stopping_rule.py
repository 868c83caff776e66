"""A campaign that ends as soon as its goal is met: how far that is, and the way home."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from hilcal.acquire.dry_run import route_problems
from hilcal.acquire.progress import Remark, Watcher
from hilcal.acquire.route import Stop, home
from hilcal.acquire.store import Store
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.plan import UNLOADED, Plan, Step
from hilcal.data.readings import Readings


@dataclass(frozen=True, slots=True)
class Standing:
    """How far a campaign is from its goal.

    Attributes:
        met: whether it is met.
        words: the present value, e.g. "joint std 4.1 % (j6)"; empty where it is not known.
        figures: the same as JSON, for an event.
    """

    met: bool = False
    words: str = ""
    figures: dict[str, Any] = field(default_factory=dict)


class Rule(Protocol):
    """Judges the readings of a campaign by its goal."""

    def __call__(self, readings: Readings, last: bool) -> Standing:
        """Return how far the goal is.

        Args:
            readings: all of them so far.
            last: whether the plan has no others; else the answer may be one of a little before,
                so that judging does not hold up the campaign.
        """
        ...


class Aim:
    """The goal of a campaign while it is measured; none where there is no rule.

    Attributes:
        standing: how far it was when it was last looked at.
    """

    def __init__(
        self,
        rule: Rule | None,
        plan: Plan,
        store: Store,
        watcher: Watcher,
        event: Callable[[str, dict[str, Any]], None],
    ) -> None:
        """Look at nothing yet; `event` stores what became of it."""
        self.standing = Standing()
        self._rule, self._plan, self._store = rule, plan, store
        self._watcher, self._event = watcher, event

    def come_to_be_met(self, last: bool) -> bool:
        """Look how far it is; returns whether it has just been met.

        That is stored and told, and at the end of the plan that it is not.
        """
        if self._rule is None or self.standing.met:
            return False
        readings = self._store.readings()
        if readings is None:
            return False
        now = self.standing = self._rule(readings, last)
        count, planned = len(readings), len(self._plan.steps)
        if now.met or last:
            self._event("goal", {**now.figures, "readings": count, "planned": planned})
        if now.met:
            words = f"goal met: {now.words} after {count} of {planned} readings"
            self._watcher.tell(Remark(words))
        return now.met


def ending(
    cell: Cell, config: CellConfig, plan: Plan, behind: Sequence[Stop], done: frozenset[Step]
) -> tuple[Stop, ...]:
    """Return the way to the reference pose, where the load is taken off and the drift is read.

    The arm goes straight where that is clear; else back the way it came, which is, until it is
    clear from there. The reading is the next return to the reference pose that the plan holds.

    Args:
        cell: the cell.
        config: its limits.
        plan: the whole plan.
        behind: where the arm has been in this session, the reference pose among it; it stands
            at the last of these stops.
        done: steps that are measured.
    """
    base = home(plan)
    q_home, here = plan.joints(base), behind[-1]
    hanging = here.hanging if here.change_to is None else here.change_to
    to = Stop(base, q_home, hanging, change_to=None if hanging == UNLOADED else UNLOADED)
    way: list[Stop] = []
    for stop in reversed(behind):
        at = Stop(stop.name, stop.q, hanging)
        way.append(at)
        if np.array_equal(at.q, q_home) or not route_problems(cell, config, (at, to)):
            break
    way = [*way[1:], to]
    returned = here.step is not None and (here.step.pose, here.step.load) == (base, UNLOADED)
    missing = [s for s in plan.steps if s not in done and (s.pose, s.load) == (base, UNLOADED)]
    if missing and not returned:
        way.append(Stop(base, q_home, UNLOADED, step=missing[0]))
    return tuple(way)
