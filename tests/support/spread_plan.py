"""A short plan of evenly drawn poses, unloaded first and then load by load."""

import numpy as np

from hilcal.design.feasible import FeasibleSpace, draw_poses
from hilcal.design.run_order import Ordering, PoseReadings, order_plan


def spread_plan(cell, count, rng, repeats=2):
    """Return a plan of `count` poses in the shortest order; every pose bears every load."""
    space = FeasibleSpace(cell)
    drawn = draw_poses(space, 30 * (count + 1), rng, min_poses=count + 1)
    q = drawn.q[drawn.allowed.all(axis=1)]

    def reaches(start, ends):
        """To which of `ends` a motion is clear under every load."""
        return np.all([space.passable(start, ends, load) for load in space.loads], axis=0)

    central = np.argsort(np.linalg.norm(q - np.median(q, axis=0), axis=1))[:8]
    reached = [(int(reaches(q[k], q).sum()), int(k)) for k in central]
    home = max(reached)[1]
    poses = np.delete(q, home, axis=0)
    poses = poses[reaches(q[home], poses)][:count]
    assert len(poses) == count
    names = [f"p{k + 1}" for k in range(count)]
    chosen = [PoseReadings(name, space.loads) for name in names]
    how = Ordering(slack=0.0, unloaded="first", repeats=repeats)
    return order_plan(cell, names, poses, q[home], chosen, space.passable, rng, how).plan
