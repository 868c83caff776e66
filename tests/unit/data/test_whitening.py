"""Every term of a covariance, and whitening by it."""

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
from hilcal.readings.whitening import MODES, measured_values, whitening, whitening_matrix
from hilcal.robot import se3
from tests.support.readings_cases import readings_at
from tests.support.refusals import refusal

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


def test_what_no_instrument_has_is_refused():
    for figures, words in (
        ((-1.0, 0.0, 1e-5, 0.0), "range_std = -1"),
        ((1e-5, 0.0, 0.0, 0.0), "transverse_std"),
        ((1e-5, 0.0, 1e-5, 0.0, float("nan")), "orientation_std = nan"),
    ):
        refusal(words, TrackerNoise, *figures)
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
    covariance = covariance_of_mean(stated, scatter, share)
    np.testing.assert_allclose(covariance, expected, rtol=1e-12, atol=1e-24)


seeds = st.integers(0, 2**32 - 1)
sizes = st.sampled_from([3, 6])


def spd(rng, count, k, decades=3.0):
    """Covariances (count, k, k) of full rank; standard deviations over some decades."""
    b = rng.standard_normal((count, k, k))
    std = 10 ** rng.uniform(-decades, decades, (count, k))
    return std[:, :, None] * (b @ np.swapaxes(b, 1, 2) + 0.1 * np.eye(k)) * std[:, None, :]


def random_units(rng, k):
    """Factors (k,) such as from m to mm."""
    return np.asarray(10 ** rng.uniform(-6, 6, k))


def make_readings(pose, cycle, load, value, covariance):
    """Readings with load 0 the unloaded state."""
    q = np.zeros((len(pose), 6))
    return readings_at(q, value, pose=pose, cycle=cycle, load=load, covariance=covariance)


def random_readings(rng, m, decades=3.0):
    """Poses in random order, 1-2 cycles, 1-3 unloaded and 1-4 loaded readings in each."""
    rows = []
    for pose in range(int(rng.integers(1, 6))):
        for cycle in range(int(rng.integers(1, 3))):
            rows += [(pose, cycle, 0)] * int(rng.integers(1, 4))
            rows += [(pose, cycle, load) for load in range(1, int(rng.integers(2, 6)))]
    table = rng.permutation(np.array(rows, dtype=np.int64))
    value = rng.standard_normal((len(rows), m))
    value[:, 3:] *= 0.1
    return make_readings(
        table[:, 0], table[:, 1], table[:, 2], value, spd(rng, len(rows), m, decades)
    )


@given(seeds, sizes)
def test_gc_whitens_and_gu_divides_by_the_standard_deviations(seed, k):
    v = spd(np.random.default_rng(seed), 4, k)
    f = whitening_matrix(v, "gc")
    identity = np.tile(np.eye(k), (4, 1, 1))
    np.testing.assert_allclose(f @ v @ np.swapaxes(f, 1, 2), identity, atol=1e-9)
    eps = np.random.default_rng(seed).standard_normal((4, k))
    white = (whitening_matrix(v, "gu") @ eps[:, :, None])[:, :, 0]
    std = np.sqrt(np.stack([np.diag(one) for one in v]))
    np.testing.assert_allclose(white, eps / std, rtol=1e-14)


def estimate(factor, a, y):
    """Least squares of the scaled regression, and its χ²; one measurement per factor."""
    count, k = factor.shape[:2]
    ga = (factor @ a.reshape(count, k, -1)).reshape(count * k, -1)
    gy = (factor @ y.reshape(count, k, 1)).ravel()
    c = np.linalg.lstsq(ga, gy, rcond=None)[0]
    return np.asarray(c), float(np.sum((gy - ga @ c) ** 2))


@pytest.mark.parametrize("scaling", ["gu", "gc"])
@given(seeds, sizes)
def test_change_of_units_changes_nothing(scaling, seed, k):
    rng = np.random.default_rng(seed)
    v, u = spd(rng, 6, k, decades=1.0), random_units(rng, k)
    a, y = rng.standard_normal((6, k, 3)), rng.standard_normal((6, k))
    c, chi2 = estimate(whitening_matrix(v, scaling), a, y)
    c_u, chi2_u = estimate(whitening_matrix(u[:, None] * v * u, scaling), u[:, None] * a, u * y)
    np.testing.assert_allclose(c_u, c, rtol=1e-7, atol=1e-7 * np.abs(c).max())
    assert chi2_u == pytest.approx(chi2, rel=1e-8)


@given(seeds, sizes, st.data())
def test_direction_without_noise_is_left_out(seed, k, data):
    rank = data.draw(st.integers(1, k - 1))
    rng = np.random.default_rng(seed)
    b = rng.standard_normal((k, rank)) * random_units(rng, k)[:, None]
    v = b @ b.T
    f = whitening_matrix(v, "gc")
    kept = np.any(f != 0, axis=1)
    assert np.all(np.isfinite(f))
    assert kept.sum() == rank
    np.testing.assert_allclose(f[kept] @ v @ f[kept].T, np.eye(rank), atol=1e-6)


@pytest.mark.parametrize("scaling", ["gu", "gc"])
@given(seeds, st.data())
def test_element_without_noise_is_left_out(scaling, seed, data):
    dead = data.draw(st.lists(st.integers(0, 5), min_size=1, max_size=6, unique=True))
    v = spd(np.random.default_rng(seed), 1, 6)[0]
    v[dead], v[:, dead] = 0.0, 0.0
    f = whitening_matrix(v, scaling)
    assert np.all(np.isfinite(f))
    assert np.all(f[:, dead] == 0)
    assert np.any(f != 0, axis=1).sum() == 6 - len(dead)


