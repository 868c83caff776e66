"""The covariance of a reading: instrument, repeats, and the scatter of the joints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hilcal.errors import InputError
from hilcal.readings.covariance import (
    TrackerNoise,
    covariance_of_mean,
    expected_share_of_mean,
    joint_scatter,
    tracker_covariance,
)
from hilcal.robot import se3

NOISE = TrackerNoise(10e-6, 0.3e-6, 15e-6, 6e-6, 1e-4)

points = arrays(np.float64, (4, 3), elements=st.floats(-10, 10)).filter(
    lambda p: np.linalg.norm(p, axis=1).min() > 0.1
)
vectors = arrays(np.float64, 3, elements=st.floats(-3, 3))


@given(points, vectors)
def test_only_the_position_from_the_station_matters(p, station):
    moved = tracker_covariance(p + station, NOISE, station)
    np.testing.assert_allclose(moved, tracker_covariance(p, NOISE), rtol=1e-9, atol=1e-20)


def test_it_is_the_first_order_covariance_of_azimuth_elevation_and_range():
    p = np.array([[2.0, -1.0, 0.5]])
    d = np.linalg.norm(p)
    azimuth, elevation = np.arctan2(p[0, 1], p[0, 0]), np.arcsin(p[0, 2] / d)

    def point(az, el, r):
        c = np.cos(el)
        return r * np.array([c * np.cos(az), c * np.sin(az), np.sin(el)])

    h, at = 1e-6, np.array([azimuth, elevation, d])
    jac = np.stack([(point(*(at + e)) - point(*(at - e))) / (2 * h) for e in h * np.eye(3)], axis=1)
    t, r = 15e-6 + 6e-6 * d, 10e-6 + 0.3e-6 * d
    sigma = np.array([t / (d * np.cos(elevation)), t / d, r])
    np.testing.assert_allclose(
        tracker_covariance(p, NOISE)[0], jac @ np.diag(sigma**2) @ jac.T, rtol=1e-7, atol=1e-18
    )


def test_pose_covariance_adds_the_rotation_block():
    p = np.array([[1.0, 2.0, 3.0], [0.0, -1.0, 0.0]])
    cov = tracker_covariance(p, NOISE, m=6)
    np.testing.assert_array_equal(cov[:, :3, :3], tracker_covariance(p, NOISE))
    np.testing.assert_array_equal(cov[:, 3:, 3:], np.tile(1e-8 * np.eye(3), (2, 1, 1)))
    assert not cov[:, :3, 3:].any()


def test_what_no_instrument_has_is_refused():
    with pytest.raises(InputError, match="range_std = -1"):
        TrackerNoise(-1.0, 0.0, 1e-5, 0.0)
    with pytest.raises(InputError, match="transverse_std"):
        TrackerNoise(1e-5, 0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="orientation_std = nan"):
        TrackerNoise(1e-5, 0.0, 1e-5, 0.0, float("nan"))
    with pytest.raises(InputError, match="reading 2 lies at the tracker's station"):
        tracker_covariance(np.array([[1.0, 0, 0], [1.0, 1, 1]]), NOISE, (1.0, 1.0, 1.0))
    with pytest.raises(InputError, match="orientation_std is 0"):
        tracker_covariance(np.ones((1, 3)), TrackerNoise(1e-5, 0.0, 1e-5, 0.0), m=6)


def test_joint_scatter_is_its_formula_and_turns_with_the_base():
    rng = np.random.default_rng(5)
    jac, std = rng.normal(size=(4, 6, 7)), rng.uniform(1e-5, 5e-5, 7)
    turn = se3.rotation(rng.normal(size=(4, 3)))
    both = np.zeros((4, 6, 6))
    both[:, :3, :3] = both[:, 3:, 3:] = turn
    expected = both @ jac @ np.diag(std**2) @ np.swapaxes(jac, 1, 2) @ np.swapaxes(both, 1, 2)
    whole = joint_scatter(jac, std, turn, 6)
    np.testing.assert_allclose(whole, expected, rtol=1e-12, atol=1e-24)
    np.testing.assert_array_equal(joint_scatter(jac, std, turn, 3), whole[:, :3, :3])


def test_the_mean_keeps_the_expected_share_of_what_is_stated():
    """A scatter of just the random part makes s Σ + (1 - s) Σ / K; then nothing is learnt."""
    stated, samples, share = np.diag([1.0, 4.0, 9.0]) * 1e-10, 6, 0.3
    basis = np.sqrt((samples - 1) * (1 - share)) * np.linalg.cholesky(stated).T
    scatter = np.vstack([basis, np.zeros((samples - 3, 3))])
    expected = expected_share_of_mean(samples, share) * stated
    found = covariance_of_mean(stated, scatter, share)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-24)
