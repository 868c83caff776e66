"""Groups of what is connected, directly or through others."""

import numpy as np

from hilcal.types import Floats, Ints

_MOST = 2_000_000
"""Pairs that are compared one by one; a choice. More are sought in a tree, which takes as long to
load as a thousand poses to group."""
_DENSE = 20_000_000
"""Near pairs from which on not all of them are listed, a third of a gigabyte; a choice."""


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


def _by_cells(points: Floats, distance: float) -> tuple[Ints, Ints]:
    """Return pairs (K,) and (K,) that join what all near pairs would join, of which there are many.

    Points of one cell of half the distance are joined in a row; of two cells that are not yet
    joined one near pair is sought.
    """
    from scipy.spatial import cKDTree

    place = np.floor(points / (distance / 2)) if distance else points
    cells, of = np.unique(place, axis=0, return_inverse=True)
    order = np.argsort(of.reshape(-1), kind="stable")
    breaks = np.flatnonzero(np.diff(of.reshape(-1)[order])) + 1
    members = np.split(order, breaks)
    inside = np.ones(max(len(order) - 1, 0), dtype=bool)
    inside[breaks - 1] = False
    joined = [np.stack([order[:-1][inside], order[1:][inside]], axis=1)]
    group = np.arange(len(cells))
    for i, j in cKDTree(cells).query_pairs(3.0 if distance else 0.0, p=np.inf):
        if group[i] == group[j]:
            continue
        few, many = sorted((members[i], members[j]), key=len)
        bound = float(np.nextafter(distance, np.inf))
        far, at = cKDTree(points[many]).query(points[few], p=np.inf, distance_upper_bound=bound)
        k = int(np.argmin(far))
        if far[k] <= distance:
            joined.append(np.array([[few[k], many[at[k]]]]))
            group[group == group[j]] = group[i]
    pairs = np.concatenate(joined)
    return pairs[:, 0], pairs[:, 1]


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

        tree = cKDTree(points)
        if tree.count_neighbors(tree, distance, p=np.inf) > _DENSE:
            return _by_cells(points, distance)
        pairs = tree.query_pairs(distance, p=np.inf, output_type="ndarray")
        return pairs[:, 0], pairs[:, 1]
    first = np.repeat(np.arange(len(points)), follow)
    second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(follow) - follow, follow)
    a, b = order[first], order[second]
    near = np.all(np.abs(points[a] - points[b]) <= distance, axis=1)
    return a[near], b[near]
