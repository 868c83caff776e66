"""The spectrum of a family's information, small or kept as a product, against LAPACK's own."""

import numpy as np
import pytest

from hilcal.regression.evidence import score_family
from hilcal.regression.spectrum import LARGE, Spectrum, spectrum
from hilcal.types import Floats


def information(size: int, rank: int) -> Floats:
    """S (P, P) with eigenvalues over eight decades, and zeros beyond a rank."""
    rng = np.random.default_rng(size)
    x = rng.standard_normal((3 * size, size)) * np.logspace(2, -2, size)
    x[:, rank:] = x[:, :rank] @ rng.standard_normal((rank, size - rank))
    return np.asarray(x.T @ x)


@pytest.mark.parametrize(("size", "rank"), [(1, 1), (7, 5), (LARGE, LARGE), (LARGE + 30, LARGE)])
def test_products_with_eigenvectors_are_those_of_the_formed_ones(size: int, rank: int) -> None:
    s = information(size, rank)
    found, values = spectrum(s), np.linalg.eigvalsh(s)
    top = values[-1]
    np.testing.assert_allclose(found.values, values, atol=1e-13 * top)
    assert found.rank == rank
    u = found.vectors
    np.testing.assert_allclose(u.T @ u, np.eye(size), atol=1e-12)
    np.testing.assert_allclose((u * found.values) @ u.T, s, atol=1e-12 * top)
    g = np.random.default_rng(1).standard_normal(size)
    np.testing.assert_allclose(found.along(g), u.T @ g, atol=1e-12)
    np.testing.assert_allclose(found.combined(g), u @ g, atol=1e-12)


def test_scores_do_not_depend_on_how_eigenvectors_are_kept() -> None:
    size = LARGE + 12
    s = information(size, LARGE)
    values, vectors = np.linalg.eigh(s)
    formed = Spectrum(values, values > 1e-9 * values[-1], vectors)
    g = s @ np.random.default_rng(2).standard_normal(size) * 1e-2
    kept = spectrum(s)
    assert kept.reflections is not None
    for most in (np.inf, 0.05):
        a, b = (score_family(of, g, 1e5, 4000.0, most=most) for of in (kept, formed))
        assert (a.rank, a.strength, a.bounded) == (b.rank, b.strength, b.bounded)
        assert a.log_evidence == pytest.approx(b.log_evidence, rel=1e-9)
        assert a.p_value == pytest.approx(b.p_value, rel=1e-9)
        np.testing.assert_allclose(a.step, b.step, rtol=1e-7, atol=1e-9 * np.abs(b.step).max())
        spread = b.root @ b.root.T
        np.testing.assert_allclose(a.root @ a.root.T, spread, atol=1e-9 * np.abs(spread).max())
