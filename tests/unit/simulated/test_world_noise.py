"""The tracker's noise and the arm's repeatability: what is drawn is what is reported."""

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from drivers.simulated.injected_effects import nothing_hidden
from drivers.simulated.tracker import SimulatedNoise
from hilcal.readings.readings import States
from tests.support.example_cell import ur10e_cell

DRAWS = 4000


@pytest.mark.parametrize(("m", "known"), [(3, False), (6, False), (6, True)])
def test_sample_covariance_is_the_reported_one(m, known):
    world = nothing_hidden(ur10e_cell(registration_known=known), np.random.default_rng(4))
    q = np.array([0.4, -1.2, 1.3, -0.4, 0.9, 0.3])
    states = States(np.tile(q, (DRAWS, 1)), np.tile([0.0, 0, -90, 0, 0, 0], (DRAWS, 1)))
    sight = world.sight(states[:1])
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


@pytest.mark.parametrize("position", [[2.5, 1.0, -0.4], [0.0, 0.0, 2.0], [-1.0, 0.0, 0.3]])
def test_covariance_is_an_ellipsoid_along_the_line_of_sight(position):
    noise = SimulatedNoise(range_std=(1e-6, 1e-6), transverse_std=(2e-6, 5e-6))
    point = np.array([position])
    distance = np.linalg.norm(position)
    value, vector = np.linalg.eigh(noise.covariance(point, 3)[0])
    assert np.sqrt(value[0]) == pytest.approx(1e-6 + 1e-6 * distance)
    assert np.sqrt(value[1:]) == pytest.approx(2e-6 + 5e-6 * distance)
    assert abs(vector[:, 0] @ position) / distance == pytest.approx(1.0)
