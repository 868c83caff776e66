"""Groups of what is connected, directly or through others."""

import numpy as np

from hilcal.types import Floats, Ints


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the number (count,) of the group of each of `count` things; a[k], b[k] are joined."""
    from scipy.sparse import coo_matrix  # slow to import
    from scipy.sparse.csgraph import connected_components

    links = coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the number (N,) of the group of each point (N, D).

    Points are joined that differ by at most `distance` in every coordinate.
    """
    from scipy.spatial import cKDTree  # slow to import

    pairs = cKDTree(points).query_pairs(distance, p=np.inf, output_type="ndarray")
    return connected(pairs[:, 0], pairs[:, 1], len(points))
