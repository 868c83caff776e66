"""What the views of a plan have in common: where everything is at each step; computed once."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.next import PairPower
from hilcal.design.summary import PlanSummary
from hilcal.design.timing import pace, timeline
from hilcal.errors import InputError
from hilcal.measuring.clearance import Clearance, LineOfSight, clearance_of, sight_of
from hilcal.measuring.route import Stop, route
from hilcal.robot import chain as chains
from hilcal.robot.body import body_poses
from hilcal.store.plan import Plan
from hilcal.types import Bools, Floats, Ints

SEEN, TURNED, HIDDEN, UNKNOWN = range(4)
"""Does the tracker see the target: yes; it is turned too far away; something is between; not
known, as the tracker's place is not."""
_WAY_STEP_RAD = 0.08  # distance of the drawn points of a motion, of the leading joint


@dataclass(frozen=True, slots=True, eq=False)
class PlanDigest:
    """A plan, and what is derived from it; S steps, base axes, SI.

    Attributes:
        cell: the cell.
        plan: poses and steps.
        summary: cost, predicted precision and efficiency.
        shapes: of arm, tool, obstacles and loads, as collisions are checked.
        tracker: (3,) where it stands; None where that is not known.
        loads: names of the loads, in the order in which they are hung.
        load: (S,) index into `loads`.
        pose: (S,) index of the step's pose.
        bodies: (S, n + 2, 4, 4) poses of base, bodies and flange.
        target: (S, 3) the target, or the flange where its place is not known.
        hook: (S, 3) the load point.
        sight: (S,) `SEEN` and so on.
        incidence: (S,) angle between the target's normal and the beam; None where not given.
        why: of each step, why the target is not seen; empty where it is.
        rank: (S,) how many other loads are measured before in the same pose: its bead's place.
        ways: of each step, (K, 3) the target's way there from the step before.
        time: (S,) middle of each reading since the start, s.
        powers: of the suspects that the plan separates, pair by pair; else empty.
    """

    cell: Cell
    plan: Plan
    summary: PlanSummary
    shapes: Clearance
    tracker: Floats | None
    loads: tuple[str, ...]
    load: Ints
    pose: Ints
    bodies: Floats
    target: Floats
    hook: Floats
    sight: Ints
    incidence: Floats | None
    why: tuple[str, ...]
    rank: Ints
    ways: tuple[Floats, ...]
    time: Floats
    powers: tuple[PairPower, ...] = ()

    def __len__(self) -> int:
        """Return the number of steps."""
        return len(self.load)

    @property
    def config(self) -> CellConfig:
        """The cell's configuration."""
        return self.shapes.config

    @property
    def reach(self) -> float:
        """The arm's reach, m: sizes are drawn by it."""
        return max(self.cell.arm.reach, 0.1)

    @property
    def numbers(self) -> Ints:
        """(S,) numbers of the steps on the timeline, from 1."""
        return np.arange(1, len(self) + 1)

    @property
    def unseen(self) -> Bools:
        """(S,) steps whose target the tracker does not see."""
        return np.asarray((self.sight == TURNED) | (self.sight == HIDDEN))

    @property
    def beads(self) -> Ints:
        """Return the first step of every pose and load, one for each bead."""
        pairs = np.stack([self.pose, self.load], 1)
        return np.sort(np.unique(pairs, axis=0, return_index=True)[1]).astype(np.int64)

    @property
    def stints(self) -> tuple[tuple[int, int], ...]:
        """Return first step and end of every stretch under one load."""
        starts = [0, *(np.flatnonzero(np.diff(self.load)) + 1).tolist(), len(self)]
        return tuple(pairwise(starts))


