"""Fleets drawn from the model: spreads within their sampling error, and who is unlike others."""

import numpy as np
import pytest
from scipy.stats import binom

from hilcal.regression.variance_components import FALSE_ALARM, FleetEstimates, hierarchy
from hilcal.types import Floats

ARMS, TIMES, SIZE = 30, 2, 6
BETWEEN = np.linspace(0.2, 1.0, SIZE)
WITHIN = 0.1


def fleet(
    seed: int, *, odd: tuple[int, int, float] | None = None, slope: float = 0.0
) -> tuple[FleetEstimates, Floats]:
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


def test_spreads_and_means_are_recovered_within_their_sampling_errors() -> None:
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


def test_an_arm_that_is_unlike_the_others_is_named_and_leaves_the_spread_alone() -> None:
    of, _ = fleet(3, odd=(7, 4, 8.0))
    h, named = hierarchy(of)
    assert [(o.unit, o.parameter) for o in named] == [(7, 4)]
    assert named[0].off == pytest.approx(8.0, abs=4 * BETWEEN[4])
    ordinary, _ = hierarchy(fleet(3)[0])
    assert np.sqrt(h.between[4]) == pytest.approx(np.sqrt(ordinary.between[4]), rel=0.1)


@pytest.mark.long
def test_in_ordinary_fleets_no_arm_is_named() -> None:
    fleets = 25
    alarms = sum(bool(hierarchy(fleet(100 + seed)[0])[1]) for seed in range(fleets))
    assert binom.sf(alarms - 1, fleets, FALSE_ALARM) > 1e-3


def test_common_drift_is_found_beside_the_changes_of_single_arms() -> None:
    of, _ = fleet(5, slope=0.3)
    h, _ = hierarchy(of)
    std = np.sqrt(np.diag(h.covariance)[SIZE:])
    assert abs(h.slope[2] - 0.3) < 4 * std[2]
    assert h.slope[2] > 5 * std[2]
    assert np.abs(np.delete(h.slope / std, 2)).max() < 4


def test_arms_measured_once_have_one_spread() -> None:
    of, _ = fleet(6)
    once = of.time == 0
    h, _ = hierarchy(
        FleetEstimates(of.mean[once], of.information[once], of.arm[once], of.time[once])
    )
    assert not h.within.any()
    assert not h.slope.any()
    assert h.between[5] > h.between[0]
