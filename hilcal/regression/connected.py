"""Connected components of a graph, and of points within a distance of each other."""

import numpy as np

from hilcal.types import Floats, Ints


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the group number (count,) of each of `count` items; items a[k] and b[k] are joined.

    Groups are numbered in the order of their first items.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def _near(points: Floats, distance: float) -> tuple[Ints, Ints]:
    """Return pairs (K,) and (K,) of points that form the groups which all near pairs would form.

    Points in one cell of half the distance are joined in a chain. Two cells that are not yet joined
    are joined by one near pair, if there is any.
    """
    from scipy.spatial import cKDTree  # slow to import

    if not points.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    place = np.floor(points / (distance / 2)) if distance else points
    cells, cell = np.unique(place, axis=0, return_inverse=True)
    cell = cell.reshape(-1)
    order = np.argsort(cell, kind="stable")
    same = np.diff(cell[order]) == 0
    joined = [np.stack([order[:-1], order[1:]], axis=1)[same]]
    # Of equal points one is used: a tree does not divide them.
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    if 2 * len(cells) > len(first):  # hardly any cell holds several
        joined.append(first[cKDTree(points[first]).query_pairs(distance, np.inf, 0, "ndarray")])
        pairs = np.concatenate(joined)
        return pairs[:, 0], pairs[:, 1]
    group_of = cell[first]
    order = np.argsort(group_of, kind="stable")
    members = np.split(first[order], np.flatnonzero(np.diff(group_of[order])) + 1)
    tree, up = cKDTree(cells), np.arange(len(cells))

    def group(k: Ints) -> Ints:
        while np.any(up[k] != k):
            up[k] = k = up[up[k]]
        return k

    for i in range(len(cells)):
        near = np.array(tree.query_ball_point(cells[i], 3.0 if distance else 0.0, p=np.inf))
        for j in near[group(near) != group(np.array([i]))].tolist():
            low, high = sorted(group(np.array([i, j])).tolist())
            if low == high:
                continue
            few, many = sorted((members[i], members[j]), key=len)
            nearest = cKDTree(points[many]).query(
                points[few], p=np.inf, distance_upper_bound=float(np.nextafter(distance, np.inf))
            )
            separation, index = (np.atleast_1d(x) for x in nearest)
            k = int(np.argmin(separation))
            if separation[k] <= distance:
                joined.append(np.array([[few[k], many[index[k]]]]))
                up[high] = low
    pairs = np.concatenate(joined)
    return pairs[:, 0], pairs[:, 1]


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the group number (N,) of each point (N, D).

    Two points are joined where they differ by at most `distance` in every coordinate.
    """
    return connected(*_near(points, distance), len(points))