def plan_digest(
    cell: Cell,
    config: CellConfig,
    plan: Plan,
    summary: PlanSummary,
    powers: tuple[PairPower, ...] = (),
) -> PlanDigest:
    """Derive what the views need.

    Raises:
        InputError: the plan's poses do not have as many joints as the arm.
    """
    if plan.q.shape[1] != cell.arm.n:
        raise InputError(
            f"the plan has {plan.q.shape[1]} joint angles per pose; {cell.arm.name} has "
            f"{cell.arm.n} joints"
        )
    shapes = clearance_of(cell, config)
    view = sight_of(shapes)
    row = {name: k for k, name in enumerate(plan.pose_names)}
    pose = np.array([row[s.pose] for s in plan.steps], dtype=np.int64)
    loads = plan.loads
    load = np.array([loads.index(s.load) for s in plan.steps], dtype=np.int64)
    q = plan.q[pose]
    chain = chains.evaluate(cell.arm, q)
    sight, why = _sight(view, q, load, loads)
    margin = config.limits.joint_margin_rad
    return PlanDigest(
        cell=cell,
        plan=plan,
        summary=summary,
        shapes=shapes,
        tracker=None if view is None else view.tracker,
        loads=loads,
        load=load,
        pose=pose,
        bodies=body_poses(cell.arm, q),
        target=chain.point(cell.target[:3, 3]),
        hook=chain.point(cell.load_point),
        sight=sight,
        incidence=None if view is None else view.incidence(q),
        why=why,
        rank=_rank(pose, load),
        ways=_ways(cell, route(plan, cell.arm, margin)),
        time=timeline(plan, cell.arm, margin, pace(config))[1],
        powers=powers,
    )


def _sight(
    view: LineOfSight | None, q: Floats, load: Ints, loads: Sequence[str]
) -> tuple[Ints, tuple[str, ...]]:
    """(S,) whether the target is seen, and why not."""
    count = len(q)
    if view is None:
        return np.full(count, UNKNOWN), ("",) * count
    free = np.zeros(count, dtype=np.bool_)
    for k, name in enumerate(loads):
        free[load == k] = view.free(q[load == k], name)
    angle = view.incidence(q)
    most = view.clearance.config.sight.incidence_max_rad
    turned = np.zeros(count, dtype=np.bool_) if angle is None else angle > most
    out = np.where(~free, HIDDEN, np.where(turned, TURNED, SEEN))
    why = [""] * count
    for i in np.flatnonzero(out != SEEN).tolist():
        told = view.problems(q[i : i + 1], loads[load[i]], "")
        why[i] = "; ".join(line.removeprefix(": ") for line in told)
        if not why[i]:  # some of several targets
            hidden = view.hidden(q[i : i + 1], loads[load[i]])
            why[i] = f"hidden: {', '.join(view.clearance.cell.target_names[k] for k in hidden)}"
    return out.astype(np.int64), tuple(why)


def _rank(pose: Ints, load: Ints) -> Ints:
    """(S,) how many loads come before in each step's pose."""
    order: dict[int, list[int]] = {}
    for p, k in zip(pose.tolist(), load.tolist(), strict=True):
        loads = order.setdefault(p, [])
        if k not in loads:
            loads.append(k)
    pairs = zip(pose.tolist(), load.tolist(), strict=True)
    return np.array([order[p].index(k) for p, k in pairs], dtype=np.int64)


def _ways(cell: Cell, stops: Sequence[Stop]) -> tuple[Floats, ...]:
    """Return of each reading the target's way there, along straight motions in joint space."""
    legs: list[list[Floats]] = [[]]
    for a, b in pairwise(stops):
        count = max(1, int(np.ceil(np.abs(b.q - a.q).max(initial=0.0) / _WAY_STEP_RAD)))
        share = np.linspace(0.0, 1.0, count + 1)[:, None]
        legs[-1].append(a.q + share * (b.q - a.q))
        if b.step is not None:
            legs.append([])
    joined = [np.vstack(leg) for leg in legs if leg]
    points = chains.evaluate(cell.arm, np.vstack(joined)).point(cell.target[:3, 3])
    ends = np.cumsum([len(leg) for leg in joined])[:-1]
    return tuple(np.split(points, ends))
