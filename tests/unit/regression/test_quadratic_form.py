"""Tail of a ratio of quadratic forms: against exact laws, Monte-Carlo, and far out."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import beta

from hilcal.regression.evidence import ratio_tail


def exact(k: int, dimension: int, level: float, c: float) -> float:
    """K equal eigenvalues: zᵀLz/zᵀz is `level` times a beta variable."""
    return float(beta.sf(c / level, k / 2, (dimension - k) / 2))


@pytest.mark.parametrize("k", [2, 5, 20, 80])
@pytest.mark.parametrize("dimension", [100, 400])
@pytest.mark.parametrize("level", [1.0, 1e-6, 3e4])
def test_equal_eigenvalues_are_a_beta_law(k, dimension, level):
    """A saddlepoint approximation is right to a few per cent of the tail, here checked to 5 %."""
    for p in (0.9, 0.5, 0.1, 1e-2, 1e-4, 1e-8, 1e-14):
        c = level * float(beta.isf(p, k / 2, (dimension - k) / 2))
        told = ratio_tail(np.full(k, level), dimension, c)
        assert told == pytest.approx(exact(k, dimension, level, c), rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_unequal_eigenvalues_agree_with_monte_carlo(seed):
    rng = np.random.default_rng(seed)
    k, dimension, draws = 15, 60, 200_000
    values = rng.exponential(size=k) ** 2
    squares = rng.chisquare(1, (draws, k))
    rest = rng.chisquare(dimension - k, draws)
    ratio = (squares @ values) / (squares.sum(axis=1) + rest)
    for p in (0.8, 0.3, 0.05, 0.01, 1e-3):
        c = float(np.quantile(ratio, 1 - p))
        # 4 σ of the Monte-Carlo share, and 3 % of the approximation.
        slack = 4 * np.sqrt(p * (1 - p) / draws) + 0.03 * p
        assert ratio_tail(values, dimension, c) == pytest.approx(p, abs=slack)


@pytest.mark.long
@given(
    st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=12),
    st.integers(2, 300),
    st.floats(1e-6, 1e6),
)
def test_it_is_a_probability_that_falls_and_has_no_unit(values, extra, unit):
    eigenvalues = np.array(values)
    dimension = len(values) + extra
    at = np.linspace(0.0, 1.0, 60) * eigenvalues.max()
    tail = np.array([ratio_tail(eigenvalues, dimension, c) for c in at])
    assert np.all((tail >= 0) & (tail <= 1))
    assert tail[0] == 1
    assert tail[-1] == 0
    # Monotone but for the approximation's own error near the middle.
    assert np.all(np.diff(tail) <= 1e-3)
    scaled = [ratio_tail(unit * eigenvalues, dimension, unit * c) for c in at]
    np.testing.assert_allclose(scaled, tail, rtol=1e-4, atol=1e-7)


def test_the_deep_tail_falls_without_a_step():
    """Where probabilities are too small for ordinary arithmetic, logarithms take over."""
    values = np.array([1.0, 0.8, 0.5, 0.1])
    at = np.linspace(0.3, 0.99, 200)
    tail = np.array([ratio_tail(values, 300, c) for c in at])
    steps = np.diff(np.log(tail[tail > 0]))
    assert np.all(steps < 0)
    # The logarithm of a log-concave tail bends; it does not jump.
    assert np.abs(np.diff(steps)).max() < 0.25 * np.abs(steps).max()
    assert tail.min() < 1e-100


def test_around_the_mean_it_is_continuous():
    """The formula is 0/0 at the mean; its neighbours are joined there."""
    values = np.array([2.0, 1.0, 0.5])
    dimension = 80
    mean = values.sum() / dimension
    at = mean * (1 + np.linspace(-1e-3, 1e-3, 401))
    tail = np.array([ratio_tail(values, dimension, c) for c in at])
    # A step of the grid is worth 2e-6, and rounding of the cancelling terms as much again.
    assert np.abs(np.diff(tail)).max() < 2e-5
    assert tail[0] > tail[200] > tail[-1]


def test_nothing_to_test_is_no_evidence():
    assert ratio_tail(np.zeros(0), 10, 0.1) == 1.0
    assert ratio_tail(np.zeros(3), 10, 0.1) == 1.0
    assert ratio_tail(np.ones(3), 10, 0.0) == 1.0
    assert ratio_tail(np.ones(3), 10, 1.0) == 0.0


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_no_more_dimensions_than_eigenvalues_and_any_scale(scale: float) -> None:
    lam = scale * np.array([1e-9, 0.5, 1.0, 1.0, 2.0])
    drawn = np.random.default_rng(0).standard_normal((20000, 5)) ** 2
    ratio = (drawn @ lam) / drawn.sum(axis=1)
    for c in scale * np.array([0.3, 0.9, 1.4]):
        assert ratio_tail(lam, 4.0, c) == pytest.approx(np.mean(ratio > c), abs=0.02)
    assert ratio_tail(np.full(5, scale), 5.0, 0.5 * scale) == 1.0
