"""Rehearsals: feasible, spread, ordered in time; and the readings and their noise that come out."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.injected_effects import world_without_effect
from hilcal.readings.readings import States
from studies.random_campaigns import rehearsal_states
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusal
from tests.support.rehearsed import dead_weights

CELL = ur10e_cell()
WEIGHTS = dead_weights([5.0, 10.0], CELL.gravity)


def rehearse(seed=0, n=12, **options):
    return rehearsal_states(CELL, n, WEIGHTS, np.random.default_rng(seed), **options)


def test_every_pose_is_seen_unloaded_first_and_then_under_each_load():
    states, pose, load, cycle = rehearse(cycles=2)
    assert len(states) == len(pose) == len(load) == len(cycle) == 2 * 12 * 3
    assert load.tolist() == [0, 1, 2] * 24
    np.testing.assert_array_equal(np.any(states.wrench != 0.0, axis=1), load > 0)
    np.testing.assert_allclose(states.wrench[load == 2, 2], -10.0 * 9.80665)
    for p in range(12):
        assert np.ptp(states.q[pose == p], axis=0).max() == 0.0
        assert set(cycle[pose == p]) == {0, 1}
    assert np.diff(states.time).min() >= 20.0


@pytest.mark.parametrize(
    ("poses", "wrenches", "message"),
    [
        (0, WEIGHTS, "0 poses"),
        (5, [("10kg", np.zeros(3))], "load '10kg'"),
        (5, [("10kg", np.full(6, np.nan))], "load '10kg'"),
        (5, [("none", np.ones(6))], "load 'none'"),
        (5, dead_weights([400.0], CELL.gravity), "only 0 of 5 feasible poses"),
    ],
)
def test_impossible_rehearsals_are_refused(poses, wrenches, message):
    refusal(message, rehearsal_states, CELL, poses, wrenches, np.random.default_rng(0))


DRAWS = 4000


@pytest.mark.parametrize(("m", "known"), [(3, False), (6, False), (6, True)])
def test_sample_covariance_is_the_reported_one(m, known):
    world = world_without_effect(ur10e_cell(registration_known=known), np.random.default_rng(4))
    q = np.array([0.4, -1.2, 1.3, -0.4, 0.9, 0.3])
    states = States(np.tile(q, (DRAWS, 1)), np.tile([0.0, 0, -90, 0, 0, 0], (DRAWS, 1)))
    sight = world.ideal_readings(states[:1])
    cov = world.covariance(sight, m)[0]
    value = world.observe(states, np.random.default_rng(5), m)
    off = value[:, :3] - sight.position
    if m == 6:
        seen = Rotation.from_rotvec(value[:, 3:]) * Rotation.from_matrix(sight.rotation[0]).inv()
        off = np.hstack([off, seen.as_rotvec()])
    white = np.linalg.solve(np.linalg.cholesky(cov), off.T)
    low, high = stats.chi2.ppf([0.001, 0.999], DRAWS * m)
    assert low < np.sum(white**2) < high
    # each element of the whitened sample covariance has a deviation of 1 or √2 over √DRAWS
    np.testing.assert_allclose(white @ white.T / DRAWS, np.eye(m), atol=4.5 * np.sqrt(2 / DRAWS))
    np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=4.5 / np.sqrt(DRAWS))
