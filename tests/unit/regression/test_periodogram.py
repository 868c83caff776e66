"""Waves of several joints in a residual."""

import numpy as np

from hilcal.regression.periodogram import significant_waves

ORDERS = np.arange(20, 600)


def rows(rng, n=100, joints=3):
    angle = rng.uniform(-2.5, 2.5, (n, joints))
    moved = rng.standard_normal((n, 3, joints)) * 1e5  # in units of the noise per radian
    return angle, moved, rng.standard_normal((n, 3))


def test_waves_of_several_joints_are_found_beside_each_other():
    angle, moved, noise = rows(np.random.default_rng(1))
    hidden = [(0, 128, 2e-5), (2, 405, 1e-5), (2, 77, 2e-5)]
    waves = sum(moved[:, :, j] * (a * np.cos(k * angle[:, j] - 1.0))[:, None] for j, k, a in hidden)
    significant = significant_waves(angle, moved, noise + waves, ORDERS, 300.0, 1e-3)
    assert set(significant) == {(j, k) for j, k, _ in hidden}


def test_noise_of_any_size_shows_a_wave_as_rarely_as_stated():
    rng, false = np.random.default_rng(2), 0
    for k in range(200):
        angle, moved, noise = rows(rng, n=30, joints=2)
        size = 10.0 ** (k % 5 - 2)
        false += bool(significant_waves(angle, moved, size * noise, ORDERS, 90.0, 0.05))
    assert false <= 20  # 10 expected at most, standard deviation 3


def test_of_waves_that_are_the_same_at_all_angles_the_slowest_is_found():
    rng = np.random.default_rng(3)
    angle = np.deg2rad(rng.integers(-28, 28, (200, 2)) * 5.0)  # k and 72 ± k, 144 ± k, ... agree
    moved, noise = rng.standard_normal((200, 3, 2)) * 1e5, rng.standard_normal((200, 3))
    waves = moved[:, :, 1] * (3e-5 * np.cos(100 * angle[:, 1]))[:, None]
    significant = significant_waves(angle, moved, noise + waves, ORDERS, 600.0, 1e-3)
    assert significant == [(1, 28)]
