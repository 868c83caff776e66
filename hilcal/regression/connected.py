"""Groups of what is connected, directly or through others."""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hilcal.types import Floats, Ints


def connected(a: Ints, b: Ints, count: int) -> Ints:
    """Return the number (count,) of the group of each of `count` things; a[k], b[k] are joined."""
    links = coo_matrix((np.ones(len(a)), (a, b)), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def groups_within(points: Floats, distance: float) -> Ints:
    """Return the number (N,) of the group of each point (N, D).

    Points are joined that differ by at most `distance` in every coordinate.
    """
    pairs = cKDTree(points).query_pairs(distance, p=np.inf, output_type="ndarray")
    return connected(pairs[:, 0], pairs[:, 1], len(points))
