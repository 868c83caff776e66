"""A plan of poses that are spread over the joint space, measured load by load."""

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.data.plan import REFERENCE, UNLOADED, Plan, Step
from hilcal.errors import CannotAnswerError, InputError
from hilcal.plan.feasible import Space
from hilcal.types import Floats, Ints

_CANDIDATES = 12  # drawn poses per pose that is kept
_ROUNDS = 80
_BATCH = 400


def spread_plan(
    cell: Cell,
    config: CellConfig,
    n_poses: int,
    rng: np.random.Generator,
    *,
    repeats: int = 2,
    reference_every: int = 10,
) -> Plan:
    """Return a plan: all poses unloaded, then under each load in turn.

    A load is changed once per campaign, since that is done by hand; within one load the arm
    goes from each pose to the nearest that is left, along straight motions in joint space that
    are clear. Every so many readings, and before and after each load, it returns to the
    reference pose unloaded, or passes it loaded. A few poses are measured in a second unloaded
    cycle, arrived at anew: they tell the arm's repeatability.

    Args:
        cell: the cell.
        config: its loads and limits.
        n_poses: number of poses beside the reference.
        rng: generator.
        repeats: number of poses that are measured unloaded a second time.
        reference_every: unloaded readings between two returns to the reference.

    Raises:
        InputError: numbers that cannot be.
        CannotAnswerError: the limits leave too few poses; says which.
    """
    if n_poses < 1 or not 0 <= repeats <= n_poses or reference_every < 1:
        raise InputError(
            f"{n_poses} poses with {repeats} repeats, reference every {reference_every}; valid: "
            "at least one pose, at most as many repeats, every one reading or more"
        )
    space = Space(cell, config)
    home, poses = _poses(space, n_poses, rng)
    names = tuple(f"p{k + 1}" for k in range(n_poses))
    order = _tour(space, home, poses)
    steps, returns = [Step(REFERENCE, UNLOADED, 0)], 1
    for k, stop in enumerate(order):
        if stop < 0 or (k and k % reference_every == 0):
            steps.append(Step(REFERENCE, UNLOADED, returns))
            returns += 1
        if stop >= 0:
            steps.append(Step(names[stop], UNLOADED))
    again = _tour(space, home, poses, rng.permutation(n_poses)[:repeats])
    steps += [Step(names[stop], UNLOADED, 1) for stop in again if stop >= 0]
    steps.append(Step(REFERENCE, UNLOADED, returns))
    for load in config.loads:
        passes = 0  # each has an unloaded return of its own cycle
        for stop in order:
            if stop < 0:
                steps.append(Step(REFERENCE, load.name, passes))
                passes += 1
            else:
                steps.append(Step(names[stop], load.name))
    steps.append(Step(REFERENCE, UNLOADED, returns + 1))
    about = {"made_by": "spread over the joint space"}
    return Plan((REFERENCE, *names), np.vstack([home, poses]), tuple(steps), about)


def _poses(space: Space, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Return the reference (n,) and poses (count, n) that are reached from it and far apart."""
    low, high = space.low, space.high
    if np.any(low >= high):
        j = int(np.argmax(low - high)) + 1
        raise CannotAnswerError(f"joint_margin_rad leaves joint {j} no range; lower it")
    found = np.empty((0, len(low)))
    clear = bears = 0
    for _ in range(_ROUNDS):
        drawn = rng.uniform(low, high, (_BATCH, len(low)))
        drawn = drawn[space.clear(drawn)]
        clear += len(drawn)
        drawn = drawn[space.bears(drawn)]
        bears += len(drawn)
        found = np.vstack([found, drawn])
        if len(found) >= _CANDIDATES * (count + 1):
            break
    if len(found) < count + 1:
        what = "workspace, floor and joint limits" if clear < count + 1 else "torque_share"
        raise CannotAnswerError(
            f"of {_ROUNDS * _BATCH} drawn states {clear} keep clear and {bears} bear every load; "
            f"{what} leave too few for {count} poses"
        )
    middle = np.linalg.norm(found - np.median(found, axis=0), axis=1)
    best: tuple[Floats, Floats] | None = None
    for k in np.argsort(middle)[:8]:  # the reference is central, and reaches as many as can be
        others = np.delete(found, k, axis=0)
        reached = others[space.passable(found[k], others)]
        if best is None or len(reached) > len(best[1]):
            best = found[k], reached
    if best is None or len(best[1]) < count:
        most = 0 if best is None else len(best[1])
        raise CannotAnswerError(
            f"only {most} of {len(found)} feasible states are reached from a reference pose "
            f"along a clear straight motion; {count} are asked for: widen the workspace"
        )
    home, left = best
    kept = [int(np.argmax(_distance(left, home)))]
    gap = _distance(left, left[kept[0]])
    while len(kept) < count:
        kept.append(int(np.argmax(gap)))
        gap = np.minimum(gap, _distance(left, left[kept[-1]]))
    return home, np.asarray(left[kept])


def _distance(q: Floats, other: Floats) -> Floats:
    """Return (N,) distances on the torus of the joints."""
    return np.asarray(np.linalg.norm(np.exp(1j * q) - np.exp(1j * other), axis=1))


def _tour(space: Space, home: Floats, q: Floats, which: Ints | None = None) -> list[int]:
    """Return the order of the poses, nearest first; -1 where the way leads by the reference."""
    left = list(range(len(q))) if which is None else [int(k) for k in which]
    here, out = home, []
    while left:
        ends = q[left]
        far = np.abs(ends - here).max(axis=1)
        far = np.where(space.passable(here, ends), far, np.inf)
        k = int(np.argmin(far))
        if not np.isfinite(far[k]):
            out.append(-1)
            here = home
            continue
        out.append(left.pop(k))
        here = q[out[-1]]
    return out
