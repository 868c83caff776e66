"""Groups of what is connected."""

import numpy as np

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
