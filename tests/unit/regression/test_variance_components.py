"""REML: closed forms, a grid of the dense likelihood, many draws; fleets of units."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import binom

from hilcal.regression.variance_components import (
    FALSE_ALARM,
    BlockRows,
    FleetEstimates,
    find_outliers,
    hierarchy,
    variance_components,
)


def one_way(groups, size, between, seed):
    """Groups with a common normal shift of variance `between`, unit noise, and a mean."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((groups, size)) + np.sqrt(between) * rng.standard_normal((groups, 1))
    ones = np.ones((1, groups, size, size))
    return BlockRows(y + 5.0, np.ones((groups, size, 1)), ones)


@pytest.mark.parametrize("between", [0.0, 0.5, 40.0])
def test_the_balanced_layout_has_a_closed_form(between):
    """With known noise, 1 + n s is the variance of √n times the groups' means, mean free."""
    b = one_way(30, 4, between, 3)
    means = 2.0 * b.y.mean(axis=1)
    closed = max((float(np.var(means, ddof=1)) - 1.0) / 4.0, 0.0)
    estimate = variance_components([b], np.zeros(1))
    assert estimate.variance[0] == pytest.approx(closed, rel=2e-3, abs=1e-6)
    if closed > 0:
        std = np.sqrt(2 / 29) * (1 + 4 * closed) / 4
        assert np.sqrt(estimate.covariance[0, 0]) == pytest.approx(std, rel=0.02)


def dense(b, ridge, s):
    """The log of the marginal likelihood; columns without a prior integrated over all values."""
    size = b.y.size
    sigma = np.eye(size)
    for g, k in enumerate(b.components[0]):
        at = slice(g * len(k), (g + 1) * len(k))
        sigma[at, at] += s * k
    x = b.rows.reshape(size, -1)
    inverse = np.linalg.inv(sigma)
    h = x.T @ inverse @ x + np.diag(ridge)
    p = inverse - inverse @ x @ np.linalg.solve(h, x.T @ inverse)
    y = b.y.reshape(-1)
    return -0.5 * float(np.linalg.slogdet(sigma)[1] + np.linalg.slogdet(h)[1] + y @ p @ y)


def test_blocks_of_two_sizes_and_columns_with_priors_against_the_dense_likelihood():
    rng, parts = np.random.default_rng(1), []
    ridge = np.array([0.0, 0.0, 2.0])
    for groups, size in ((12, 3), (5, 6)):
        z = rng.standard_normal((1, groups, size, 2))
        y = rng.standard_normal((groups, size))
        y += 1.5 * (z[0] @ rng.standard_normal((groups, 2, 1)))[:, :, 0]
        rows = rng.standard_normal((groups, size, 3))
        parts.append(BlockRows(y, rows, z @ np.swapaxes(z, 2, 3)))
    # Both sizes as one block each, for the dense likelihood.
    size = sum(b.y.size for b in parts)
    k, at = np.zeros((1, 1, size, size)), 0
    for b in parts:
        for one in b.components[0]:
            k[0, 0, at : at + len(one), at : at + len(one)] = one
            at += len(one)
    y = np.concatenate([b.y.reshape(-1) for b in parts])[None]
    rows = np.concatenate([b.rows.reshape(-1, 3) for b in parts])[None]
    whole = BlockRows(y, rows, k)
    best = minimize_scalar(lambda s: -dense(whole, ridge, s), bounds=(0, 50), method="bounded")
    estimate = variance_components(parts, ridge)
    assert estimate.variance[0] == pytest.approx(best.x, rel=0.02)
    gain = dense(whole, ridge, float(best.x)) - dense(whole, ridge, 0.0)
    assert estimate.log_likelihood == pytest.approx(gain, abs=2e-3)


def test_two_components_are_told_apart_without_bias_and_their_uncertainty_is_right():
    rng, truth, z = np.random.default_rng(0), np.array([2.0, 0.5]), []
    rows = rng.standard_normal((40, 3, 30))
    components = np.stack([v[:, :, None] * v[:, None, :] for v in rng.standard_normal((2, 40, 3))])
    vectors = np.sqrt(np.einsum("cgii->cgi", components)) * np.sign(components[:, :, :, 0])
    for _ in range(60):
        y = rng.standard_normal((40, 3))
        y += np.einsum("cgi,c,cg->gi", vectors, np.sqrt(truth), rng.standard_normal((2, 40)))
        estimate = variance_components([BlockRows(y, rows, components)], np.zeros(30))
        z.append(estimate.variance)
    mean, error = np.mean(z, axis=0), np.std(z, axis=0) / np.sqrt(60)
    assert np.all(np.abs(mean - truth) < 4 * error)


