"""Power of the test of a family: inverse, limit for known noise, share of rejections."""

import numpy as np
import pytest
from scipy import stats

from hilcal.regression.evidence import family_power, noncentrality_of_power, power_of_test


@pytest.mark.parametrize("rank", [1, 4, 20])
@pytest.mark.parametrize("level", [1e-5, 0.01])
def test_the_noncentrality_is_that_of_the_power(rank: int, level: float) -> None:
    value = noncentrality_of_power(rank, 60.0, level, 0.9)
    assert power_of_test(value, rank, 60.0, level) == pytest.approx(0.9, abs=1e-4)


def test_without_a_family_the_power_is_the_level_and_known_noise_is_the_limit() -> None:
    assert power_of_test(0.0, 3, 50.0, 0.01) == pytest.approx(0.01)
    few, many, known = (power_of_test(12.0, 3, rest, 0.01) for rest in (20.0, 1e6, np.inf))
    assert few < many == pytest.approx(known, rel=1e-4)
    assert family_power(np.zeros((2, 2)), np.ones(2), 0.01) == 0.01


def test_the_power_is_the_share_of_rejections() -> None:
    rng = np.random.default_rng(5)
    b, x = rng.standard_normal((30, 5)), rng.standard_normal((30, 3))
    beta = np.array([0.6, -0.4, 0.3])
    m = np.eye(30) - b @ np.linalg.pinv(b)
    promised = family_power(x.T @ m @ x, beta, 0.01, dof=25.0)
    y = m @ (x @ beta + rng.standard_normal((4000, 30))).T
    q = np.linalg.qr(m @ x)[0]
    gain, total = np.sum((q.T @ y) ** 2, axis=0), np.sum(y**2, axis=0)
    rejected = np.mean(gain / 3 / ((total - gain) / 22) > stats.f.isf(0.01, 3, 22))
    assert 0.2 < promised < 0.9
    assert abs(rejected - promised) < 4 * np.sqrt(promised * (1 - promised) / 4000)
