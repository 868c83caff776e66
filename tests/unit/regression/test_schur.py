"""Schur complements, projections and groups of what is connected, against dense algebra."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from hilcal.identification.folds import groups_within
from hilcal.regression.schur import (
    differentiable_schur_complement,
    inverse_root,
    positive_solve,
    projection,
    schur_complement,
)

INTEREST = np.array([0, 2, 5])
OTHERS = np.array([1, 3, 4, 6, 7])


def columns(*, singular, units=1.0):
    """(R, 8) columns; where singular, two of the nuisance columns are combinations of others."""
    a = np.random.default_rng(3).standard_normal((40, 8))
    if singular:
        a[:, 6] = a[:, 1] - 2 * a[:, 3]
        a[:, 7] = 0.0
    return a * units


def beyond(a, x):
    """Information on columns X when A is estimated as well, from residuals of least squares."""
    left = x - a @ np.linalg.lstsq(a, x, rcond=1e-9)[0]
    return left.T @ left


@pytest.mark.parametrize("singular", [False, True])
def test_it_is_the_information_of_the_residual_columns(singular):
    a = columns(singular=singular)
    expected = beyond(a[:, OTHERS], a[:, INTEREST])
    m = a.T @ a
    np.testing.assert_allclose(schur_complement(m, INTEREST), expected, rtol=1e-11)
    single = differentiable_schur_complement(m, INTEREST)
    np.testing.assert_allclose(single.matrix, expected, rtol=1e-11)
    np.testing.assert_allclose(single.lift.T @ m @ single.lift, expected, rtol=1e-11)
    some = beyond(a[:, OTHERS[:2]], a[:, INTEREST])
    np.testing.assert_allclose(schur_complement(m, INTEREST, OTHERS[:2]), some, rtol=1e-11)


@pytest.mark.parametrize("least", [1.0, 1e-6, 1e-11, 1e-14])
def test_solutions_follow_the_rule_for_singular_blocks(least):
    """By Cholesky's factor or by eigenvalues, whatever the condition and the units."""
    rng = np.random.default_rng(7)
    q = np.linalg.qr(rng.standard_normal((8, 8)))[0]
    units = 10.0 ** rng.uniform(-4, 4, 8)
    m = (q * np.geomspace(1.0, least, 8)) @ q.T
    m = (m + m.T) / 2 * np.outer(units, units)
    rhs = m @ (rng.standard_normal((8, 3)) / units[:, None])
    root = inverse_root(m)
    by_rule = root.T @ (root @ rhs)
    size = np.abs(by_rule * units[:, None]).max()
    off = (positive_solve(m, rhs) - by_rule) * units[:, None] / size
    assert np.abs(off).max() < 1e-15 / max(least, 1e-12)
    np.testing.assert_array_equal(positive_solve(m, rhs[:, 0]).shape, (8,))
    zero = m.copy()
    zero[3] = zero[:, 3] = 0.0
    root = inverse_root(zero)
    np.testing.assert_allclose(positive_solve(zero, rhs), root.T @ (root @ rhs), rtol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_columns_that_depend_on_each_other_count_once(scale):
    rng = np.random.default_rng(0)
    own, y = rng.standard_normal((30, 3)), rng.standard_normal(30)
    double = scale * np.hstack([own, own @ rng.standard_normal((3, 2)), np.zeros((30, 1))])
    p, q = projection(double, np.zeros(6)), np.linalg.qr(own)[0]
    np.testing.assert_allclose(p.project_out(y), y - q @ (q.T @ y), atol=1e-10)
    assert np.count_nonzero(np.any(p.inverse_root, axis=1)) == 3


def test_groups_and_their_numbers_are_those_of_a_graph():
    rng = np.random.default_rng(3)
    for _ in range(60):
        count, size = int(rng.integers(1, 80)), int(rng.integers(1, 7))
        points = np.round(rng.standard_normal((count, size)), 1)[rng.integers(0, count, count)]
        distance = float(rng.choice([0.0, 1e-6, 0.1, 0.5]))
        near = np.all(np.abs(points[:, None] - points) <= distance, axis=2)
        expected = connected_components(near, directed=False)[1]
        assert np.array_equal(groups_within(points, distance), expected)
