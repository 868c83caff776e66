"""The states in which the readings of a plan will be taken, as far as that is known before."""

from dataclasses import replace
from itertools import pairwise

import numpy as np

from hilcal.config import CellConfig
from hilcal.design.timing import pace
from hilcal.measuring.route import approach_sides, duration, route
from hilcal.readings.readings import States
from hilcal.robot.arm import Arm
from hilcal.store.plan import Plan
from hilcal.types import Floats


def expected_states(
    plan: Plan, arm: Arm, config: CellConfig, wrench: Floats, last: States, begun: float
) -> States:
    """Return the state of each step of a plan.

    Sides of approach and times under load follow from the route, as a session takes it. Joints
    and air are as warm as in the last reading.

    Args:
        plan: S steps.
        arm: the arm.
        config: its motion, and how long a reading and a change of the load take.
        wrench: (S, 6) of each step's load at the load point, base axes, N and N·m.
        last: one state, of the last reading before; its columns are those that are returned.
        begun: when the plan begins, in the time of the campaign, s.
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
