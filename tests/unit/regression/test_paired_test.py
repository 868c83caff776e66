"""Signed ranks of paired errors, against SciPy and against every choice of signs."""

from itertools import product

import numpy as np
import pytest
from scipy.stats import wilcoxon

from hilcal.regression.paired_test import EXACT, signed_ranks


@pytest.mark.parametrize("count", [8, 20, EXACT, EXACT + 1, 300])
@pytest.mark.parametrize("shift", [-0.3, 0.0, 0.3])
def test_signed_ranks_are_those_of_scipy(count: int, shift: float) -> None:
    x = np.random.default_rng(count).normal(shift, 1.0, count)
    expected = wilcoxon(x, alternative="greater").pvalue
    assert signed_ranks(x) == pytest.approx(expected, rel=1e-9)
    assert signed_ranks(np.append(x, 0.0)) == signed_ranks(x)


def test_equal_sizes_are_judged_by_every_choice_of_signs() -> None:
    size = np.array([1.0, 1.0, 2.0, 3.0, 3.0, 3.0, 5.0, 8.0])
    rank = np.array([1.5, 1.5, 3.0, 5.0, 5.0, 5.0, 7.0, 8.0])
    signs = np.array(list(product([-1.0, 1.0], repeat=8)))
    sums = (signs > 0) @ rank
    for x in signs[::37] * size:
        assert signed_ranks(x) == pytest.approx(np.mean(sums >= (x > 0) @ rank), rel=1e-12)


def test_many_equal_sizes_are_as_those_of_scipy() -> None:
    x = np.round(np.random.default_rng(1).normal(0.2, 1.0, 200), 1)
    expected = wilcoxon(x, alternative="greater", method="asymptotic").pvalue
    assert signed_ranks(x) == pytest.approx(expected, rel=1e-9)
