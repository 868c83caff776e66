"""The route of the arm through a plan, and its dry run, which checks every limit without motion."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.clearance import TRACKER_UNKNOWN
from hilcal.measuring.feasibility import Feasibility
from hilcal.robot.arm import Arm
from hilcal.store.plan import (
    ARM,
    BY_HOME,
    KEYS,
    LEFT_OUT,
    REFERENCE,
    UNLOADED,
    Plan,
    Step,
    unknown_keys,
)
from hilcal.toml import suggest
from hilcal.types import Floats

APPROACH_RAD = 0.02
"""First motion of each joint, which determines its approach side, rad."""


@dataclass(frozen=True, slots=True, eq=False)
class Stop:
    """A point of the route where the arm comes to rest."""

    name: str
    q: Floats  # (n,) commanded joint angles, rad
    hanging: str  # name of the load during the motion to the stop
    change_to: str | None = None
    """Name of the load that is hung at the stop; None without a change."""
    step: Step | None = None  # the reading at the stop; None without


def approach_pose(q: Floats, arm: Arm, margin: float) -> Floats:
    """Return (n,) the stop before a reference pose, at least `margin` from the limits, rad."""
    side = np.where(q - APPROACH_RAD >= arm.q_min + margin, 1.0, -1.0)
    return np.asarray(q - side * APPROACH_RAD)


def route(plan: Plan, arm: Arm, margin: float = 0.0) -> tuple[Stop, ...]:
    """Return every stop for the steps of a plan.

    The first two stops, beside the reference pose and at it, move every joint, so that the approach
    sides of all readings are known. Loads are changed at the reference pose. A repeated reading is
    approached again. Steps that `Plan.about` lists are reached by the reference pose.
    """
    by_home = [Step(**step) for step in plan.about.get(BY_HOME, ())]
    base = plan.home
    q_home = plan.joints(base)
    first = Stop(f"beside {base}", approach_pose(q_home, arm, margin), UNLOADED)
    stops = [first, Stop(base, q_home, UNLOADED)]
    for step in plan.steps:
        last = stops[-1]
        hanging = last.hanging if last.change_to is None else last.change_to
        if step.load != hanging:
            stops.append(Stop(base, q_home, hanging, change_to=step.load))
        elif last.step is not None and (last.step.pose == step.pose or step in by_home):
            away = (first.name, first.q) if step.pose == base else (base, q_home)
            stops.append(Stop(*away, hanging))
        stops.append(Stop(step.pose, plan.joints(step.pose), step.load, step=step))
    return tuple(stops)


def approach_sides(stops: Sequence[Stop]) -> Floats:
    """Return the approach side (S, n) of each joint at the readings of a route, -1 or +1.

    It is the direction of the joint's last motion; 0 if the joint has not moved.
    """
    side, sides = np.zeros(len(stops[0].q)), []
    for previous, stop in pairwise(stops):
        moved = np.sign(stop.q - previous.q)
        side = np.where(moved == 0.0, side, moved)
        if stop.step is not None:
            sides.append(side)
    return np.array(sides)


def durations(start: Floats, end: Floats, speed: float, acceleration: float) -> Floats:
    """Return the durations (...) of motions with a trapezoidal speed of the leading joint, s.

    t = d/v + v/a if the speed v is reached, else 2 sqrt(d/a), between joint values (..., n).
    """
    way = np.abs(end - start).max(axis=-1, initial=0.0)
    cruising = way >= speed**2 / acceleration
    ramps = 2.0 * np.sqrt(way / acceleration)
    return np.asarray(np.where(cruising, way / speed + speed / acceleration, ramps))


def duration(start: Floats, end: Floats, speed: float, acceleration: float) -> float:
    """Return the duration of one motion, as `durations`."""
    return float(durations(start, end, speed, acceleration))


MEASURING_S = 1.0
"""Assumed duration of one tracker measurement, s, for estimates of time."""
AIMING_S = 2.0  # assumed time to aim the tracker at another target, s; a choice


@dataclass(frozen=True, slots=True)
class DryRun:
    """The result of a dry run."""

    problems: tuple[str, ...]  # why the plan must not be run, one line each; else empty
    remarks: tuple[str, ...]  # for people
    duration: float  # estimated, cell s
    motions: int  # number of motions
    load_changes: int  # number of load changes by a person

    @property
    def first_problem(self) -> str:
        """The first problem, and the number of others."""
        others = len(self.problems) - 1
        suffix = f" (and {others} more: hilcal check --plan shows all)" if others else ""
        return f"{self.problems[0]}{suffix}"


def dry_run(cell: Cell, plan: Plan) -> DryRun:
    """Check a plan against every limit of the cell; all problems at once.

    `Feasibility` checks all stops of the route and the straight paths in joint space between them.
    The tracker's sight of the target at each reading, the speed and the loads are checked, too.
    """
    config = cell.configured()
    limits = Feasibility(cell)
    problems = _cell_problems(config) + _load_problems(limits, plan)
    width, n, made_for = plan.q.shape[1], cell.arm.n, plan.about.get(ARM, cell.arm.name)
    if made_for != cell.arm.name:
        problems.insert(
            0,
            f"the plan was made for {made_for}, and the cell's arm is {cell.arm.name}: make one "
            f'with hilcal plan, or take "{ARM}" out of the file if it is meant for this arm, too',
        )
    if width != n:
        wrong = f"the plan has {width} joint angles per pose; {cell.arm.name} has {n} joints"
        return DryRun((wrong, *problems), (), 0.0, 0, 0)
    stops = route(plan, cell.arm, config.limits.joint_margin_rad)
    problems += route_problems(limits, stops)
    moves = [(a, b) for a, b in pairwise(stops) if not np.array_equal(a.q, b.q)]
    pace = config.motion.speed_rad_s, config.motion.acceleration_rad_s2
    changes = sum(stop.change_to is not None for stop in stops)
    seconds = sum(duration(a.q, b.q, *pace) for a, b in moves)
    seconds += changes * config.planning.load_change_s
    seconds += len(plan.steps) * seconds_at_rest(config)
    remarks = *_remarks(plan, limits), *limits.remarks
    return DryRun(tuple(dict.fromkeys(problems)), remarks, seconds, len(moves), changes)


def _cell_problems(config: CellConfig) -> list[str]:
    out = [
        f'target "{t.name}" has no target_m: the tracker could not be pointed to it; give a rough '
        "place and estimate = true"
        for t in config.tool.targets
        if len(config.tool.targets) > 1 and t.target_m is None
    ]
    speed, limit = config.motion.speed_rad_s, config.limits.joint_speed_rad_s
    if speed > limit:
        out.append(
            f"[motion] speed_rad_s = {speed:g} is over [limits] joint_speed_rad_s = {limit:g}; "
            "the arm would be stopped in every motion"
        )
    return out


def _load_problems(limits: Feasibility, plan: Plan) -> list[str]:
    names = [load.name for load in limits.config.loads]
    out: list[str] = []
    for name in (UNLOADED, *plan.loads):
        if name in names or name == UNLOADED:
            out += limits.unbearable(name).values()
        else:
            valid = ", ".join((UNLOADED, *names))
            hint = suggest(name, names)
            out.append(f'load "{name}" is not in [[loads]] of the cell{hint}; valid: {valid}')
    return out


def route_problems(limits: Feasibility, stops: tuple[Stop, ...]) -> list[str]:
    """Return the problems of stops and of the paths between them, one line each."""
    lines, at_stops = [], []
    for stop in stops:
        where, loads = f"pose {stop.name}", {stop.hanging: None, stop.change_to: None}
        violations = [x for load in loads if load for x in limits.findings(stop.q[None], load)]
        at_stops.append({x.key for x in violations})
        lines += [x.line(where) for x in violations]
        if stop.step is not None and limits.sight is not None:
            lines += limits.sight.problems(stop.q[None], stop.step.load, where)
    for (a, b), (at_a, at_b) in zip(pairwise(stops), pairwise(at_stops), strict=True):
        if not np.array_equal(a.q, b.q):
            where = f"between {a.name} and {b.name}"
            between = limits.findings_between(a.q, b.q, b.hanging)
            lines += [x.line(where) for x in between if x.key not in at_a | at_b]
    return list(dict.fromkeys(lines))


def _remarks(plan: Plan, limits: Feasibility) -> list[str]:
    out = []
    is_test = "purpose" in plan.about  # a test of a model, whose unloaded readings may be elsewhere
    unloaded = {(s.pose, s.cycle) for s in plan.steps if s.load == UNLOADED}
    unpaired = [s for s in plan.steps if (s.pose, s.cycle) not in unloaded]
    if unpaired and not is_test and limits.config.readings_mode == "deflection":
        first = Step(unpaired[0].pose, UNLOADED, unpaired[0].cycle)
        out.append(
            f"{len(unpaired)} loaded readings have no unloaded one of the same pose and cycle, "
            f'which a deflection needs; the first: "{first}"'
        )
    out += [
        f'"{key}" is no key of a plan{suggest(key, KEYS)}, and is ignored; valid: '
        f"{', '.join(KEYS)}, and names that begin with x_"
        for key in unknown_keys(plan)
    ]
    if REFERENCE not in plan.pose_names:
        out.append(
            f'no pose has the name "{REFERENCE}": loads are changed at {plan.home}, and drift '
            "is not checked"
        )
    elif plan.home in [x["point"] for x in plan.about.get(LEFT_OUT, ())]:
        out.append(
            f"{plan.home} is read no more, as the operator has left it out: from its last reading "
            "on nobody watches whether the tracker, the target or the arm drifts"
        )
    if limits.config.sight.target_normal is not None and limits.sight is None:
        out.append(TRACKER_UNKNOWN)
    return out


def seconds_at_rest(config: CellConfig) -> float:
    """Return the time of the arm at rest for the readings of one step, cell s."""
    acquire, targets = config.acquire, max(len(config.tool.targets), 1)
    if config.planning.reading_s is not None:
        return targets * config.planning.reading_s
    once = 0.0 if config.force_sensor is None else acquire.force_window_s
    per_target = acquire.settle_s + acquire.samples * MEASURING_S + (targets > 1) * AIMING_S
    return targets * per_target + once


def way_home(
    cell: Cell, plan: Plan, visited: Sequence[Stop], done: frozenset[Step]
) -> tuple[Stop, ...]:
    """Return the route to the reference pose, where the load is taken off and the drift is read.

    The arm moves straight if that is clear; else back along its route, which is clear, until the
    straight motion is. The reading is the plan's next return to the reference pose. `visited` are
    the stops of this session; the arm stands at the last one.
    """
    base = plan.home
    q_home, last = plan.joints(base), visited[-1]
    hanging = last.hanging if last.change_to is None else last.change_to
    destination = Stop(base, q_home, hanging, change_to=None if hanging == UNLOADED else UNLOADED)
    way: list[Stop] = []
    limits = Feasibility(cell)
    for stop in reversed(visited):
        candidate = Stop(stop.name, stop.q, hanging)
        way.append(candidate)
        at_home = np.array_equal(candidate.q, q_home)
        if at_home or not route_problems(limits, (candidate, destination)):
            break
    way = [*way[1:], destination]
    returned = last.step is not None and (last.step.pose, last.step.load) == (base, UNLOADED)
    missing = [s for s in plan.steps if s not in done and (s.pose, s.load) == (base, UNLOADED)]
    if missing and not returned:
        way.append(Stop(base, q_home, UNLOADED, step=missing[0]))
    return tuple(way)
