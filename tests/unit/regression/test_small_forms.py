"""Quadratic forms of small matrices are those by their eigenvalues."""

import numpy as np
import pytest

from hilcal.regression.small_forms import quadratic_forms


@pytest.mark.parametrize("m", [1, 3, 6])
def test_forms_are_those_by_eigenvalues_above_the_threshold(m: int) -> None:
    """Whole ranks and less, units that differ by 1e4, and matrices that rounding makes negative."""
    rng = np.random.default_rng(m)
    ranks = rng.integers(0, m + 1, 300)
    size = 10.0 ** rng.uniform(-2, 2, (300, m, 1))
    root = rng.normal(size=(300, m, m)) * (np.arange(m) < ranks[:, None])[:, None]
    a = (size * root) @ np.swapaxes(size * root, 1, 2)
    a -= 1e-13 * np.trace(a, axis1=1, axis2=2)[:, None, None] * np.eye(m)
    g = np.einsum("nij,nj->ni", a, rng.normal(size=(300, m)))
    threshold = 1e-6 * np.maximum(np.trace(a, axis1=1, axis2=2), 1e-300)
    values, vectors = np.linalg.eigh(a)
    kept = values > threshold[:, None]
    c = np.einsum("nij,ni->nj", vectors, g)
    expected = np.sum(np.where(kept, c**2 / np.where(kept, values, 1.0), 0.0), axis=1)
    assert 0 < np.count_nonzero(~kept.all(axis=1)) < 300
    np.testing.assert_allclose(quadratic_forms(a, g, threshold), expected, rtol=1e-8)
