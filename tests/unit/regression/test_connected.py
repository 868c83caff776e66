"""Groups of what is connected."""

import numpy as np
from scipy.sparse.csgraph import connected_components

from hilcal.regression.connected import connected, groups_within


def test_things_are_joined_also_through_others() -> None:
    group = connected(np.array([0, 3, 4]), np.array([3, 4, 0]), 6)
    assert len(set(group)) == 4
    assert group[0] == group[3] == group[4]


def test_points_are_joined_where_no_coordinate_differs_by_more() -> None:
    points = np.array([[0.0, 0.0], [0.9, -0.9], [1.8, -0.9], [4.0, 0.0], [4.0, 1.1]])
    group = groups_within(points, 1.0)
    assert group[0] == group[1] == group[2]
    assert len(set(group)) == 3


def test_groups_and_their_numbers_are_those_of_a_graph() -> None:
    rng = np.random.default_rng(3)
    for _ in range(60):
        count, size = int(rng.integers(1, 80)), int(rng.integers(1, 7))
        points = np.round(rng.standard_normal((count, size)), 1)[rng.integers(0, count, count)]
        distance = float(rng.choice([0.0, 1e-6, 0.1, 0.5]))
        near = np.all(np.abs(points[:, None] - points) <= distance, axis=2)
        expected = connected_components(near, directed=False)[1]
        assert np.array_equal(groups_within(points, distance), expected)


def test_nothing_is_in_no_group() -> None:
    assert len(groups_within(np.zeros((0, 6)), 1.0)) == 0
