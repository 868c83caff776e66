"""Plans of the campaigns that test a calibration, and their readings side by side.

The validation campaign: poses and loads within what was measured, and none of its poses. The run at
corrected joint targets: the same points at the joint values that the calibration gives.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress, pairwise
from typing import Any

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.calibration.compensation import Compensation
from hilcal.calibration.tool import tool_of, tool_poses
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.feasible import REASONS, Space, draw
from hilcal.design.run_order import Chosen, Ordering, order_plan, pace, timeline
from hilcal.design.summary import refuse
from hilcal.errors import CannotAnswerError
from hilcal.measuring.route import approach_sides, dry_run, duration, route
from hilcal.present.calibration import refusals
from hilcal.present.progress import Say
from hilcal.readings.readings import Readings, States
from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.types import Bools, Floats, Ints

DRAWN = 4
"""Poses that are drawn for each one that is wanted; a choice: few of them cannot be reached or lie
far from all that was measured."""
LEAST_RANGE = 1e-4
"""Range that a joint which stood still in the campaign has here, rad; a choice."""
DRAWS = 4
"""Orders that are drawn; a choice: drift is no matter here, only time."""


def recorded(states: States) -> dict[str, Floats]:
    """Return the columns that a model may need beside joint angles and wrench, by name."""
    names = ("time", "load_time", "air_temperature", "joint_temperature", "approach")
    return {name: v for name in names if (v := getattr(states, name)) is not None}


def validation_plan(
    cell: Cell,
    config: CellConfig,
    calibration: Calibration,
    fitted: Readings,
    reference: Floats | None,
    count: int,
    rng: np.random.Generator,
    say: Say = lambda words: None,
    *,
    under_load: bool = False,
) -> Plan:
    """Choose poses at random, the loads in turn, and put them in order.

    The poses are drawn evenly over the joint angles that were measured; those that the cell does
    not allow, that are not reached, or that lie far from all measured ones (see
    `identification.validation`) are left out, so that they may be fewer than `count`. Each is
    measured under one load, for deflections unloaded as well; of a fit to positions the unloaded
    arm is one of the loads, unless `under_load` leaves it out. `reference` (n,) are the joints of
    the pose where loads are changed, rad; that of the first reading where None.
    """
    say("drawing poses within what was measured")
    loads = _loads(calibration, fitted, under_load)
    hung = [load for load in config.loads if load.name in loads]
    own = config.model_copy(update={"loads": tuple(hung)})
    space = Space(_within(cell, config, fitted.states.q), own)
    base = fitted.states.q[0] if reference is None else reference
    found = draw(space, DRAWN * count, rng)
    good = {
        name: found.allowed[:, found.loads.index(name)] & space.passable(base, found.q, name)
        for name in (UNLOADED, *loads)
    }
    last = fitted.states[np.full(len(found.q), len(fitted) - 1)]
    usual = replace(last, q=found.q, q_actual=None, target=None)
    for name in loads:
        wrench = calibration.loads.get(name, np.zeros(6))
        good[name] &= good[UNLOADED] & ~_far(calibration, usual, wrench)
    wanted: list[tuple[int, str]] = []
    for k in range(len(found.q)):
        # The loads in turn; where a pose does not bear one, the next.
        order = [loads[(len(wanted) + j) % len(loads)] for j in range(len(loads))]
        borne = [name for name in order if good[name][k]]
        if borne and len(wanted) < count:
            wanted.append((k, borne[0]))
    if not wanted:
        raise CannotAnswerError(
            "no pose within the joint angles that were measured is left for a validation campaign: "
            "all are beyond the cell's limits, out of sight, or not reached from the reference pose"
        )
    say("ordering the readings")
    also = (UNLOADED,) if calibration.mode == "deflection" else ()
    chosen = [Chosen(f"v{i}", (*also, name)) for i, (_, name) in enumerate(wanted, start=1)]
    plan = _ordered(space, own, chosen, found.q[[k for k, _ in wanted]], base, rng)
    refuse(dry_run(cell, config, plan), "the validation plan")
    return replace(plan, about={**plan.about, "purpose": "validation"})


def _ordered(
    space: Space,
    config: CellConfig,
    chosen: Sequence[Chosen],
    q: Floats,
    reference: Floats,
    rng: np.random.Generator,
) -> Plan:
    """Put the chosen poses in order, at joint values (P, n), from the reference pose (n,)."""
    names, how = [c.pose for c in chosen], Ordering(repeats=0, draws=DRAWS)
    found = order_plan(space.cell, config, names, q, reference, chosen, space.passable, rng, how)
    return fewer_returns(found.plan, space, config)


def fewer_returns(plan: Plan, space: Space, config: CellConfig) -> Plan:
    """Return the plan without readings at the reference pose where a load is changed.

    The arm goes there all the same. The first and the last one stay, which measure the drift of a
    campaign that takes minutes, and the unloaded ones of loaded ones that stay: a deflection needs
    both.
    """
    steps = plan.steps
    stays = [
        s.pose != REFERENCE
        or k in (0, len(steps) - 1)
        or steps[k - 1].load == s.load == steps[k + 1].load
        for k, s in enumerate(steps)
    ]
    needed = {Step(s.pose, UNLOADED, s.cycle) for s in compress(steps, stays)}
    kept = [s for s, stay in zip(steps, stays, strict=True) if stay or s in needed]
    made = replace(plan, steps=tuple(kept))
    margin = config.limits.joint_margin_rad
    lasts = timeline(made, space.cell.arm, margin, pace(config))[0]
    return replace(made, about={**plan.about, "duration_s": lasts.about()})


def _loads(calibration: Calibration, fitted: Readings, under_load: bool) -> tuple[str, ...]:
    """Names of the loads under which the model is tested: those that it was fitted under."""
    used = [fitted.load_names[k] for k in dict.fromkeys(fitted.load.tolist())]
    hung = tuple(name for name in used if name != UNLOADED and name in calibration.loads)
    if calibration.mode == "deflection" or (hung and under_load):
        return hung
    return (UNLOADED, *hung)


def _within(cell: Cell, config: CellConfig, q: Floats) -> Cell:
    """Return the cell with an arm that leaves no measured range of joint angles (N, n)."""
    margin, arm = config.limits.joint_margin_rad + 2e-6, cell.arm
    low, high = q.min(axis=0), q.max(axis=0)
    wider = 0.5 * np.maximum(LEAST_RANGE - (high - low), 0.0)
    q_min = np.maximum(arm.q_min, low - wider - margin)
    q_max = np.minimum(arm.q_max, high + wider + margin)
    return replace(cell, arm=replace(arm, q_min=q_min, q_max=q_max))


def _far(calibration: Calibration, states: States, wrench: Floats) -> Bools:
    """(N,) which states lie far from all that was measured, whatever the temperature."""
    told = calibration.predict(states.q, wrench, recorded=recorded(states))
    far = np.zeros(len(states), dtype=np.bool_)
    for o in told.outside:
        far |= o.points & ("temperature" not in o.of.variable)
    return far


LEFT_OUT = "left_out"  # Key of a plan's file: which points are missing, and why


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedPoints:
    """K readings of a validation campaign whose poses are to be corrected."""

    rows: Ints  # (K,) of the readings
    unloaded: Ints  # (K,) rows of their unloaded readings, for a fit to deflections; -1 otherwise
    names: tuple[str, ...]
    loads: tuple[str, ...]  # name of each one's load


def points_of(readings: Readings, mode: str) -> CorrectedPoints:
    """Return what is corrected: of the first target each pose under its load.

    For deflections it is each loaded reading that has an unloaded one in its pose and cycle.
    """
    first = readings.target == 0
    at = {
        (int(readings.pose[k]), int(readings.cycle[k])): int(k)
        for k in np.flatnonzero(first & readings.unloaded)
    }
    rows, unloaded = [], []
    for k in np.flatnonzero(first).tolist():
        base = -1 if mode == "absolute" else at.get((int(readings.pose[k]), int(readings.cycle[k])))
        taken = mode == "absolute" or not readings.unloaded[k]
        if taken and base is not None and readings.pose_names[readings.pose[k]] != REFERENCE:
            rows.append(k)
            unloaded.append(base)
    loads = tuple(readings.load_names[readings.load[k]] for k in rows)
    poses = [readings.pose_names[readings.pose[k]] for k in rows]
    names = tuple(
        pose if load == UNLOADED else f"{pose} {load}"
        for pose, load in zip(poses, loads, strict=True)
    )
    return CorrectedPoints(np.array(rows, dtype=int), np.array(unloaded, dtype=int), names, loads)


def corrected_plan(
    cell: Cell,
    config: CellConfig,
    calibration: Calibration,
    validation: Readings,
    reference: Floats,
    begun: float,
    rng: np.random.Generator,
    say: Say = lambda words: None,
) -> Plan:
    """Return the plan of the corrected joint targets of a validation campaign.

    A point's joint values are found for the state in which its reading will be taken: the wrench
    that was measured in the validation, sides of approach and times as the route gives them,
    temperatures as they were last. Points that cannot be corrected, or that the cell does not allow
    at their corrected values, are left out; the plan says which. `reference` (n,) are the joints of
    the validation's reference pose, rad; the plan begins at `begun`, in the time of the campaign,
    s.
    """
    say("correcting joint values")
    of = points_of(validation, calibration.mode)
    space, last = Space(cell, config), validation.states[slice(len(validation) - 1, None)]
    q = validation.states.q[of.rows]
    left = {of.names[k]: why for k, why in _blocked(space, q, reference, of.loads).items()}
    while True:
        keep = np.array([k for k, name in enumerate(of.names) if name not in left], dtype=int)
        if not len(keep):
            break
        chosen = [Chosen(of.names[k], (of.loads[k],)) for k in keep]
        plan = _ordered(space, config, chosen, q[keep], reference, rng)
        order = np.array([of.names.index(s.pose) for s in plan.steps if s.pose != REFERENCE])
        wrenches = {of.names[k]: validation.states.wrench[of.rows[k]] for k in keep}
        wrench = np.array([wrenches.get(s.pose, np.zeros(6)) for s in plan.steps])
        states = expected_states(plan, cell.arm, config, wrench, last, begun)
        mine = states[np.array([s.pose != REFERENCE for s in plan.steps])]
        found = _compensated(calibration, mine, validation, of, order)
        bad = {k: why for k, why in enumerate(refusals(found, allowed_outside=True)) if why}
        bad = _blocked(space, found.q, reference, [of.loads[k] for k in order]) | bad
        if not bad:
            say("checking every motion in a dry run")
            made = _with_targets(plan, of, order, found, left)
            refuse(dry_run(cell, config, made), "the run at corrected targets")
            return made
        left |= {of.names[order[k]]: why for k, why in bad.items()}
    words = "; ".join(f"{name}: {why}" for name, why in list(left.items())[:3])
    raise CannotAnswerError(f"no validation pose can be corrected: {words}")


def _compensated(
    calibration: Calibration, states: States, validation: Readings, of: CorrectedPoints, order: Ints
) -> Compensation:
    """Correct the points for the states that are expected, in the order of the plan."""
    nominal = validation.states[of.rows[order]].q
    wanted = None
    if calibration.mode == "deflection":
        # Where the unloaded arm was, in the state in which it was read.
        tool = tool_of(calibration.model, calibration.theta, None)
        free = replace(validation.states[of.unloaded[order]], target=None)
        rotation, position = tool_poses(tool, tool.model.predict(free, tool.theta))
        wanted = se3.matrix(rotation, position)
    return calibration.compensate(nominal, states.wrench, wanted=wanted, recorded=recorded(states))


def _blocked(space: Space, q: Floats, reference: Floats, loads: Sequence[str]) -> dict[int, str]:
    """Say which joint values (K, n) the cell does not allow under their loads, and why."""
    out: dict[int, str] = {}
    names = np.array(loads)
    for load in dict.fromkeys(loads):
        mine = np.flatnonzero(names == load)
        for reason, kept in space.reasons(q[mine], load).items():
            for k in mine[~kept]:
                out.setdefault(int(k), f"not allowed: {REASONS[reason][1]}")
        clear: Bools = space.passable(reference, q[mine], load)
        for k in mine[~clear]:
            out.setdefault(int(k), "no clear motion to it from the reference pose")
    return out


def _with_targets(
    plan: Plan, of: CorrectedPoints, order: Ints, found: Compensation, left: Mapping[str, str]
) -> Plan:
    """Return the plan with the corrected joint values in the place of the nominal ones."""
    corrected = {of.names[k]: row for k, row in zip(order, found.q, strict=True)}
    rows = [corrected.get(n, old) for n, old in zip(plan.pose_names, plan.q, strict=True)]
    expected = zip(order, found.before.error_m.tolist(), found.after.band_m.tolist(), strict=True)
    about = {
        **plan.about,
        "purpose": "corrected",
        "points": [
            {"pose": of.names[k], "load": of.loads[k], "expected_before_m": off, "band_m": band}
            for k, off, band in expected
        ],
        LEFT_OUT: [{"point": name, "why": why} for name, why in left.items()],
    }
    return Plan(plan.pose_names, np.array(rows), plan.steps, about)


def paired(validation: Readings, corrected: Readings, mode: str) -> tuple[Readings, Readings]:
    """Return the readings of the same points at uncorrected and at corrected joint values.

    For deflections both come with the unloaded readings of the points, from the validation: the
    corrected readings take the pose and the cycle of the uncorrected ones. They share no error: of
    several targets only the first one is compared.
    """
    alone: dict[str, Any] = {"common": None, "stated": None, "arm_scatter": None, "serial": None}
    validation, corrected = (replace(x, **alone) for x in (validation, corrected))
    of = points_of(validation, mode)
    first = np.flatnonzero(corrected.target == 0)
    there = {corrected.pose_names[corrected.pose[k]]: int(k) for k in first}
    known = [k for k, name in enumerate(of.names) if name in there]
    rows, bases = of.rows[known], of.unloaded[known]
    after = corrected[np.array([there[of.names[k]] for k in known], dtype=int)]
    before = validation[rows]
    moved = replace(before, states=after.states, value=after.value, covariance=after.covariance)
    if mode == "absolute":
        return before, moved
    free = validation[np.unique(bases)]
    return Readings.joined([free, before]), Readings.joined([free, moved])


def left_out_of(plan: Plan) -> list[tuple[str, str]]:
    """Return the points that a plan leaves out, as its file says, each with the reason."""
    return [(str(x["point"]), str(x["why"])) for x in plan.about.get(LEFT_OUT, [])]


def expected_states(
    plan: Plan, arm: Arm, config: CellConfig, wrench: Floats, last: States, begun: float
) -> States:
    """Return the state of each of the S steps of a plan.

    Sides of approach and times under load follow from the route, as a session takes it. Joints and
    air are as warm as in the last reading, the one state `last`, whose columns are returned.
    `wrench` (S, 6) is that of each step's load at the load point, base axes, N and N·m; the plan
    begins at `begun`, in the time of the campaign, s.
    """
    at = pace(config)
    stops = route(plan, arm, config.limits.joint_margin_rad)
    now, since = begun, begun
    times, hung = [], []
    for before, stop in pairwise(stops):
        now += duration(before.q, stop.q, at.speed, at.acceleration)
        if stop.change_to is not None:
            now += at.change_s
            since = now
        if stop.step is not None:
            times.append(now + at.reading_s / 2)
            hung.append(times[-1] - since)
            now += at.reading_s
    every = last[np.zeros(len(plan.steps), dtype=np.int64)]
    known = {
        "time": np.array(times),
        "load_time": np.array(hung),
        "approach": approach_sides(stops),
    }
    given = {name: v for name, v in known.items() if getattr(last, name) is not None}
    q = np.array([plan.joints(step.pose) for step in plan.steps])
    return replace(every, q=q, wrench=wrench, q_actual=None, target=None, **given)
