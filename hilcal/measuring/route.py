"""The way of the arm through a plan: every stop in order, and where loads are changed."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.robot.arm import Arm
from hilcal.store.plan import REFERENCE, UNLOADED, Plan, Step
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
    """Return (n,) where the arm comes from to a reference pose (n,) at the start, rad.

    `margin` is the distance kept from the joint limits, rad.
    """
    side = np.where(q - APPROACH_RAD >= arm.q_min + margin, 1.0, -1.0)
    return np.asarray(q - side * APPROACH_RAD)


def route(plan: Plan, arm: Arm, margin: float = 0.0) -> tuple[Stop, ...]:
    """Return every stop for the steps of a plan.

    The first two stops, at a little distance from the reference pose and there, move every joint,
    so that the approach sides of all readings are known; limits and margin (rad) say from which
    side the reference pose can be approached. Loads are changed there. A reading that repeats the
    one before it is approached anew.
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

    It is the direction of the joint's last motion, also of one to a stop without a reading, as
    where a load is changed; 0 where it has not moved.
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
