"""What a linear problem keeps for its next basis is what it would compute anew."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification.gauss_newton import LinearProblem, NewtonPoint, linear_problem
from hilcal.regression.normal_equations import find_basis, normal_equations


@pytest.mark.parametrize("dependent", [False, True])
def test_bases_and_normal_equations_of_one_problem_are_those_of_new_ones(dependent: bool) -> None:
    rng = np.random.default_rng(4)
    a, white = rng.normal(size=(300, 12)), rng.normal(size=300)
    a[:, 3] = a[:, 2] + (1e-3 if dependent else 1.0) * a[:, 3]
    scale = rng.uniform(0.5, 2.0, size=12)
    prior = np.where(np.arange(12) < 5, np.inf, rng.uniform(0.1, 1.0, size=12))
    point = NewtonPoint(np.zeros(12), np.zeros(12), float(white @ white), 300)

    def new() -> LinearProblem:
        return linear_problem(point, prior, a.copy(), white, 300, 1.0, whitened=True)

    kept = new()
    other = np.where(np.isinf(prior), prior, 1.0)
    fewer = np.where(np.arange(12) % 3 == 2, 0.0, prior)
    fewer[:5] = np.inf
    for p, spread in ((prior, 1.0), (other, 3.0), (prior, 3.0)):
        basis = kept.basis(scale, p, spread)
        expected = find_basis(a, scale, p, spread)
        np.testing.assert_array_equal(basis.transform, expected.transform)
        found, direct = kept.equations(basis), normal_equations(a, white, expected, a.T @ a)
        np.testing.assert_allclose(found.gram, direct.gram, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(found.rhs, direct.rhs, rtol=1e-12, atol=1e-12)
    basis = kept.basis(scale, prior, 3.0).restricted(fewer[kept.live] > 0)
    found = kept.restricted(fewer).equations(basis)
    alone = new().restricted(fewer)
    direct = replace(alone, _products={}).equations(basis)
    assert alone.a.shape[1] < 12
    np.testing.assert_allclose(found.gram, direct.gram, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.rhs, direct.rhs, rtol=1e-12, atol=1e-12)
