"""Dry run of a plan: every limit is checked, and nothing moves."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.acquire import workspace
from hilcal.acquire.clearance import Clearance, clearance_of
from hilcal.acquire.route import Stop, duration, home, route
from hilcal.acquire.sight import UNKNOWN, LineOfSight, sight_of
from hilcal.cell import Cell, tracker_place
from hilcal.config import CellConfig
from hilcal.data.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.robot import chain as chains
from hilcal.robot import se3
from hilcal.robot.body import is_known
from hilcal.robot.statics import Load, slot_wrenches
from hilcal.toml import suggest
from hilcal.types import Floats

PATH_STEP_RAD = 0.02
"""Distance of the points at which a path is checked, rad of the leading joint."""
MEASURING_S = 1.0
"""How long one tracker measurement is taken to last, s; only for the estimate of time."""
AIMING_S = 2.0
"""How long turning the tracker to another target is taken to last, s; a choice."""
_ROUNDING = 1e-9


@dataclass(frozen=True, slots=True)
class DryRun:
    """What a plan would do.

    Attributes:
        problems: why it must not be run, one line each; empty where it may.
        remarks: what people should know of it.
        duration: how long it takes, roughly, cell seconds.
        motions: how often the arm moves.
        load_changes: how often a person is asked for another load.
    """

    problems: tuple[str, ...]
    remarks: tuple[str, ...]
    duration: float
    motions: int
    load_changes: int


def dry_run(cell: Cell, config: CellConfig, plan: Plan) -> DryRun:
    """Check a plan against every limit of the cell; all problems at once.

    Checked are joints, poses, the straight path in joint space between all stops of the route,
    torques and the force sensor under each load, payload, speed, collisions of arm, obstacles
    and what hangs from the load point, the tracker's sight of the target at each reading, and
    the names of the loads.

    Args:
        cell: the cell.
        config: its limits, loads and motion.
        plan: poses and steps.
    """
    problems = _cell_problems(config) + _load_problems(cell, config, plan)
    width, n = plan.q.shape[1], cell.arm.n
    if width != n:
        wrong = f"the plan has {width} joint angles per pose; {cell.arm.name} has {n} joints"
        return DryRun((wrong, *problems), (), 0.0, 0, 0)
    stops = route(plan, cell.arm, config.limits.joint_margin_rad)
    problems += route_problems(cell, config, stops)
    moves = [(a, b) for a, b in pairwise(stops) if not np.array_equal(a.q, b.q)]
    changes = sum(stop.change_to is not None for stop in stops)
    return DryRun(
        tuple(dict.fromkeys(problems)),
        (*_remarks(plan), *_unchecked(cell, config)),
        _duration(config, stops, changes, len(plan.steps)),
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


def _load_problems(cell: Cell, config: CellConfig, plan: Plan) -> list[str]:
    """Names, payload, and what the sensor's force would be."""
    known = {load.name: load for load in config.loads}
    sensor = config.force_sensor
    weight = cell.tool_mass * cell.gravity
    out = []
    for name in plan.loads:
        if name == UNLOADED:
            continue
        if name not in known:
            hint = suggest(name, list(known))
            valid = ", ".join((UNLOADED, *known))
            out.append(f'load "{name}" is not in [[loads]] of the cell{hint}; valid: {valid}')
            continue
        load = known[name]
        mass = cell.tool_mass + load.mass_kg
        if mass > cell.arm.payload + _ROUNDING:
            out.append(
                f'load "{name}": tool and load are {mass:.4g} kg; the payload of '
                f"{cell.arm.name} is {cell.arm.payload:g} kg"
            )
        force = float(np.linalg.norm(load.wrench(cell.gravity)[:3] + weight))
        if sensor is not None and force > sensor.max_force_N:
            out.append(
                f'load "{name}": tool and load pull with {force:.4g} N; [force_sensor] '
                f"max_force_N is {sensor.max_force_N:g}"
            )
    if cell.tool_mass > cell.arm.payload + _ROUNDING:
        out.append(
            f"the tool is {cell.tool_mass:.4g} kg; the payload of {cell.arm.name} is "
            f"{cell.arm.payload:g} kg"
        )
    return out


def route_problems(cell: Cell, config: CellConfig, stops: tuple[Stop, ...]) -> list[str]:
    """Return what is wrong with stops and with the paths between them, one line each."""
    out = {}
    shapes = clearance_of(cell, config)
    sight = sight_of(shapes)
    here = [_at_stop(shapes, sight, stop) for stop in stops]
    for found in here:
        out.update(found)
    for (a, b), (at_a, at_b) in zip(pairwise(stops), pairwise(here), strict=True):
        known = {kind for kind, *_ in (*at_a, *at_b)}
        for (kind, *rest), line in _on_path(shapes, a, b).items():
            if kind not in known:
                out[kind, *rest] = line
    return list(dict.fromkeys(out.values()))


_Problems = dict[tuple[str, ...], str]
"""By (kind, where): a problem of a path is left out where one of its ends has it."""


def _at_stop(shapes: Clearance, sight: LineOfSight | None, stop: Stop) -> _Problems:
    arm, margin = shapes.cell.arm, shapes.config.limits.joint_margin_rad
    where = f"pose {stop.name}"
    out: _Problems = {}
    for k, name in enumerate(arm.joint_names):
        low, high = arm.q_min[k] + margin, arm.q_max[k] - margin
        if not low - _ROUNDING <= stop.q[k] <= high + _ROUNDING:
            out[f"limit {name}", where] = (
                f"{where}: {name} is at {stop.q[k]:.4g} rad; usable are {low:.4g} to {high:.4g} "
                f"(joint_margin_rad {margin:g})"
            )
    out.update(_along(shapes, stop.q[None], stop.hanging, where))
    if stop.change_to is not None:
        out.update(_along(shapes, stop.q[None], stop.change_to, where))
    if stop.step is not None and sight is not None:
        out.update(sight.problems(stop.q[None], stop.step.load, where))
    return out


