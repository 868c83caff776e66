"""Groups of what is connected, directly or through others."""

import numpy as np

from hilcal.types import Floats, Ints


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the number (count,) of the group of each of `count` things; a[k], b[k] are joined.

    Groups are numbered by their first things.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], dtype=np.int64)


def _near(points: Floats, distance: float) -> tuple[Ints, Ints]:
    """Return pairs (K,) and (K,) that join what all near pairs would join.

    Points of one cell of half the distance are joined in a row; of two cells that are not yet
    joined one near pair is sought.
    """
    from scipy.spatial import cKDTree  # slow to import

    if not points.size:
        return np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64)
    place = np.floor(points / (distance / 2)) if distance else points
    cells, of = np.unique(place, axis=0, return_inverse=True)
    of = of.reshape(-1)
    order = np.argsort(of, kind="stable")
    alone = np.diff(of[order], append=-1) != 0
    joined = [np.stack([order[:-1], order[1:]], axis=1)[~alone[:-1]]]
    # Equal points are one: a tree does not divide them.
    first = np.sort(np.unique(points, axis=0, return_index=True)[1])
    if 2 * len(cells) > len(first):  # hardly any are in one cell
        joined.append(first[cKDTree(points[first]).query_pairs(distance, np.inf, 0, "ndarray")])
        pairs = np.concatenate(joined)
        return pairs[:, 0], pairs[:, 1]
    members = [first[rows] for rows in _split(of[first])]
    tree, up = cKDTree(cells), np.arange(len(cells))

    def group(k: Ints) -> Ints:
        while np.any(up[k] != k):
            up[k] = k = up[up[k]]
        return k

    for i in range(len(cells)):
        near = np.array(tree.query_ball_point(cells[i], 3.0 if distance else 0.0, p=np.inf))
        for j in near[group(near) != group(np.array([i]))].tolist():
            own, other = group(np.array([i, j])).tolist()
            if own == other:
                continue
            few, many = sorted((members[i], members[j]), key=len)
            near_ones = cKDTree(points[many]).query(
                points[few], p=np.inf, distance_upper_bound=float(np.nextafter(distance, np.inf))
            )
            far, at = (np.atleast_1d(x) for x in near_ones)
            k = int(np.argmin(far))
            if far[k] <= distance:
                joined.append(np.array([[few[k], many[at[k]]]]))
                up[max(own, other)] = min(own, other)
    pairs = np.concatenate(joined)
    return pairs[:, 0], pairs[:, 1]


def _split(group: Ints) -> list[Ints]:
    """Return the members of each group."""
    order = np.argsort(group, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(group[order])) + 1)


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the number (N,) of the group of each point (N, D).

    Points are joined that differ by at most `distance` in every coordinate.
    """
    return connected(*_near(points, distance), len(points))
