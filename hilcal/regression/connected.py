"""Groups of what is connected, directly or through others."""

import numpy as np

from hilcal.types import Floats, Ints

_MOST = 2_000_000
"""Pairs that are compared one by one; a choice. More are sought in a tree, which takes as long to
load as a thousand poses to group."""


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the number (count,) of the group of each of `count` things; a[k], b[k] are joined.

    Groups are numbered by their first things. Each thing takes the least number of those that it
    is joined with, and then that thing's own, until nothing changes.
    """
    label = np.arange(count)
    while True:
        least = np.minimum(label[a], label[b])
        new = label.copy()
        np.minimum.at(new, a, least)
        np.minimum.at(new, b, least)
        new = new[new]
        if np.array_equal(new, label):
            return np.asarray(np.unique(label, return_inverse=True)[1])
        label = new


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the number (N,) of the group of each point (N, D).

    Points are joined that differ by at most `distance` in every coordinate.
    """
    return connected(*_near(points, distance), len(points))


def _near(points: Floats, distance: float) -> tuple[Ints, Ints]:
    """Return the pairs (K,) and (K,) of points that differ by at most `distance`."""
    if not points.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    along = points[:, np.argmax(np.ptp(points, axis=0))]
    order = np.argsort(along, kind="stable")
    sorted_along = along[order]
    reach = sorted_along + distance * (1.0 + 1e-9) + np.spacing(np.abs(sorted_along))
    follow = np.searchsorted(sorted_along, reach, side="right") - np.arange(len(points)) - 1
    if follow.sum() > _MOST:
        from scipy.spatial import cKDTree  # slow to import

        pairs = cKDTree(points).query_pairs(distance, p=np.inf, output_type="ndarray")
        return pairs[:, 0], pairs[:, 1]
    first = np.repeat(np.arange(len(points)), follow)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(follow) - follow, follow)
    a, b = order[first], order[second]
    near = np.all(np.abs(points[a] - points[b]) <= distance, axis=1)
    return a[near], b[near]
