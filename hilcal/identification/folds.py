"""Which readings belong to one pose, for leaving out.

Two commanded poses that agree in every joint within `SAME_POSE` are one pose here, whatever
their names: a repeated pose that is left out must not be predicted from its repetition.
"""

import numpy as np

from hilcal.readings.readings import Readings
from hilcal.regression.connected import groups_within
from hilcal.types import Floats, Ints

SAME_POSE = 2e-3
"""Difference of joint angles within which two poses are one, rad; a choice, no study set it."""
FOLDS = 10
"""Number of folds; a choice, the usual one."""


def distinct_poses(readings: Readings) -> Ints:
    """(N,) number of the distinct pose of each reading, in order of first appearance."""
    _, row, name = np.unique(readings.pose, return_index=True, return_inverse=True)
    label = groups_within(readings.states.q[row], SAME_POSE)[name.reshape(-1)]
    _, index, inverse = np.unique(label, return_index=True, return_inverse=True)
    return np.asarray(np.argsort(np.argsort(index))[inverse.reshape(-1)])


def random_folds(pose: Ints, count: int = FOLDS) -> Ints:
    """Fold of each measurement from its distinct pose: at random, from a fixed seed."""
    total = int(pose.max()) + 1
    deal = np.random.default_rng(20240607).permutation(total) % min(count, total)
    return np.asarray(deal[pose])


def block_folds(pose: Ints, count: int = FOLDS) -> Ints:
    """Fold of each measurement: consecutive poses are in one fold."""
    total = int(pose.max()) + 1
    return np.asarray(np.arange(total) * min(count, total) // total)[pose]


def region_folds(angle: Floats, pose: Ints, count: int = FOLDS) -> Ints:
    """Fold of each measurement: poses close to each other in joint space are in one fold.

    The largest group of poses is halved, repeatedly, across the first principal component of its
    joint angles.

    Args:
        angle: (D, n) joint angles.
        pose: (D,) distinct pose of each measurement.
        count: number of regions aimed at.
    """
    total = int(pose.max()) + 1
    q = np.zeros((total, angle.shape[1]))
    q[pose] = angle
    regions = [np.arange(total)]
    while len(regions) < min(count, total):
        regions.sort(key=len)
        rows = regions.pop()
        spread = q[rows] - q[rows].mean(axis=0)
        along = spread @ np.linalg.svd(spread, full_matrices=False)[2][0]
        order = rows[np.argsort(along, kind="stable")]
        regions += [order[: len(order) // 2], order[len(order) // 2 :]]
    fold = np.empty(total, dtype=np.int64)
    for number, rows in enumerate(regions):
        fold[rows] = number
    return fold[pose]
