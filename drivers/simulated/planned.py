"""The states that a plan visits, as far as they are known before it is run."""

from dataclasses import replace

import numpy as np

from drivers.simulated.rehearsal import CampaignStates
from drivers.simulated.temperatures import warm_up
from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.measuring.route import approach_sides, route
from hilcal.readings.readings import States
from hilcal.store.plan import UNLOADED, Plan

_LOADING = 60.0  # s, to change a load
_MEASURING = 5.0  # s, to settle and to measure


def planned_states(
    cell: Cell, config: CellConfig, plan: Plan, begun: float = 0.0
) -> CampaignStates:
    """Return the N states of a plan's steps in order, with times as they will about be.

    Of several targets, each is read at every step.

    The arm takes the route of a session, which tells from which sides the joints arrive. They warm
    up as those of the cell behind the wires do.

    Args:
        cell: the cell.
        config: its loads and motion.
        plan: what is visited.
        begun: when, in the time of the campaign, s.
    """
    names = [UNLOADED, *(load.name for load in config.loads)]
    pulls = {load.name: load.wrench(cell.gravity) for load in config.loads}
    q = np.array([plan.joints(step.pose) for step in plan.steps])
    wrench = np.array([pulls.get(step.load, np.zeros(6)) for step in plan.steps])
    load = np.array([names.index(step.load) for step in plan.steps])
    moved = np.diff(q, axis=0, prepend=q[:1] - 1.0)
    stops = route(plan, cell.arm, config.limits.joint_margin_rad)
    speed, acceleration = config.motion.speed_rad_s, config.motion.acceleration_rad_s2
    changed = np.diff(load, prepend=0) != 0
    resting = _MEASURING * len(cell.all_targets)
    lasts = np.abs(moved).max(axis=1) / speed + speed / acceleration + resting
    time = begun + np.cumsum(lasts + _LOADING * changed)
    hung = np.maximum.accumulate(np.where(changed, time - resting, begun))
    states = States(
        q=q,
        wrench=wrench,
        time=time,
        load_time=np.maximum(time - hung, 1.0),
        joint_temperature=warm_up(time, cell.arm.n),
        approach=approach_sides(stops),
    )
    pose = np.array([plan.pose_names.index(step.pose) for step in plan.steps])
    cycle = np.array([step.cycle for step in plan.steps])
    if cell.targets is None:
        return CampaignStates(states, pose, load, cycle)
    each = np.repeat(np.arange(len(pose)), len(cell.targets))
    target = np.tile(np.arange(len(cell.targets)), len(pose))
    states = states[each]
    passed = _MEASURING * target
    loaded = np.maximum(time - hung, 1.0)[each] + passed
    states = replace(states, target=target, time=time[each] + passed, load_time=loaded)
    return CampaignStates(states, pose[each], load[each], cycle[each])
