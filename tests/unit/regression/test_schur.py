"""Schur complements, projections and groups of what is connected, against dense algebra."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

from hilcal.identification.folds import groups_within
from hilcal.regression.schur import (
    differentiable_schur_complement,
    eliminate,
    inverse_root,
    nuisance_inverse,
    positive_solve,
    projection,
    schur_complement,
)
from tests.support.regression_cases import KINDS, problem

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


@pytest.mark.parametrize("singular", [False, True])
def test_units_of_the_parameters_do_not_matter(singular):
    """Standard units of an arm's parameters differ by 1e9: rad/Nm beside m."""
    units = np.logspace(-5, 5, 8)[::-1]
    a, scaled = columns(singular=singular), columns(singular=singular, units=units)
    expected = schur_complement(a.T @ a, INTEREST) * np.outer(units[INTEREST], units[INTEREST])
    np.testing.assert_allclose(schur_complement(scaled.T @ scaled, INTEREST), expected, rtol=1e-9)


def test_many_matrices_at_once():
    m = np.stack([c.T @ c for c in (columns(singular=False), columns(singular=True))] * 2)
    stacked = schur_complement(m.reshape(2, 2, 8, 8), INTEREST)
    each = [schur_complement(one, INTEREST) for one in m]
    np.testing.assert_allclose(stacked.reshape(4, 3, 3), each, rtol=1e-13)


@pytest.mark.parametrize("singular", [False, True])
def test_the_inverse_root_is_one_of_the_pseudoinverse(singular):
    a = columns(singular=singular)
    m = a.T @ a
    t = inverse_root(m)
    inverse = t.T @ t
    np.testing.assert_allclose(m @ inverse @ m, m, atol=1e-11)
    assert np.linalg.matrix_rank(inverse) == (6 if singular else 8)
    y = nuisance_inverse(m, OTHERS)
    assert not y[INTEREST].any()
    assert not y[:, INTEREST].any()


def test_its_derivatives_by_the_information():
    a = columns(singular=False)
    m = a.T @ a
    rng = np.random.default_rng(0)
    h, k = (c.T @ c for c in rng.standard_normal((2, 3, 8)))
    g = np.diag([1.0, 2.0, 0.5])

    def value(t, u=0.0):
        return float(np.trace(g @ schur_complement(m + t * h + u * k, INTEREST)))

    at = differentiable_schur_complement(m, INTEREST)
    step = 1e-4
    gradient = at.lift @ g @ at.lift.T
    slope = (value(step) - value(-step)) / (2 * step)
    assert float(np.sum(gradient * h)) == pytest.approx(slope, rel=1e-7)
    bend = (
        value(step, step) - value(step, -step) - value(-step, step) + value(-step, -step)
    ) / (4 * step**2)  # fmt: skip
    expected = -2 * float(np.trace(gradient @ h @ at.inverse @ k))
    assert bend == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("ridge", [0.0, 0.7])
def test_elimination_gives_the_normal_equations_of_the_residual(ridge):
    a, y = columns(singular=False), np.random.default_rng(1).standard_normal(40)
    out, rest = slice(2, 5), np.array([0, 1, 5, 6, 7])
    x = np.vstack([a[:, out], np.sqrt(ridge) * np.eye(3)])
    wide, data = np.vstack([a, np.zeros((3, 8))]), np.append(y, np.zeros(3))
    p = np.eye(43) - x @ np.linalg.inv(x.T @ x) @ x.T
    g, b, square = eliminate(a.T @ a, a.T @ y, float(y @ y), out, ridge)
    np.testing.assert_allclose(g[np.ix_(rest, rest)], (wide.T @ p @ wide)[np.ix_(rest, rest)],
                               rtol=1e-11, atol=1e-11)  # fmt: skip
    np.testing.assert_allclose(b[rest], (wide.T @ p @ data)[rest], rtol=1e-11, atol=1e-11)
    assert square == pytest.approx(float(data @ p @ data), rel=1e-12)


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


@pytest.mark.parametrize("kind", KINDS)
def test_products_are_those_of_the_dense_matrix(kind):
    of = problem(kind)
    p, m = of.projection, of.dense
    np.testing.assert_allclose(p.project_out(of.x), m @ of.x, atol=1e-12)
    np.testing.assert_allclose(p.project_out(of.y), m @ of.y, atol=1e-12)
    np.testing.assert_allclose(p.information(of.x), of.x.T @ m @ of.x, rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("off", [0.0, 0.3])
def test_the_residual_does_not_depend_on_where_the_model_stands(kind, off):
    of = problem(kind)
    z = of.estimate + off
    residual = of.projection.residual(of.y - of.rows @ z, z)
    np.testing.assert_allclose(residual, of.dense @ of.y, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_columns_that_depend_on_each_other_count_once(scale):
    rng = np.random.default_rng(0)
    independent, y = rng.standard_normal((30, 3)), rng.standard_normal(30)
    double = scale * np.hstack(
        [independent, independent @ rng.standard_normal((3, 2)), np.zeros((30, 1))]
    )
    p, q = projection(double, np.zeros(6)), np.linalg.qr(independent)[0]
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