@pytest.mark.parametrize("mode", MODES)
def test_rank_counts_what_carries_information(mode):
    """Three elements that lie in a plane that the instrument sees: two rows per measurement."""
    rng = np.random.default_rng(3)
    b = rng.standard_normal((3, 2)) * 1e-5
    covariance = np.tile(b @ b.T, (6, 1, 1))
    pose, load = np.repeat(np.arange(2), 3), np.tile(np.arange(3), 2)
    readings = make_readings(pose, np.zeros(6, np.int64), load, rng.random((6, 3)), covariance)
    w = whitening(readings, mode)
    assert w.rank == 2 * len(w)
    white = w.whiten(w.raw(readings.value))
    assert np.all(np.isfinite(white))
    assert np.count_nonzero(white) == w.rank


def whitened_covariance(readings, mode, scaling="gc"):
    """Covariance (D·m, D·m) of the whitened rows, by propagation from independent readings."""
    w = whitening(readings, mode, scaling)
    count, m = readings.value.shape
    unit_errors = np.eye(count * m).reshape(count, m, count * m)
    effect = w.whiten(w.raw(unit_errors)).reshape(-1, count, m)
    v = readings.covariance
    return np.asarray(np.einsum("anj,njk,bnk->ab", effect, v, effect, optimize=True))


@pytest.mark.parametrize("mode", MODES)
@given(seeds, sizes)
def test_all_whitened_rows_are_independent_with_unit_variance(mode, seed, m):
    """Exactly, by propagation from the readings: shared, repeated and uneven unloaded readings."""
    readings = random_readings(np.random.default_rng(seed), m, decades=1.0)
    w = whitening(readings, mode)
    total = whitened_covariance(readings, mode)
    np.testing.assert_allclose(total, np.eye(len(w) * m), atol=1e-8)
    assert w.rank == len(w) * m


@given(seeds, sizes)
def test_deflection_is_loaded_minus_mean_unloaded_of_pose_and_cycle(seed, m):
    r = random_readings(np.random.default_rng(seed), m)
    w = whitening(r, "deflection")
    raw = w.raw(r.value)
    assert sorted(w.reading) == list(np.flatnonzero(~r.unloaded))
    np.testing.assert_array_equal(w.group, r.pose[w.reading])
    for k, row in enumerate(w.reading):
        unloaded_alike = r.unloaded & (r.pose == r.pose[row]) & (r.cycle == r.cycle[row])
        np.testing.assert_allclose(
            raw[k], r.value[row] - r.value[unloaded_alike].mean(axis=0), atol=1e-12
        )
        expected = (
            r.covariance[row] + r.covariance[unloaded_alike].sum(axis=0) / unloaded_alike.sum() ** 2
        )
        np.testing.assert_allclose(w.covariance[k], expected, rtol=1e-12)


@given(seeds, sizes)
def test_absolute_readings_stand_for_themselves(seed, m):
    r = random_readings(np.random.default_rng(seed), m)
    w = whitening(r, "absolute")
    np.testing.assert_array_equal(w.reading, np.arange(len(r)))
    np.testing.assert_array_equal(w.raw(r.value), r.value)
    np.testing.assert_array_equal(measured_values(r, w), r.value)
    np.testing.assert_array_equal(w.covariance, r.covariance)


def test_pose_measured_only_unloaded_gives_no_deflection():
    pose, load = np.array([0, 0, 1]), np.array([0, 1, 0])
    covariance = spd(np.random.default_rng(0), 3, 3)
    r = make_readings(pose, np.zeros(3, np.int64), load, np.zeros((3, 3)), covariance)
    assert list(whitening(r, "deflection").reading) == [1]


@given(seeds)
def test_measured_rotation_is_that_from_unloaded_to_loaded(seed):
    rng = np.random.default_rng(seed)
    unloaded = rng.uniform(-1.5, 1.5, 3)
    turn = rng.uniform(-0.5, 0.5, 3)
    loaded = se3.rotation_vector(se3.rotation(turn) @ se3.rotation(unloaded))
    value = np.concatenate([np.zeros((2, 3)), np.stack([unloaded, loaded])], axis=1)
    r = make_readings(
        np.zeros(2, np.int64), np.zeros(2, np.int64), np.array([0, 1]), value, spd(rng, 2, 6)
    )
    np.testing.assert_allclose(
        measured_values(r, whitening(r, "deflection"))[0, 3:], turn, atol=1e-9
    )


def rotation_variance(unloaded, count=4000):
    """Variances (3,) of the whitened rotations of poses with some unloaded readings each."""
    rng = np.random.default_rng(5)
    std = 1e-4
    per = unloaded + 1
    attitude = se3.rotation(np.repeat(rng.uniform(-1.5, 1.5, (count, 3)), per, axis=0))
    noise = se3.rotation(std * rng.standard_normal((count * per, 3)))
    value = np.zeros((count * per, 6))
    value[:, 3:] = se3.rotation_vector(noise @ attitude)
    r = make_readings(
        np.repeat(np.arange(count), per),
        np.zeros(count * per, np.int64),
        np.tile(np.array([0] * unloaded + [1]), count),
        value,
        np.tile(std**2 * np.eye(6), (count * per, 1, 1)),
    )
    w = whitening(r, "deflection", "gu")
    return np.asarray(w.whiten(measured_values(r, w)).reshape(-1, 6)[:, 3:].var(axis=0))


def test_rotations_have_the_stated_noise():
    assert np.abs(rotation_variance(1) - 1).max() < 4 * np.sqrt(2 / 4000)
