"""The way of the arm through a plan, and its dry run: every limit is checked, and nothing moves."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.clearance import TRACKER_UNKNOWN
from hilcal.measuring.feasibility import Feasibility
from hilcal.robot.arm import Arm
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.toml import suggest
from hilcal.types import Floats

APPROACH_RAD = 0.02
"""How far each joint goes at the start so that the side it arrives from is known, rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A point of the route where the arm comes to rest."""

    name: str
    q: Floats  # (n,) commanded joint angles, rad
    hanging: str  # name of the load under which the arm comes here
    change_to: str | None = None
    """Name of the load that is hung here; None where nothing is changed."""
    step: Step | None = None  # the reading that is taken here; None where none is


def home(plan: Plan) -> str:
    """Return the pose where loads are changed: "reference", or the first one without it."""
    return REFERENCE if REFERENCE in plan.pose_names else plan.pose_names[0]


def beside(q: Floats, arm: Arm, margin: float) -> Floats:
    """Return (n,) whence the arm comes to a reference pose, `margin` from its limits, rad."""
    side = np.where(q - APPROACH_RAD >= arm.q_min + margin, 1.0, -1.0)
    return np.asarray(q - side * APPROACH_RAD)


def route(plan: Plan, arm: Arm, margin: float = 0.0) -> tuple[Stop, ...]:
    """Return every stop for the steps of a plan.

    The first two stops, at a little distance from the reference pose and there, move every joint,
    so that the approach sides of all readings are known. Loads are changed there. A reading that
    repeats the one before it is approached anew.
    """
    base = home(plan)
    q_home = plan.joints(base)
    first = Stop(f"beside {base}", beside(q_home, arm, margin), UNLOADED)
    stops = [first, Stop(base, q_home, UNLOADED)]
    for step in plan.steps:
        last = stops[-1]
        hanging = last.hanging if last.change_to is None else last.change_to
        if step.load != hanging:
            stops.append(Stop(base, q_home, hanging, change_to=step.load))
        elif last.step is not None and last.step.pose == step.pose:
            away = (first.name, first.q) if step.pose == base else (base, q_home)
            stops.append(Stop(*away, hanging))
        stops.append(Stop(step.pose, plan.joints(step.pose), step.load, step=step))
    return tuple(stops)


def approach_sides(stops: Sequence[Stop]) -> Floats:
    """Return (S, n) from which side each joint arrives at the readings of a route, -1 or +1.

    It is the direction of the joint's last motion; 0 where it has not moved.
    """
    side, sides = np.zeros(len(stops[0].q)), []
    for before, stop in pairwise(stops):
        moved = np.sign(stop.q - before.q)
        side = np.where(moved == 0.0, side, moved)
        if stop.step is not None:
            sides.append(side)
    return np.array(sides)


def duration(start: Floats, end: Floats, speed: float, acceleration: float) -> float:
    """Return how long a motion takes whose leading joint has a trapezoid of speed, s.

    t = d/v + v/a where the speed v is reached, else 2 sqrt(d/a).
    """
    way = float(np.abs(end - start).max(initial=0.0))
    if way >= speed**2 / acceleration:
        return way / speed + speed / acceleration
    return 2.0 * float(np.sqrt(way / acceleration))


MEASURING_S = 1.0
"""How long one tracker measurement is taken to last, s; only for the estimate of time."""
AIMING_S = 2.0  # how long turning the tracker to another target is taken to last, s; a choice


@dataclass(frozen=True, slots=True)
class DryRun:
    """What a plan would do."""

    problems: tuple[str, ...]  # why it must not be run, one line each; empty where it may
    remarks: tuple[str, ...]  # what people should know of it
    duration: float  # how long it takes, roughly, cell seconds
    motions: int  # how often the arm moves
    load_changes: int  # how often a person is asked for another load

    @property
    def first(self) -> str:
        """The first problem, and how many others there are."""
        more = len(self.problems) - 1
        others = f" (and {more} more: hilcal check --plan shows all)" if more else ""
        return f"{self.problems[0]}{others}"


def dry_run(cell: Cell, config: CellConfig, plan: Plan) -> DryRun:
    """Check a plan against every limit of the cell; all problems at once.

    Checked are all stops of the route and the straight paths in joint space between them by
    `Feasibility`, the tracker's sight of the target at each reading, the speed, and the loads.
    """
    limits = Feasibility(cell, config)
    problems = _cell_problems(config) + _load_problems(limits, plan)
    width, n = plan.q.shape[1], cell.arm.n
    if width != n:
        wrong = f"the plan has {width} joint angles per pose; {cell.arm.name} has {n} joints"
        return DryRun((wrong, *problems), (), 0.0, 0, 0)
    stops = route(plan, cell.arm, config.limits.joint_margin_rad)
    problems += on_route(limits, stops)
    moves = [(a, b) for a, b in pairwise(stops) if not np.array_equal(a.q, b.q)]
    motion = config.motion
    pace = motion.speed_rad_s, motion.acceleration_rad_s2
    moving = sum(duration(a.q, b.q, *pace) for a, b in moves)
    changes = sum(stop.change_to is not None for stop in stops)
    return DryRun(
        tuple(dict.fromkeys(problems)),
        (*_remarks(plan, limits), *limits.remarks),
        moving
        + changes * config.planning.load_change_s
        + len(plan.steps) * seconds_at_rest(config),
        len(moves),
        changes,
    )


def _cell_problems(config: CellConfig) -> list[str]:
    out = [
        f'target "{t.name}" has no target_m: the tracker could not be pointed to it; give a rough '
        "place and estimate = true"
        for t in config.tool.targets
        if len(config.tool.targets) > 1 and t.target_m is None
    ]
    speed, limit = config.motion.speed_rad_s, config.limits.joint_speed_rad_s
    if speed <= limit:
        return out
    return [
        *out,
        f"[motion] speed_rad_s = {speed:g} is over [limits] joint_speed_rad_s = {limit:g}; "
        "the arm would be stopped in every motion",
    ]


def _load_problems(limits: Feasibility, plan: Plan) -> list[str]:
    """Names, payload, and what the sensor's force would be."""
    known = [load.name for load in limits.config.loads]
    out: list[str] = []
    for name in (UNLOADED, *plan.loads):
        if name in known or name == UNLOADED:
            out += limits.unbearable(name).values()
        else:
            valid = ", ".join((UNLOADED, *known))
            hint = suggest(name, known)
            out.append(f'load "{name}" is not in [[loads]] of the cell{hint}; valid: {valid}')
    return out