def _on_path(shapes: Clearance, a: Stop, b: Stop) -> _Problems:
    """Problems between two stops, their joint limits aside: a straight line keeps those."""
    count = int(np.ceil(np.abs(b.q - a.q).max(initial=0.0) / PATH_STEP_RAD))
    if count < 2:
        return {}
    share = np.arange(1, count)[:, None] / count
    where = f"between {a.name} and {b.name}"
    return _along(shapes, a.q + share * (b.q - a.q), b.hanging, where)


def _along(shapes: Clearance, q: Floats, load: str, where: str) -> _Problems:
    """Workspace, collisions and torques at N points, the worst of each kind."""
    cell, config = shapes.cell, shapes.config
    out: _Problems = {}
    out.update(shapes.problems(q, load, where, itself=is_known(cell.arm)))
    chain = chains.evaluate(cell.arm, q)
    for name, axis, over, limit in workspace.outside(cell, config, chain):
        worst = float(over.max())
        if not worst <= _ROUNDING:
            out[f"box {name} {axis} {limit}", where] = (
                f"{where}: {name} is {worst:.3g} m outside the workspace, whose {axis} ends at "
                f"{limit:g} m"
            )
    pull = _pull(cell, config, load)
    if pull is None:
        return out
    arm, share = cell.arm, config.limits.torque_share
    wrench = np.broadcast_to(pull, (len(q), 6))
    carried = Load(wrench, cell.load_point, cell.tool_mass, cell.tool_com, cell.gravity)
    about_axes = slot_wrenches(arm, chain, carried)[:, : arm.n, 5]
    torque = np.abs(arm.drive_torques(about_axes)).max(axis=0)
    under = "" if load == UNLOADED else f" under {load}"
    for k, name in enumerate(arm.joint_names):
        usable = share * arm.torque_max[k]
        if not torque[k] <= usable:
            out[f"torque {name} {load}", where] = (
                f"{where}{under}: {name} bears {torque[k]:.4g} N·m; usable are {usable:.4g} "
                f"(torque_share {share:g} of {arm.torque_max[k]:g})"
            )
    out.update(_moment(cell, config, chain, pull, load, where))
    return out


def _moment(
    cell: Cell, config: CellConfig, chain: chains.Chain, pull: Floats, load: str, where: str
) -> _Problems:
    """The moment that tool and load exert on the force sensor, at its largest."""
    sensor = config.force_sensor
    if sensor is None:
        return {}
    origin = chain.point(np.asarray(sensor.origin_m))
    moment = pull[3:] + se3.cross(chain.point(cell.load_point) - origin, pull[:3])
    moment = moment + se3.cross(chain.point(cell.tool_com) - origin, cell.tool_mass * cell.gravity)
    worst = float(np.linalg.norm(moment, axis=1).max())
    if worst <= sensor.max_moment_Nm:
        return {}
    return {
        (f"moment {load}", where): (
            f"{where} under {load}: {worst:.4g} N·m on the force sensor; max_moment_Nm is "
            f"{sensor.max_moment_Nm:g}"
        )
    }


def _pull(cell: Cell, config: CellConfig, load: str) -> Floats | None:
    """(6,) wrench of a load, zero unloaded; None where unknown (see `_load_problems`)."""
    if load == UNLOADED:
        return np.zeros(6)
    return next((x.wrench(cell.gravity) for x in config.loads if x.name == load), None)


def _unchecked(cell: Cell, config: CellConfig) -> tuple[str, ...]:
    """Lines on what is not checked because the configuration lacks it."""
    out = []
    if tracker_place(cell, config) is None and config.sight.target_normal is not None:
        out.append(UNKNOWN)
    if not is_known(cell.arm):
        out.append(
            f"the shape of {cell.arm.name} is not known: whether it touches itself is not checked"
        )
    return tuple(out)


def _remarks(plan: Plan) -> tuple[str, ...]:
    out = []
    tests = "purpose" in plan.about  # of a model: what it is compared with may be in another file
    unloaded = {(s.pose, s.cycle) for s in plan.steps if s.load == UNLOADED}
    lacking = [s for s in plan.steps if (s.pose, s.cycle) not in unloaded]
    if lacking and not tests:
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
    return tuple(out)


def _duration(config: CellConfig, stops: tuple[Stop, ...], changes: int, readings: int) -> float:
    """Roughly how long a route takes, cell seconds."""
    motion = config.motion
    moving = sum(
        duration(a.q, b.q, motion.speed_rad_s, motion.acceleration_rad_s2)
        for a, b in pairwise(stops)
    )
    each = seconds_at_rest(config)
    return moving + changes * config.planning.load_change_s + readings * each


def seconds_at_rest(config: CellConfig) -> float:
    """Return how long the arm rests at a step, cell seconds: for the readings of all targets.

    `[planning] reading_s` where it is given, which is of one target; the wrench is averaged once.
    """
    acquire, targets = config.acquire, max(len(config.tool.targets), 1)
    once = 0.0 if config.force_sensor is None else acquire.force_window_s
    each = config.planning.reading_s
    if each is not None:
        return targets * each
    each = acquire.settle_s + acquire.samples * MEASURING_S + (targets > 1) * AIMING_S
    return targets * each + once
