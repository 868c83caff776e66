"""Rehearsals: feasible, spread, ordered in time; and the readings and their noise that come out."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from hilcal.drivers.simulated.injected_effects import hide_effect, world_without_effect
from hilcal.drivers.simulated.rehearsal import simulate
from hilcal.drivers.simulated.world import SimulatedNoise
from hilcal.readings.readings import States
from studies.random_campaigns import rehearsal_states
from tests.support.example_cell import ur10e_cell
from tests.support.refusals import refusal
from tests.support.rehearsed import dead_weights

CELL = ur10e_cell()
WEIGHTS = dead_weights([5.0, 10.0], CELL.gravity)
NAMES = ("none", *(name for name, _ in WEIGHTS))


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


def test_loads_hang_for_seconds_or_minutes_and_never_since_before_the_last_reading():
    states, _, load, _ = rehearse(n=60)
    hung = states.load_time
    assert hung.min() >= 4.999
    assert hung.max() <= 300.001
    assert np.all(hung[1:] < np.diff(states.time))
    decades = np.log(hung / 5.0) / np.log(60.0)  # uniform from 0 to 1, whatever hangs
    for which in range(3):
        of_load = decades[load == which]
        assert of_load.mean() == pytest.approx(0.5, abs=4.0 * np.sqrt(1 / 12 / len(of_load)))
        assert of_load.std() == pytest.approx(np.sqrt(1 / 12), rel=0.25)


def test_joints_warm_up_each_by_its_own_and_the_air_drifts():
    states, _, _, _ = rehearse(n=40)
    warm, hall = states.joint_temperature, states.air_temperature
    assert warm.shape == states.q.shape
    assert np.abs(warm[0] - 22.0).max() < 1.5
    risen = warm[-5:].mean(axis=0) - 22.0
    assert risen.min() > 4.0
    assert risen.max() < 20.5
    assert np.ptp(risen) > 1.0
    assert np.corrcoef(warm.T).min() > 0.5
    lasted = np.diff(states.time)
    # at most 20 °C with a time constant of 1500 s, and six of the sensor's sigmas
    assert np.all(np.abs(np.diff(warm, axis=0)) < lasted[:, None] * 20 / 1500 + 6 * 0.07)
    assert len(np.unique(hall)) == len(hall)
    assert 0.3 < np.ptp(hall) < 6.0
    assert np.abs(hall - 22.0).max() < 6.0
    # the quickest is the air conditioning, 0.25 °C in a period of 1200 s
    assert np.all(np.abs(np.diff(hall)) < lasted * 0.0022 + 6 * 0.03)


def test_poses_are_feasible_and_spread():
    states, pose, _, _ = rehearse(n=20)
    sight = replace(world_without_effect(CELL, np.random.default_rng(0)), registration=np.eye(4))
    target = sight.ideal_readings(states).position
    assert target[:, 2].min() > 0.1
    assert np.hypot(target[:, 0], target[:, 1]).min() > 0.15
    assert np.all(np.abs(states.q) <= 0.9 * np.pi)
    assert np.abs(sight.drive_torque(states) / CELL.arm.torque_max).max() < 0.95
    unique = states.q[np.unique(pose, return_index=True)[1]]
    apart = np.linalg.norm(np.exp(1j * unique[:, None]) - np.exp(1j * unique[None]), axis=2)
    assert apart[~np.eye(20, dtype=bool)].min() > 0.8


def test_approach_sides_follow_the_motion_and_change_with_the_load():
    states, _, load, _ = rehearse(n=40)
    assert set(np.unique(states.approach)) == {-1.0, 1.0}
    moved = np.diff(states.q[load == 0], axis=0)
    np.testing.assert_array_equal(states.approach[load == 0][1:], np.sign(moved))
    by_load = states.approach.reshape(40, 3, 6)
    changed = np.mean(by_load[:, 1] != by_load[:, 0])
    assert 0.1 < changed < 0.5
    assert rehearse(approach=False)[0].approach is None


@pytest.mark.parametrize("m", [3, 6])
def test_readings_scatter_about_the_truth_within_their_covariance(m):
    states, pose, load, cycle = rehearse(n=30)
    world = world_without_effect(CELL, np.random.default_rng(1))
    readings = simulate(world, states, pose, load, cycle, NAMES, np.random.default_rng(2), m)
    assert readings.m == m
    assert readings.load_names == NAMES
    assert readings.pose_names[-1] == "p30"
    np.testing.assert_array_equal(readings.unloaded, load == 0)
    np.testing.assert_allclose(readings.covariance, np.swapaxes(readings.covariance, 1, 2))
    off = readings.value - world.ideal_readings(states).value(m)
    white = np.linalg.solve(np.linalg.cholesky(readings.covariance[:, :3, :3]), off[:, :3, None])
    assert np.mean(white**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / white.size))


def test_the_same_seed_measures_the_same():
    def once(seed):
        rng = np.random.default_rng(seed)
        states, pose, load, cycle = rehearsal_states(CELL, 8, WEIGHTS, rng)
        world = hide_effect("hysteresis", CELL, states, 3.0, "deflection", rng)
        return simulate(world, states, pose, load, cycle, NAMES, rng)

    np.testing.assert_array_equal(once(3).value, once(3).value)
    assert np.any(once(3).value != once(4).value)


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
        in_sight = (
            Rotation.from_rotvec(value[:, 3:]) * Rotation.from_matrix(sight.rotation[0]).inv()
        )
        off = np.hstack([off, in_sight.as_rotvec()])
    white = np.linalg.solve(np.linalg.cholesky(cov), off.T)
    low, high = stats.chi2.ppf([0.001, 0.999], DRAWS * m)
    assert low < np.sum(white**2) < high
    # each element of the whitened sample covariance has a deviation of 1 or √2 over √DRAWS
    np.testing.assert_allclose(white @ white.T / DRAWS, np.eye(m), atol=4.5 * np.sqrt(2 / DRAWS))
    np.testing.assert_allclose(white.mean(axis=1), 0.0, atol=4.5 / np.sqrt(DRAWS))


@pytest.mark.parametrize("position", [[2.5, 1.0, -0.4], [0.0, 0.0, 2.0], [-1.0, 0.0, 0.3]])
def test_covariance_is_an_ellipsoid_along_the_line_of_sight(position):
    noise = SimulatedNoise(range_std=(1e-6, 1e-6), transverse_std=(2e-6, 5e-6))
    point = np.array([position])
    distance = np.linalg.norm(position)
    value, vector = np.linalg.eigh(noise.covariance(point, 3)[0])
    assert np.sqrt(value[0]) == pytest.approx(1e-6 + 1e-6 * distance)
    assert np.sqrt(value[1:]) == pytest.approx(2e-6 + 5e-6 * distance)
    assert abs(vector[:, 0] @ position) / distance == pytest.approx(1.0)