@pytest.mark.parametrize("scale", [1e-8, 1e8])
def test_the_scale_of_a_component_does_not_matter(scale):
    b = one_way(30, 4, 2.0, 5)
    whole = variance_components([b], np.zeros(1))
    scaled = BlockRows(b.y, b.rows, scale * b.components)
    estimate = variance_components([scaled], np.zeros(1))
    assert scale * estimate.variance[0] == pytest.approx(whole.variance[0], rel=1e-3)


ARMS, TIMES, SIZE = 30, 2, 6
BETWEEN = np.linspace(0.2, 1.0, SIZE)
WITHIN = 0.1


def fleet(seed, *, odd=None, slope=0.0):
    """Campaigns of 30 arms, two months each; nobody determines parameter 0 of the first five."""
    rng = np.random.default_rng(seed)
    arm, time = np.repeat(np.arange(ARMS), TIMES), np.tile(np.arange(TIMES) / 1.0, ARMS)
    count = len(arm)
    mu, u = rng.normal(size=SIZE), BETWEEN * rng.normal(size=(ARMS, SIZE))
    if odd is not None:
        u[odd[0], odd[1]] += odd[2]
    theta = mu + u[arm] + WITHIN * rng.normal(size=(count, SIZE))
    theta[:, 2] += slope * time
    rows = 4 * rng.normal(size=(count, 20, SIZE)) @ (np.eye(SIZE) + 0.4)
    rows[:5, :, 0] = 0.0
    information = np.swapaxes(rows, 1, 2) @ rows
    noise = np.einsum("crk,cr->ck", rows, rng.normal(size=rows.shape[:2]))
    mean = theta + np.einsum("ckl,cl->ck", np.linalg.pinv(information, rcond=1e-12), noise)
    mean[:5, 0] = 99.0  # of no meaning
    return FleetEstimates(mean, information, arm, time), mu


def test_spreads_and_means_are_recovered_within_their_sampling_errors():
    means, spreads, within = [], [], []
    for seed in range(12):
        of, mu = fleet(seed)
        h, _ = hierarchy(of)
        std = np.sqrt(np.diag(h.covariance)[:SIZE])
        means.append((h.mu - mu) / std)
        spreads.append((np.sqrt(h.between) - BETWEEN) / h.between_std_error)
        within.append(np.sqrt(h.within))
    # 72 correlated values; their root mean square scatters by about a tenth
    assert 0.7 < np.sqrt(np.mean(np.square(means))) < 1.35
    assert np.sqrt(np.mean(np.square(spreads))) < 1.5
    assert np.mean(within) == pytest.approx(WITHIN, rel=0.15)


def test_an_arm_that_is_unlike_the_others_is_named_and_leaves_the_spread_alone():
    of, _ = fleet(3, odd=(7, 4, 8.0))
    h, named = hierarchy(of)
    assert [(o.unit, o.parameter) for o in named] == [(7, 4)]
    assert named[0].deviation == pytest.approx(8.0, abs=4 * BETWEEN[4])
    ordinary, _ = hierarchy(fleet(3)[0])
    assert np.sqrt(h.between[4]) == pytest.approx(np.sqrt(ordinary.between[4]), rel=0.1)


@pytest.mark.long
def test_in_ordinary_fleets_no_arm_is_named():
    fleets = 25
    alarms = sum(bool(hierarchy(fleet(100 + seed)[0])[1]) for seed in range(fleets))
    assert binom.sf(alarms - 1, fleets, FALSE_ALARM) > 1e-3


def test_common_drift_is_found_beside_the_changes_of_single_arms():
    of, _ = fleet(5, slope=0.3)
    h, _ = hierarchy(of)
    std = np.sqrt(np.diag(h.covariance)[SIZE:])
    assert abs(h.slope[2] - 0.3) < 4 * std[2]
    assert h.slope[2] > 5 * std[2]
    assert np.abs(np.delete(h.slope / std, 2)).max() < 4


def test_arms_measured_once_have_one_spread():
    of, _ = fleet(6)
    once = of.time == 0
    h, _ = hierarchy(
        FleetEstimates(of.mean[once], of.information[once], of.arm[once], of.time[once])
    )
    assert not h.within.any()
    assert not h.slope.any()
    assert h.between[5] > h.between[0]


def test_few_arms_name_what_is_twelve_spreads_off_where_spreads_are_alike():
    rng = np.random.default_rng(0)
    values = 0.1 * rng.normal(size=(6, 16))
    values[4, 0] += 1.2
    (named,) = find_outliers(values, np.full(values.shape, 1e-4))
    assert (named.unit, named.parameter) == (4, 0)
    assert named.deviation == pytest.approx(1.2, abs=0.3)
    # one parameter alone tells little of its spread: Student's t of four degrees of freedom
    assert not find_outliers(
        np.array([[0.0, 0.1, -0.1, 0.05, 0.6, -0.05]]).T, np.full((6, 1), 1e-6)
    )
