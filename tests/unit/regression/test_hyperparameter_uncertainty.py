"""Intervals of parameters whose prior was chosen from the data: they hold the truth."""

import numpy as np
import pytest

from hilcal.identification.uncertainty import (
    HIDDEN,
    dropped_group_factors,
    hyperparameter_factors,
)
from hilcal.regression.projection import projection

LEARNT = 0.7


def covered(truth: np.ndarray, campaigns: int = 4000) -> tuple[float, float]:
    """Share of 95 % intervals that hold the truth, of pairs that were learnt: as chosen, widened.

    A pair is measured with unit noise; its prior variance is that of most evidence.
    """
    rng = np.random.default_rng(0)
    inside, wide, count = 0, 0, 0
    for _ in range(campaigns):
        z = truth + rng.normal(size=2)
        variance = float(z @ z) / 2 - 1
        if variance <= 0:
            continue
        shrunk = variance / (1 + variance)
        std = np.sqrt(shrunk)
        if std >= LEARNT * np.sqrt(variance):
            continue
        prior = np.full(2, np.sqrt(variance))
        factor = hyperparameter_factors(
            shrunk * np.eye(2), shrunk * z, prior, np.zeros(2, dtype=np.int64)
        )
        off = np.abs(shrunk * z - truth)
        count += 2
        inside += int((off < 1.96 * std).sum())
        wide += int((off < 1.96 * std * factor).sum())
    return inside / count, wide / count


@pytest.mark.parametrize(
    "truth",
    [
        (0, 0),
        (3, 3),
        *(
            pytest.param(further, marks=pytest.mark.long)
            for further in ((1, 0), (1, 1), (2, 0), (2, 2), (3, 0), (8, 2))
        ),
    ],
)
def test_intervals_hold_the_truth_about_as_often_as_stated(truth):
    as_chosen, wide = covered(np.array(truth, dtype=float))
    assert wide >= as_chosen
    assert 0.915 <= wide <= 0.99
    if truth == (0, 0):  # what noise alone brought in is the worst case
        assert as_chosen < 0.9


def test_a_strong_group_is_hardly_widened_and_a_flat_parameter_not_at_all():
    covariance, theta = np.diag([0.01, 0.01, 1.0]), np.array([30.0, -20.0, 2.0])
    prior, groups = np.array([25.0, 25.0, np.inf]), np.array([0, 0, -1])
    factor = hyperparameter_factors(covariance, theta, prior, groups)
    np.testing.assert_allclose(factor, 1.0, atol=2e-3)
    assert factor[2] == 1.0


def test_a_change_of_units_changes_nothing():
    rng = np.random.default_rng(1)
    a = rng.normal(size=(4, 3))
    covariance = np.linalg.inv(a.T @ a + np.eye(3) / 0.5**2)
    theta, prior, groups = rng.normal(size=3), np.full(3, 0.5), np.zeros(3, dtype=np.int64)
    plain = hyperparameter_factors(covariance, theta, prior, groups)
    scaled = hyperparameter_factors(1e-10 * covariance, 1e-5 * theta, 1e-5 * prior, groups)
    np.testing.assert_allclose(plain, scaled, rtol=1e-9)
    assert (plain > 1.0).any()


def test_groups_are_taken_one_by_one():
    covariance = np.diag([0.3, 0.2, 0.4, 0.1])
    theta, prior = np.array([0.5, 0.4, 1.0, -0.8]), np.array([0.7, 0.7, 1.1, 1.1])
    together = hyperparameter_factors(covariance, theta, prior, np.array([0, 0, 1, 1]))
    first = hyperparameter_factors(covariance[:2, :2], theta[:2], prior[:2], np.array([0, 0]))
    np.testing.assert_allclose(together[:2], first)
    dropped = hyperparameter_factors(
        covariance, theta, np.where([1, 1, 0, 0], prior, 0.0), np.array([0, 0, 1, 1])
    )
    np.testing.assert_allclose(dropped[2:], 1.0)


def test_what_a_dropped_group_could_do_widens_what_it_is_confused_with():
    rng = np.random.default_rng(2)
    kept = rng.normal(size=(200, 3))
    like_first = 0.9 * kept[:, [0]] + 0.3 * rng.normal(size=(200, 1))
    apart = rng.normal(size=(200, 1))
    apart -= kept @ np.linalg.lstsq(kept, apart, rcond=None)[0]
    dropped, groups = np.hstack([like_first, apart]), np.array([0, 1])
    h = kept.T @ kept
    factor = dropped_group_factors(np.eye(3), projection(kept, np.zeros(3)), dropped, groups, 1.0)
    assert factor[0] > 1.5
    assert np.all(factor[1:] < 1.1)
    # As if the dropped ones were in the model, with a prior of their size.
    inverse = np.linalg.inv(h)
    free = dropped - kept @ inverse @ kept.T @ dropped
    prior = np.sum(free**2, axis=0) / HIDDEN
    full = np.hstack([kept, dropped])
    joint = np.linalg.inv(full.T @ full + np.diag([0.0, 0.0, 0.0, *prior]))
    np.testing.assert_allclose(factor, np.sqrt(np.diag(joint)[:3] / np.diag(inverse)), rtol=1e-6)


def test_a_dropped_column_that_others_stand_for_altogether_changes_nothing():
    kept = np.random.default_rng(3).normal(size=(50, 2))
    p, copy = projection(kept, np.zeros(2)), kept @ np.array([[1.0], [2.0]])
    factor = dropped_group_factors(np.eye(2), p, copy, np.array([0]), 1.0)
    np.testing.assert_allclose(factor, 1.0)
