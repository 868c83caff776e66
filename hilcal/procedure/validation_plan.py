"""Plans of the two campaigns that test a calibration, and the pairs of their readings.

The validation campaign has new poses within the range of the fitted readings. The corrected
campaign has the same points at the joint values that the calibration gives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, pairwise
from typing import Any

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import Compensation, tool_of, tool_poses
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.feasible import REASONS, FeasibleSpace, draw_poses
from hilcal.design.run_order import Ordering, PoseReadings, order_plan, pace, timeline
from hilcal.design.summary import refuse
from hilcal.errors import CannotAnswerError
from hilcal.measuring.route import approach_sides, dry_run, duration, route
from hilcal.present.calibration import refusals
from hilcal.present.progress import Say
from hilcal.procedure.state import Settings
from hilcal.readings.readings import Readings, States
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.store.plan import LEFT_OUT, REFERENCE, UNLOADED, Plan, Step
from hilcal.types import Bools, Floats, Ints

DRAWS_PER_POSE = 4
"""Poses drawn per requested pose; a choice: few cannot be reached or are far from all fitted ones.
"""
LEAST_RANGE = 1e-4
"""Least range of a joint, rad, for joints that did not move in the campaign; a choice."""
ORDER_DRAWS = 4
"""Orders drawn; a choice: only the duration matters, not the drift."""


def recorded_columns(states: States) -> dict[str, Floats]:
    """Return the columns that a model may need besides joint angles and wrench, by name."""
    names = ("time", "load_time", "air_temperature", "joint_temperature", "approach")
    return {name: v for name in names if (v := getattr(states, name)) is not None}


def validation_plan(
    cell: Cell,
    calibration: Calibration,
    fitted: Readings,
    reference: Floats | None,  # (n,) where loads are changed, rad; None: at the first reading
    settings: Settings,
    rng: np.random.Generator,
    say: Say,
) -> Plan:
    """Choose random poses, assign the loads in turn, and order the readings.

    The poses are uniform in the measured range of joint angles. Poses that the cell does not allow,
    that cannot be reached, or that are far from all fitted ones (see
    `identification.prediction.validation`) are left out, so there may be fewer than
    `settings.validation`. Each pose is measured under one
    load, for deflections also unloaded; for positions "unloaded" is one of the loads, unless
    `settings.under_load` excludes it.
    """
    config = cell.configured()
    say("drawing poses within what was measured")
    loads, count = _loads(calibration, fitted, settings.under_load), settings.validation
    hung = [load for load in config.loads if load.name in loads]
    tested_config = config.model_copy(update={"loads": tuple(hung)})
    space = FeasibleSpace(_within(cell, fitted.states.q).with_config(tested_config))
    base = fitted.states.q[0] if reference is None else reference
    drawn = draw_poses(space, DRAWS_PER_POSE * count, rng)
    usable = {
        name: drawn.allowed[:, drawn.loads.index(name)] & space.passable(base, drawn.q, name)
        for name in (UNLOADED, *loads)
    }
    last = fitted.states[np.full(len(drawn.q), len(fitted) - 1)]
    states = replace(last, q=drawn.q, q_actual=None, target=None)
    for name in loads:
        wrench = calibration.loads.get(name, np.zeros(6))
        usable[name] &= usable[UNLOADED] & ~_outside_range(calibration, states, wrench)
    selected: list[tuple[int, str]] = []
    for k in range(len(drawn.q)):
        # The loads in turn; the next load where the pose does not bear this one.
        order = [loads[(len(selected) + j) % len(loads)] for j in range(len(loads))]
        borne = [name for name in order if usable[name][k]]
        if borne and len(selected) < count:
            selected.append((k, borne[0]))
    if not selected:
        raise CannotAnswerError(
            "no pose within the joint angles that were measured is left for a validation campaign: "
            "all are beyond the cell's limits, out of sight, or not reached from the reference pose"
        )
    say("ordering the readings")
    unloaded = (UNLOADED,) if calibration.mode == "deflection" else ()
    chosen = [
        PoseReadings(f"v{i}", (*unloaded, name)) for i, (_, name) in enumerate(selected, start=1)
    ]
    plan = _ordered(space, chosen, drawn.q[[k for k, _ in selected]], base, rng)
    refuse(dry_run(cell, plan), "the validation plan")
    return replace(plan, about={**plan.about, "purpose": "validation"})


def _ordered(
    space: FeasibleSpace,
    chosen: Sequence[PoseReadings],
    q: Floats,
    reference: Floats,
    rng: np.random.Generator,
) -> Plan:
    """Order the chosen poses with joint values (P, n), from the reference pose (n,)."""
    names, order = [c.pose for c in chosen], Ordering(repeats=0, draws=ORDER_DRAWS)
    best = order_plan(space.cell, names, q, reference, chosen, space.passable, rng, order)
    return fewer_returns(best.plan, space)


def fewer_returns(plan: Plan, space: FeasibleSpace) -> Plan:
    """Return the plan without readings at the reference pose where a load is changed.

    The arm still moves there. The first and last reference readings stay, which measure the drift;
    so does the unloaded reading of every loaded one that stays, for the deflection.
    """
    steps = plan.steps
    stays = [
        s.pose != REFERENCE
        or k in (0, len(steps) - 1)
        or steps[k - 1].load == s.load == steps[k + 1].load
        for k, s in enumerate(steps)
    ]
    needed = {Step(s.pose, UNLOADED, s.cycle) for s in compress(steps, stays)}
    retained = [s for s, stay in zip(steps, stays, strict=True) if stay or s in needed]
    shorter, config = replace(plan, steps=tuple(retained)), space.config
    margin = config.limits.joint_margin_rad
    durations = timeline(shorter, space.cell.arm, margin, pace(config))[0]
    return replace(shorter, about={**plan.about, "duration_s": durations.about()})


def _loads(calibration: Calibration, fitted: Readings, under_load: bool) -> tuple[str, ...]:
    """Return the names of the loads to test, which are those of the fitted readings."""
    used = [fitted.load_names[k] for k in dict.fromkeys(fitted.load.tolist())]
    hung = tuple(name for name in used if name != UNLOADED and name in calibration.loads)
    if calibration.mode == "deflection" or (hung and under_load):
        return hung
    return (UNLOADED, *hung)


def _within(cell: Cell, q: Floats) -> Cell:
    """Return the cell with joint limits at the range of the measured joint angles (N, n)."""
    margin, arm = cell.configured().limits.joint_margin_rad + 2e-6, cell.arm
    low, high = q.min(axis=0), q.max(axis=0)
    wider = 0.5 * np.maximum(LEAST_RANGE - (high - low), 0.0)
    q_min = np.maximum(arm.q_min, low - wider - margin)
    q_max = np.minimum(arm.q_max, high + wider + margin)
    return replace(cell, arm=replace(arm, q_min=q_min, q_max=q_max))


def _outside_range(calibration: Calibration, states: States, wrench: Floats) -> Bools:
    """Return whether each state is outside the measured range (N,); temperature is ignored."""
    prediction = calibration.predict(states.q, wrench, recorded=recorded_columns(states))
    outside = np.zeros(len(states), dtype=np.bool_)
    for o in prediction.outside:
        outside |= o.points & ("temperature" not in o.range.variable)
    return outside


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedPoints:
    """K readings of a validation campaign whose poses are to be corrected."""

    readings: Readings  # of the whole campaign
    rows: Ints  # (K,) rows of the readings
    unloaded: Ints  # (K,) rows of their unloaded readings, for a fit to deflections; else -1
    names: tuple[str, ...]  # K names
    loads: tuple[str, ...]  # name of each point's load


def points_of(readings: Readings, mode: str) -> CorrectedPoints:
    """Return the points to correct: readings of the first target, except at the reference pose.

    For deflections, only loaded readings with an unloaded one of the same pose and cycle.
    """
    first = readings.target == 0
    unloaded_rows = {
        (int(readings.pose[k]), int(readings.cycle[k])): int(k)
        for k in np.flatnonzero(first & readings.unloaded)
    }
    rows, unloaded = [], []
    for k in np.flatnonzero(first).tolist():
        arrival = int(readings.pose[k]), int(readings.cycle[k])
        base = -1 if mode == "absolute" else unloaded_rows.get(arrival)
        to_correct = mode == "absolute" or not readings.unloaded[k]
        if to_correct and base is not None and readings.pose_names[readings.pose[k]] != REFERENCE:
            rows.append(k)
            unloaded.append(base)
    loads = tuple(readings.load_names[readings.load[k]] for k in rows)
    names = tuple(
        readings.pose_names[readings.pose[k]] + ("" if load == UNLOADED else f" {load}")
        for k, load in zip(rows, loads, strict=True)
    )
    unloaded_of = np.array(unloaded, dtype=int)
    return CorrectedPoints(readings, np.array(rows, dtype=int), unloaded_of, names, loads)


def corrected_plan(
    cell: Cell,
    calibration: Calibration,
    validation: Readings,
    reference: Floats | None,  # (n,) reference pose of the validation, rad; else its first reading
    rng: np.random.Generator,
    say: Say,
) -> Plan:
    """Return the plan of the corrected joint targets of a validation campaign.

    A point is corrected for the expected state of its reading: the wrench measured in the
    validation, approach sides and times from the route, the last measured temperatures. Points that
    cannot be corrected, or whose corrected joint values the cell does not allow, are left out and
    listed in the plan. The plan begins at the time of the last reading.
    """
    say("correcting joint values")
    points, time = points_of(validation, calibration.mode), validation.states.time
    start = 0.0 if time is None else float(time[-1])
    reference = validation.states.q[0] if reference is None else reference
    space, last = FeasibleSpace(cell), validation.states[slice(len(validation) - 1, None)]
    names, q = points.names, validation.states.q[points.rows]
    blocked = _blocked(space, q, reference, points.loads)
    left_out = {names[k]: why for k, why in blocked.items()}
    while True:
        keep = np.array([k for k, name in enumerate(names) if name not in left_out], dtype=int)
        if not len(keep):
            break
        chosen = [PoseReadings(names[k], (points.loads[k],)) for k in keep]
        plan = _ordered(space, chosen, q[keep], reference, rng)
        order = np.array([names.index(s.pose) for s in plan.steps if s.pose != REFERENCE])
        wrenches = {names[k]: validation.states.wrench[points.rows[k]] for k in keep}
        wrench = np.array([wrenches.get(s.pose, np.zeros(6)) for s in plan.steps])
        states = expected_states(plan, cell.arm, cell.configured(), wrench, last, start)
        at_points = states[np.array([s.pose != REFERENCE for s in plan.steps])]
        result = _compensated(calibration, at_points, points, order)
        reasons = refusals(result, allowed_outside=True)
        refused = _blocked(space, result.q, reference, [points.loads[k] for k in order])
        refused |= {k: why for k, why in enumerate(reasons) if why}
        if not refused:
            say("checking every motion in a dry run")
            corrected = _with_targets(plan, points, order, result, left_out)
            refuse(dry_run(cell, corrected), "the run at corrected targets")
            return corrected
        left_out |= {names[order[k]]: why for k, why in refused.items()}
    causes = "; ".join(f"{name}: {why}" for name, why in list(left_out.items())[:3])
    raise CannotAnswerError(f"no validation pose can be corrected: {causes}")


def _compensated(
    calibration: Calibration, states: States, points: CorrectedPoints, order: Ints
) -> Compensation:
    """Correct the points for their expected states, in the order of the plan."""
    nominal = points.readings.states[points.rows[order]].q
    poses = None
    if calibration.mode == "deflection":
        # The goal is the pose of the unloaded arm, in the state of its reading.
        tool = tool_of(calibration.model, calibration.theta, None)
        unloaded = replace(points.readings.states[points.unloaded[order]], target=None)
        rotation, position = tool_poses(tool, tool.model.predict(unloaded, tool.theta))
        poses = se3.matrix(rotation, position)
    return calibration.compensate(
        nominal, states.wrench, wanted=poses, recorded=recorded_columns(states)
    )


def _blocked(
    space: FeasibleSpace, q: Floats, reference: Floats, loads: Sequence[str]
) -> dict[int, str]:
    """Return why the cell does not allow joint values (K, n) under their loads, by row."""
    out: dict[int, str] = {}
    names = np.array(loads)
    for load in dict.fromkeys(loads):
        under_load = np.flatnonzero(names == load)
        for reason, allowed in space.reasons(q[under_load], load).items():
            for k in under_load[~allowed]:
                out.setdefault(int(k), f"not allowed: {REASONS[reason][1]}")
        clear: Bools = space.passable(reference, q[under_load], load)
        for k in under_load[~clear]:
            out.setdefault(int(k), "no clear motion to it from the reference pose")
    return out


def _with_targets(
    plan: Plan, points: CorrectedPoints, order: Ints, result: Compensation, out: Mapping[str, str]
) -> Plan:
    """Return the plan with corrected joint values, and the points left `out` with reasons."""
    names, loads = points.names, points.loads
    corrected = {names[k]: row for k, row in zip(order, result.q, strict=True)}
    rows = [corrected.get(n, old) for n, old in zip(plan.pose_names, plan.q, strict=True)]
    errors, bands = result.before.error_m.tolist(), result.after.band_m.tolist()
    expected = [
        {"pose": names[k], "load": loads[k], "expected_before_m": error, "band_m": band}
        for k, error, band in zip(order, errors, bands, strict=True)
    ]
    why_not = [{"point": name, "why": why} for name, why in out.items()]
    about = {**plan.about, "purpose": "corrected", "points": expected, LEFT_OUT: why_not}
    return Plan(plan.pose_names, np.array(rows), plan.steps, about)


def paired(validation: Readings, corrected: Readings, mode: str) -> tuple[Readings, Readings]:
    """Return the readings of the same points at uncorrected and at corrected joint values.

    For deflections both include the unloaded readings of the points from the validation; the
    corrected readings take pose and cycle of the uncorrected ones. Common errors are dropped, since
    only the first of several targets is compared.
    """
    alone: dict[str, Any] = {"common": None, "stated": None, "arm_scatter": None, "serial": None}
    validation, corrected = (replace(x, **alone) for x in (validation, corrected))
    points = points_of(validation, mode)
    first = np.flatnonzero(corrected.target == 0)
    corrected_rows = {corrected.pose_names[corrected.pose[k]]: int(k) for k in first}
    common = [k for k, name in enumerate(points.names) if name in corrected_rows]
    rows, bases = points.rows[common], points.unloaded[common]
    c = corrected[np.array([corrected_rows[points.names[k]] for k in common], dtype=int)]
    uncorrected = validation[rows]
    moved = replace(uncorrected, states=c.states, value=c.value, covariance=c.covariance)
    if mode == "absolute":
        return uncorrected, moved
    unloaded = validation[np.unique(bases)]
    return Readings.joined([unloaded, uncorrected]), Readings.joined([unloaded, moved])


def expected_states(
    plan: Plan, arm: Arm, config: CellConfig, wrench: Floats, last: States, start: float
) -> States:
    """Return the expected state at each of the S steps of a plan.

    Approach sides and times under load follow from the route. Temperatures are those of `last`, the
    single state of the last reading; the result has the columns of `last`. `wrench` (S, 6) is that
    of each step's load at the load point, base axes, N and N·m. `start` is the time of the campaign
    at which the plan begins, s.
    """
    pacing = pace(config)
    stops = route(plan, arm, config.limits.joint_margin_rad)
    time, loaded_since = start, start
    times, load_times = [], []
    for previous, stop in pairwise(stops):
        time += duration(previous.q, stop.q, pacing.speed, pacing.acceleration)
        if stop.change_to is not None:
            time += pacing.change_s
            loaded_since = time
        if stop.step is not None:
            times.append(time + pacing.reading_s / 2)
            load_times.append(times[-1] - loaded_since)
            time += pacing.reading_s
    repeated = last[np.zeros(len(plan.steps), dtype=np.int64)]
    sides = approach_sides(stops)
    columns = {"time": np.array(times), "load_time": np.array(load_times), "approach": sides}
    recorded = {name: v for name, v in columns.items() if getattr(last, name) is not None}
    q = np.array([plan.joints(step.pose) for step in plan.steps])
    return replace(repeated, q=q, wrench=wrench, q_actual=None, target=None, **recorded)
