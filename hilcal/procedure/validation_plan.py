"""Poses and loads of a validation campaign: within what was measured, and none of its poses."""

from dataclasses import replace
from itertools import compress

import numpy as np

from hilcal.calibration.calibration import Calibration
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.checked_plan import refuse
from hilcal.design.feasible import Space, draw
from hilcal.design.run_order import Chosen, Ordering, order_plan
from hilcal.design.timing import pace, timeline
from hilcal.errors import CannotAnswerError
from hilcal.measuring.dry_run import dry_run
from hilcal.present.progress import Say
from hilcal.readings.readings import Readings, States
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.types import Bools, Floats

DRAWN = 4
"""Poses that are drawn for each one that is wanted; a choice: few of them cannot be reached or lie
far from all that was measured."""
LEAST_RANGE = 1e-4
"""Range that a joint which stood still in the campaign has here, rad; a choice."""
RECORDED = ("time", "load_time", "air_temperature", "joint_temperature", "approach")
"""Columns of a state that a model may need beside joint angles and wrench."""
DRAWS = 4
"""Orders that are drawn; a choice: drift is no matter here, only time."""


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

    Raises:
        CannotAnswerError: no pose is left.
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
    usual = _usual(fitted, found.q)
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
    names = {k: f"v{i}" for i, (k, _) in enumerate(wanted, start=1)}
    also = (UNLOADED,) if calibration.mode == "deflection" else ()
    chosen = [Chosen(names[k], (*also, name)) for k, name in wanted]
    q = found.q[[k for k, _ in wanted]]
    how = Ordering(repeats=0, draws=DRAWS)
    plan = order_plan(
        space.cell, own, list(names.values()), q, base, chosen, space.passable, rng, how
    ).plan
    plan = fewer_returns(plan, space, own)
    refuse(dry_run(cell, config, plan), "the validation plan")
    return replace(plan, about={**plan.about, "purpose": "validation"})


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
    columns = {k: v for k in RECORDED if (v := getattr(states, k)) is not None}
    told = calibration.predict(states.q, wrench, recorded=columns)
    far = np.zeros(len(states), dtype=np.bool_)
    for o in told.outside:
        far |= o.points & ("temperature" not in o.of.variable)
    return far


def _usual(fitted: Readings, q: Floats) -> States:
    """Return states at joint angles (N, n), all else as in the last reading."""
    last = fitted.states[np.full(len(q), len(fitted) - 1)]
    return replace(last, q=q, q_actual=None, target=None)
