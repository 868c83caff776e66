"""Ending a campaign as soon as its goal is met: the status of the goal, and the way home."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.progress import GoalMet, GoalStatus, Watcher
from hilcal.measuring.route import Stop, home, route_problems
from hilcal.readings.readings import Readings
from hilcal.store.plan import UNLOADED, Plan, Step
from hilcal.store.run_log import RunLog

StoppingRule = Callable[[Readings, bool], GoalStatus]
"""Tells from all readings so far how far the goal is. Unless it is told that the plan has no more,
the answer may be that of a few readings before, so that judging does not delay the campaign."""


class GoalCheck:
    """Applies a stopping rule after each reading; does nothing where there is none."""

    def __init__(
        self,
        rule: StoppingRule | None,
        plan: Plan,
        store: RunLog,
        watcher: Watcher,
        event: Callable[[str, dict[str, Any]], None],
    ) -> None:
        """Check nothing yet; `event` stores the result in the campaign."""
        self.status: GoalStatus | None = None
        self._rule, self._plan, self._store = rule, plan, store
        self._watcher, self._event = watcher, event

    def newly_met(self, last: bool) -> bool:
        """Apply the rule; whether the goal has just been met, which is stored and reported."""
        if self._rule is None or (self.status is not None and self.status.met):
            return False
        readings = self._store.readings()
        if readings is None:
            return False
        now = self.status = self._rule(readings, last)
        count, planned = len(readings), len(self._plan.steps)
        if now.met or last:
            self._event("goal", {**now.to_dict(), "readings": count, "planned": planned})
        if now.met:
            self._watcher.notify(GoalMet(now, count, planned))
        return now.met


def way_home(
    cell: Cell, config: CellConfig, plan: Plan, behind: Sequence[Stop], done: frozenset[Step]
) -> tuple[Stop, ...]:
    """Return the way to the reference pose, where the load is taken off and the drift is read.

    The arm goes straight where that is clear; else back the way it came, which is clear, until the
    straight way is. The reading is the next return to the reference pose that the plan holds.
    `behind` is where the arm has been in this session; it stands at the last of these stops.
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