def route_problems(cell: Cell, config: CellConfig, stops: tuple[Stop, ...]) -> list[str]:
    """Return what is wrong with stops and with the paths between them, one line each."""
    return on_route(Feasibility(cell, config), stops)


def on_route(limits: Feasibility, stops: tuple[Stop, ...]) -> list[str]:
    """Return what is wrong with stops and the paths between them, one line each."""
    lines, at_stops = [], []
    for stop in stops:
        where, loads = f"pose {stop.name}", {stop.hanging: None, stop.change_to: None}
        found = [x for load in loads if load for x in limits.findings(stop.q[None], load)]
        at_stops.append({x.what for x in found})
        lines += [x.at(where) for x in found]
        if stop.step is not None and limits.sight is not None:
            lines += limits.sight.problems(stop.q[None], stop.step.load, where)
    for (a, b), (at_a, at_b) in zip(pairwise(stops), pairwise(at_stops), strict=True):
        if not np.array_equal(a.q, b.q):
            where = f"between {a.name} and {b.name}"
            on_way = limits.findings_between(a.q, b.q, b.hanging)
            lines += [x.at(where) for x in on_way if x.what not in at_a | at_b]
    return list(dict.fromkeys(lines))


def _remarks(plan: Plan, limits: Feasibility) -> list[str]:
    out = []
    tests = "purpose" in plan.about  # of a model: what it is compared with may be in another file
    unloaded = {(s.pose, s.cycle) for s in plan.steps if s.load == UNLOADED}
    lacking = [s for s in plan.steps if (s.pose, s.cycle) not in unloaded]
    if lacking and not tests and limits.config.fitted == "deflection":
        first = Step(lacking[0].pose, UNLOADED, lacking[0].cycle)
        out.append(
            f"{len(lacking)} loaded readings have no unloaded one of the same pose and cycle, "
            f'which a deflection needs; the first: "{first}"'
        )
    if REFERENCE not in plan.pose_names:
        out.append(
            f'no pose has the name "{REFERENCE}": loads are changed at {home(plan)}, and drift '
            "is not checked"
        )
    if limits.config.sight.target_normal is not None and limits.sight is None:
        out.append(TRACKER_UNKNOWN)
    return out


def seconds_at_rest(config: CellConfig) -> float:
    """Return how long the arm rests at a step for the readings of all targets, cell seconds."""
    acquire, targets = config.acquire, max(len(config.tool.targets), 1)
    once = 0.0 if config.force_sensor is None else acquire.force_window_s
    each = config.planning.reading_s
    if each is not None:
        return targets * each
    each = acquire.settle_s + acquire.samples * MEASURING_S + (targets > 1) * AIMING_S
    return targets * each + once


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
    limits = Feasibility(cell, config)
    for stop in reversed(behind):
        at = Stop(stop.name, stop.q, hanging)
        way.append(at)
        if np.array_equal(at.q, q_home) or not on_route(limits, (at, to)):
            break
    way = [*way[1:], to]
    returned = here.step is not None and (here.step.pose, here.step.load) == (base, UNLOADED)
    missing = [s for s in plan.steps if s not in done and (s.pose, s.load) == (base, UNLOADED)]
    if missing and not returned:
        way.append(Stop(base, q_home, UNLOADED, step=missing[0]))
    return tuple(way)
