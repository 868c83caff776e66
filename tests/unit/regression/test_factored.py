"""A matrix that is known by its factors has the products of the matrix that is written out."""

import numpy as np
import pytest

from hilcal.regression.factored import Factored, beside, gram, of_rows, ordered, scaled, written
from hilcal.regression.normal_equations import find_basis, normal_equations
from hilcal.types import Floats, Ints

COUNT, ROWS, SITES = 40, 6, 3


def made(seed: int, site: list[int], along: list[int], at: list[int]) -> tuple[Factored, Floats]:
    """A matrix, and the same written out by a loop."""
    rng = np.random.default_rng(seed)
    own = rng.normal(size=(COUNT * ROWS, len(at)))
    direction = rng.normal(size=(COUNT, ROWS, SITES))
    coefficient = rng.normal(size=(COUNT, len(along)))
    whole = np.empty((COUNT, ROWS, len(at) + len(along)))
    whole[:, :, at] = own.reshape(COUNT, ROWS, -1)
    for c, place in enumerate(along):
        whole[:, :, place] = direction[:, :, site[c]] * coefficient[:, [c]]
    f = Factored(
        own, np.array(at, int), direction, coefficient, np.array(site), np.array(along, int)
    )
    return f, whole.reshape(COUNT * ROWS, -1)


CASES = [
    made(1, [0, 0, 1, 1, 1, 2], [1, 2, 3, 4, 5, 6], [0, 7, 8]),
    made(2, [2, 0, 0, 1, 0], [6, 1, 3, 2, 5], [0, 4]),
    made(3, [1, 1, 2], [0, 1, 2], []),
]


def close(found: Floats, expected: Floats) -> None:
    size = float(np.abs(expected).max(initial=1e-300))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * size)


@pytest.mark.parametrize(("a", "dense"), CASES)
def test_products_are_those_of_the_matrix_written_out(a: Factored, dense: Floats) -> None:
    rng = np.random.default_rng(7)
    assert a.shape == dense.shape
    assert len(a) == len(dense)
    close(written(a), dense)
    close(gram(a), dense.T @ dense)
    for x in (rng.normal(size=a.shape[1]), rng.normal(size=(a.shape[1], 4))):
        close(a @ x, dense @ x)
    for b in (rng.normal(size=len(a)), rng.normal(size=(len(a), 4))):
        close(a.T @ b, dense.T @ b)
        close(b.T @ a, b.T @ dense)


@pytest.mark.parametrize(("a", "dense"), CASES)
def test_parts_are_those_of_the_matrix_written_out(a: Factored, dense: Floats) -> None:
    rng = np.random.default_rng(8)
    size = a.shape[1]
    kept = rng.random(size) < 0.6
    order: Ints = rng.permutation(size)
    close(a[:, kept], dense[:, kept])
    close(a[:, order[:2]], dense[:, order[:2]])
    close(written(a.restricted(kept)), dense[:, kept])
    close(written(ordered(a, order)), dense[:, order])
    close(written(scaled(a, np.arange(1.0, size + 1))), dense * np.arange(1.0, size + 1))
    some = np.repeat(rng.random(COUNT) < 0.3, ROWS)
    close(written(of_rows(a, some)), dense[some])
    close(gram(of_rows(a, some)), dense[some].T @ dense[some])
    flat, held = order[:1], np.sort(order[1:])
    turn, sigma = rng.normal(size=(1, 1)), rng.random(len(held))
    expected = np.hstack([dense[:, flat] @ turn, dense[:, held] * sigma])
    close(written(a.turned(flat, turn, held, sigma)), expected)


def test_matrices_side_by_side_need_not_have_the_same_directions() -> None:
    (a, left), (b, right) = CASES[0], CASES[1]
    for other in (b, right):
        found = beside(a, other)
        close(written(found), np.hstack([left, right]))
        close(gram(found), np.hstack([left, right]).T @ np.hstack([left, right]))
    close(written(beside(left, b)), np.hstack([left, right]))


@pytest.mark.parametrize(("a", "dense"), CASES[:2])
def test_the_linear_problem_is_the_same_by_factors(a: Factored, dense: Floats) -> None:
    rng = np.random.default_rng(9)
    prior = np.full(a.shape[1], 0.3)
    prior[a.at] = np.inf
    scale, target = np.ones(a.shape[1]), rng.normal(size=len(a))
    one, two = find_basis(a, scale, prior), find_basis(dense, scale, prior)
    close(one.transform, two.transform)
    found = normal_equations(a, target, one, gram(a))
    expected = normal_equations(dense, target, two, dense.T @ dense)
    close(found.gram, expected.gram)
    close(found.rhs, expected.rhs)
    close(found.solve(), expected.solve())
    close(written(one.rows(a)), written(two.rows(dense)))


@pytest.mark.parametrize(("a", "dense"), CASES)
def test_forms_of_measurements_are_those_of_the_matrix_written_out(
    a: Factored, dense: Floats
) -> None:
    root = np.random.default_rng(10).normal(size=(a.shape[1], a.shape[1]))
    whole = dense @ root.T @ root @ dense.T
    found = whole.reshape(COUNT, ROWS, COUNT, ROWS)[np.arange(COUNT), :, np.arange(COUNT)]
    close(a.forms(root), found)
