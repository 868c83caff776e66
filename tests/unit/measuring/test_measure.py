"""What an average of the tracker says and when it is at rest; what the force sensor weighs."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_law

from hilcal.errors import CannotAnswerError, DeviceError
from hilcal.measuring.devices import TrackerSample
from hilcal.measuring.force import compare, identify_tool_load, tare
from hilcal.measuring.measure import SettleWindow, average, deviations
from tests.support.refusals import refusal, refusal_of
from tests.support.rows import first

AXES = Rotation.from_rotvec([0.4, -0.2, 0.9]).as_matrix()
V = AXES @ np.diag([5e-6, 15e-6, 15e-6]) ** 2 @ AXES.T
V6 = np.zeros((6, 6))
V6[:3, :3], V6[3:, 3:] = V, (8e-5) ** 2 * np.eye(3)
PLACE = np.array([0.7, 2.5, -0.3])


def samples_of(values, covariance=V, warnings=None):
    warnings = warnings or [""] * len(values)
    return [
        TrackerSample(k, np.asarray(x), covariance, w)
        for k, (x, w) in enumerate(zip(values, warnings, strict=True))
    ]


def drawn(rng, count, covariance=V, place=PLACE):
    return place + rng.multivariate_normal(np.zeros(len(covariance)), covariance, count)


def covered(rng, count, windows, share=0.0, worse=1.0):
    """Share of windows whose true place lies in the 95 % ellipsoid of their average."""
    inside = 0
    for _ in range(windows):
        common = rng.multivariate_normal(np.zeros(3), share * V)
        values = drawn(rng, count, (1 - share) * worse**2 * V) + common
        mean = average(samples_of(values), share)
        off = mean.value - PLACE
        inside += off @ np.linalg.solve(mean.covariance, off) < stats.chi2.ppf(0.95, 3)
    return inside / windows


def test_the_covariance_of_a_mean_is_its_law():
    mean = average(samples_of([PLACE] * 5))
    assert mean.value == pytest.approx(PLACE, abs=1e-15)
    assert mean.covariance == pytest.approx(20 / 24 * V / 5, rel=1e-12)
    off = np.array([10e-6, -20e-6, 5e-6])
    values = [PLACE + off, PLACE - off, PLACE]
    mean = average(samples_of(values))
    assert mean.value == pytest.approx(PLACE, abs=1e-15)
    assert mean.covariance == pytest.approx((20 * V + 2 * np.outer(off, off)) / 22 / 3, rel=1e-9)
    rng = np.random.default_rng(0)
    values = drawn(rng, 1000, 0.7 * V)
    covariance = average(samples_of(values), 0.3).covariance
    assert np.trace(covariance) == pytest.approx(0.3 * np.trace(V), rel=0.01)
    assert average(samples_of([PLACE] * 10), 1.0).covariance == pytest.approx(V, rel=1e-12)


@pytest.mark.parametrize(
    ("count", "share"),
    [
        pytest.param(3, 0.0, marks=pytest.mark.long),
        pytest.param(5, 0.0, marks=pytest.mark.slow),
        pytest.param(5, 0.4, marks=pytest.mark.long),
        pytest.param(20, 0.0, marks=pytest.mark.slow),
        pytest.param(40, 0.2, marks=pytest.mark.slow),
    ],
)
def test_stated_ellipsoid_covers_the_truth_as_often_as_it_says(count, share):
    # 2500 windows: 3 standard errors are 1.3 %; a posterior of 20 + K - 1 repeats costs 1 %
    got = covered(np.random.default_rng(count), count, 2500, share)
    assert 0.925 < got < 0.965


@pytest.mark.parametrize("worse", first(2, [2.0, 10.0, 4.0]))
def test_noise_far_above_what_is_stated_is_not_believed_away(worse):
    """From the scatter of 10 alone a covariance would cover 81 %; the stated one far less."""
    got = covered(np.random.default_rng(9), 10, 600, worse=worse)
    assert got > 0.85


def test_scatter_is_how_much_worse_it_is_with_uniform_p_values():
    rng = np.random.default_rng(11)
    p = [average(samples_of(drawn(rng, 6))).scatter_p for _ in range(800)]
    assert stats.kstest(p, "uniform").pvalue > 1e-3
    rng = np.random.default_rng(12)
    result = average(samples_of(drawn(rng, 400, 9 * V)))
    assert result.scatter == pytest.approx(9, rel=0.15)
    assert result.scatter_p < 1e-12
    assert "3.0 times" in result.warnings[0]


def test_rotations_average_on_the_sphere_also_across_the_half_turn():
    rng = np.random.default_rng(5)
    middle = Rotation.from_rotvec([0.0, 0.0, np.pi - 1e-5])  # rotation vectors flip about here
    turns = Rotation.from_rotvec(8e-5 * rng.standard_normal((50, 3))) * middle
    values = np.hstack([drawn(rng, 50), turns.as_rotvec()])
    assert np.ptp(values[:, 5]) > 6  # both signs occur
    mean = average(samples_of(values, V6))
    off = (Rotation.from_rotvec(mean.value[3:]) * middle.inv()).as_rotvec()
    assert np.linalg.norm(off) < 4 * 8e-5 / np.sqrt(50) * np.sqrt(3)
    assert np.trace(mean.covariance[3:, 3:]) == pytest.approx(3 * 8e-5**2 / 50, rel=0.3)


def test_deviations_of_poses_turn_with_the_sensor_axes():
    rng = np.random.default_rng(6)
    turns = Rotation.from_rotvec(0.3 * rng.standard_normal((8, 3)))
    values = np.hstack([np.zeros((8, 3)), turns.as_rotvec()])
    frame = Rotation.from_rotvec([0.5, 1.1, -0.4])
    seen = np.hstack([np.zeros((8, 3)), (frame * turns).as_rotvec()])
    (mean, residuals), (mean_seen, residuals_seen) = deviations(values), deviations(seen)
    assert residuals.sum(axis=0) == pytest.approx(np.zeros(6), abs=1e-12)
    assert residuals_seen[:, 3:] == pytest.approx(frame.apply(residuals[:, 3:]), abs=1e-10)
    there = frame * Rotation.from_rotvec(mean[3:])
    assert Rotation.from_rotvec(mean_seen[3:]).as_matrix() == pytest.approx(there.as_matrix())


def test_good_samples_are_never_left_out():
    rng = np.random.default_rng(8)
    for count in (3, 5, 10, 50):
        for _ in range(300):
            assert average(samples_of(drawn(rng, count))).left_out == ()


def test_remarks_of_the_instrument_come_once():
    result = average(samples_of([PLACE] * 3, warnings=["tilted", "", "tilted"]))
    assert result.warnings == ("tilted",)


@pytest.mark.parametrize(
    ("count", "bad"), [(3, 1), (5, 1), (5, 2), (10, 2), (10, 3), (20, 4), (20, 5)]
)
def test_one_in_five_may_be_left_out_and_named_and_more_is_no_reading(count, bad):
    values = drawn(np.random.default_rng(count), count)
    clean = average(samples_of(values[bad:]))
    values[:bad] += [[1e-3, 0, 0]] * np.arange(1, bad + 1)[:, None]
    if bad > max(1, count // 5):
        refusal_of(DeviceError, f"readings scatter: {bad} of {count}", average, samples_of(values))
        return
    result = average(samples_of(values))
    assert result.left_out == tuple(range(bad))
    assert f"reading 1 of {count}" in result.warnings[0]
    assert result.value == pytest.approx(clean.value, abs=1e-15)
    assert result.covariance == pytest.approx(clean.covariance, rel=1e-12)


STD = np.array([5.0, 12.0, 12.0]) * 1e-6
STATED = np.diag(STD**2)
DT = 0.5
ALONG = np.array([0.6, 0.8, 0.0])
START_SIGMA = 1e-3 * np.linalg.norm(ALONG / STD)  # how far 1 mm along ALONG is, in sigmas


def sample(t, value, covariance=STATED):
    return TrackerSample(round(1e9 * t), np.asarray(value), covariance)


def wait(rng, count, signal=lambda t: 0.0 * ALONG, worse=1.0, limit=400):
    """Samples until it settles, and the time of the last."""
    window = SettleWindow(count)
    for k in range(limit):
        t = k * DT
        window.add(sample(t, signal(t) + worse * STD * rng.standard_normal(3)))
        if window.settled:
            return k + 1, t
    return limit + 1, t


@pytest.mark.parametrize("count", [3, 5, 10])
def test_pure_noise_settles_in_the_first_window_and_soon_after(count):
    rng = np.random.default_rng(count)
    took = np.array([wait(rng, count)[0] for _ in range(1000)])
    assert took.min() == count
    # at least 95 % are promised, 4.1 % refused by design: three standard errors are 1.9 %
    assert 0.94 < np.mean(took == count) < 0.98
    assert np.mean(took <= 2 * count) > 0.99
    assert took.max() <= 4 * count


@pytest.mark.parametrize("count", first(1, [5, 3, 10]))
@pytest.mark.parametrize("tau", [2.0, 5.0])
def test_decay_is_waited_for_until_its_rest_is_below_the_noise(count, tau):
    """1 mm is 137 sigmas of a sample; less than 0.4 of one is left in 95 %."""
    rng = np.random.default_rng(round(10 * tau) + count)
    left = []
    for _ in range(50):
        _, t = wait(rng, count, lambda t: 1e-3 * ALONG * np.exp(-t / tau))
        left.append(START_SIGMA * np.exp(-t / tau))
    assert np.quantile(left, 0.95) < 0.4
    assert max(left) < 1.0


@pytest.mark.parametrize("tau", first(1, [1.0, 5.0]))
def test_vibration_is_waited_for_until_its_rest_is_below_the_noise(tau):
    """An amplitude of less than one sigma is left in 95 %; it hardly moves the mean then."""
    rng = np.random.default_rng(round(tau))
    left = []
    for _ in range(60):
        phase = rng.uniform(0, 2 * np.pi)
        _, t = wait(
            rng, 5, lambda t, p=phase: 1e-3 * ALONG * np.exp(-t / tau) * np.cos(7.3 * t + p)
        )
        left.append(START_SIGMA * np.exp(-t / tau))
    assert np.quantile(left, 0.95) < 1.0
    assert max(left) < 2.0


def test_drift_that_matters_never_settles():
    """Seen clearly by many samples, but far below what a mean of them can tell."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        took, _ = wait(rng, 5, lambda t: 60e-6 * ALONG * t, limit=60)
        assert took > 60
    window = SettleWindow(400)
    for k in range(400):
        noise = 0.02 * STD * (-1) ** k
        window.add(sample(k * DT, noise + 0.015 * STD * k / 400))
    assert window.settled
    window = SettleWindow(3)
    for _ in range(9):
        window.add(sample(1.0, STD))
    assert not window.settled


def test_poses_are_judged_by_their_turning_too():
    covariance = np.diag([1e-10] * 3 + [6.4e-9] * 3)
    rng = np.random.default_rng(3)
    still, turning = SettleWindow(5), SettleWindow(5)
    for k in range(5):
        noise = np.sqrt(np.diag(covariance)) * rng.standard_normal(6)
        still.add(sample(k * DT, noise, covariance))
        turning.add(sample(k * DT, noise + 1e-3 * k * DT * np.eye(6)[5], covariance))
    assert still.settled
    assert not turning.settled


GRAVITY = np.array([0.0, 0.0, -9.80665])
BIAS = np.array([4.0, -2.5, 7.0, 0.3, -0.2, 0.1])
MASS, COM = 1.7, np.array([0.01, -0.02, 0.06])


def rotations(number, rng):
    return Rotation.random(number, random_state=rng).as_matrix()


def reading(rotation, gravity=GRAVITY, bias=BIAS, mass=MASS, com=COM, load=None):
    """(K, 6) what the sensor reads, by forces and levers in base axes; load (K, 6) likewise."""
    out = np.empty((len(rotation), 6))
    for k, R in enumerate(rotation):
        force = mass * gravity
        moment = np.cross(R @ com, force)
        if load is not None:
            force, moment = force + load[k, :3], moment + load[k, 3:]
        out[k] = np.concatenate([R.T @ force, R.T @ moment])
    return out + bias


def covariances(number, rng, scale=1.0):
    """(K, 6, 6) correlated, not alike."""
    std = np.repeat((0.05, 0.002), 3) * scale
    mix = rng.standard_normal((number, 6, 6)) * 0.3 + np.eye(6)
    return std[:, None] * (mix @ np.swapaxes(mix, 1, 2)) * std


def noise(covariance, rng):
    root = np.linalg.cholesky(covariance)
    return (root @ rng.standard_normal((len(covariance), 6, 1)))[..., 0]


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@given(
    seed=st.integers(0, 2**32 - 1),
    mass=st.floats(0.0, 20.0),
    com=st.tuples(*[st.floats(-0.3, 0.3)] * 3),
    poses=st.integers(4, 30),
)
def test_without_noise_everything_is_recovered(seed, mass, com, poses):
    rng = np.random.default_rng(seed)
    gravity = Rotation.random(random_state=rng).apply(GRAVITY)
    R = rotations(poses, rng)
    bias = rng.normal(size=6) * np.repeat((10.0, 1.0), 3)
    wrench = reading(R, gravity, bias, mass, np.array(com))
    try:
        found = identify_tool_load(wrench, covariances(poses, rng), R, gravity)
    except CannotAnswerError:
        u = np.swapaxes(R, 1, 2) @ gravity / 9.80665
        assert np.linalg.svd(u - u.mean(axis=0))[1][1] < 0.1 * np.sqrt(poses)
        return
    assert found.bias == pytest.approx(bias, abs=1e-7)
    assert found.mass == pytest.approx(mass, abs=1e-8)
    assert found.moment == pytest.approx(mass * np.array(com), abs=1e-8)
    assert found.chi2 == pytest.approx(0.0, abs=1e-8)
    assert found.dof == 6 * poses - 10
    if mass > 0.5:
        assert found.com == pytest.approx(np.array(com), abs=1e-6)
    assert found.load_wrench(wrench, R) == pytest.approx(np.zeros((poses, 6)), abs=1e-6)


def test_estimates_scatter_as_their_covariance_says(rng):
    K, N = 8, 1500
    R, cov = rotations(K, rng), covariances(K, rng)
    truth = np.concatenate([BIAS, [MASS], MASS * COM])
    found = [identify_tool_load(reading(R) + noise(cov, rng), cov, R, GRAVITY) for _ in range(N)]
    x = np.array([np.concatenate([f.bias, [f.mass], f.moment]) for f in found])
    inverse = np.linalg.inv(found[0].covariance)
    error = x - truth
    # squared Mahalanobis distances are chi² of 10; their mean has the variance 20 / N
    distance = np.einsum("ki,ij,kj->k", error, inverse, error)
    assert distance.mean() == pytest.approx(10.0, abs=4 * np.sqrt(20 / N))
    # each direction by itself: whitened scatter is the unit matrix
    L = np.linalg.cholesky(found[0].covariance)
    white = np.linalg.solve(L, error.T)
    assert white @ white.T / N == pytest.approx(np.eye(10), abs=5 * np.sqrt(2 / N))
    chi2 = np.array([f.chi2 for f in found])
    assert chi2.mean() == pytest.approx(6 * K - 10, abs=4 * np.sqrt(2 * (6 * K - 10) / N))
    assert np.mean(chi2 > chi2_law.ppf(0.95, 6 * K - 10)) == pytest.approx(0.05, abs=0.023)
    com = np.array([f.com for f in found])
    assert com.std(axis=0) == pytest.approx(found[0].com_std, rel=0.1)


def test_a_wrong_model_shows_in_the_variance_factor(rng):
    R, cov = rotations(10, rng), covariances(10, rng)
    turned = R @ Rotation.from_rotvec([0.0, 0.1, 0.0]).as_matrix()  # the sensor sits askew
    assert identify_tool_load(reading(turned), cov, R, GRAVITY).variance_factor > 100.0
    good = identify_tool_load(reading(R) + noise(cov, rng), cov, R, GRAVITY)
    assert 0.4 < good.variance_factor < 1.9


@pytest.mark.parametrize(
    ("turns", "missing"),
    [
        ([[0, 0, 0]], "mass and centre of mass"),
        ([[0, 0, 0], [0, 0, 1.0], [0, 0, 2.0]], "mass and centre of mass"),
        ([[0, 0, 0], [0, 1.0, 0]], "centre of mass in one direction"),
        ([[0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0, 1.0, 0]], "centre of mass in one direction"),
    ],
)
def test_orientations_that_do_not_determine_the_tool_are_refused(turns, missing, rng):
    R = Rotation.from_rotvec(turns).as_matrix()
    with pytest.raises(CannotAnswerError, match=f"do not determine the tool's {missing}") as caught:
        identify_tool_load(reading(R), covariances(len(R), rng), R, GRAVITY)
    assert "3 or more poses" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sensor_mounted_the_other_way_round_and_values_that_are_no_numbers_are_refused(rng):
    R = rotations(6, rng)
    given = {"wrench": reading(R), "covariance": covariances(6, rng), "rotation": R}
    with pytest.raises(CannotAnswerError, match="axes or its sign are wrong: check rotvec_rad"):
        identify_tool_load(-given["wrench"], given["covariance"], R, GRAVITY)
    for name, values in given.items():
        wrong = given | {name: values.copy()}
        wrong[name][2, ..., 0] = np.nan
        refusal("values that are no finite numbers", identify_tool_load, **wrong, gravity=GRAVITY)


def test_a_massless_tool_has_its_centre_of_mass_nowhere(rng):
    R, cov = rotations(8, rng), covariances(8, rng)
    found = identify_tool_load(reading(R, mass=0.0) + noise(cov, rng), cov, R, GRAVITY)
    assert np.all(np.isfinite(found.com))
    assert abs(found.mass) < 5 * np.sqrt(found.covariance[6, 6])


@given(seed=st.integers(0, 2**32 - 1))
def test_tare_with_the_tool_known_gives_zero_and_load(seed):
    rng = np.random.default_rng(seed)
    R = rotations(4, rng)
    load = rng.normal(size=(4, 6)) * 50.0
    unloaded, cov = reading(R[:1])[0], covariances(1, rng)[0]
    found = tare(unloaded, cov, R[0], GRAVITY, MASS, COM)
    assert found.bias == pytest.approx(BIAS, abs=1e-9)
    assert found.com == pytest.approx(COM)
    assert found.covariance[:6, :6] == pytest.approx(cov)
    assert not np.any(found.covariance[6:])
    felt = found.load_wrench(reading(R, load=load), R)
    assert felt == pytest.approx(load, abs=1e-9)
    assert found.load_wrench(reading(R, load=load)[1], R[1]) == pytest.approx(load[1], abs=1e-9)


def test_the_load_s_wrench_scatters_as_its_covariance_says(rng):
    K, N = 5, 1500
    R, cov = rotations(K, rng), covariances(K, rng)
    pose, one = rotations(1, rng), covariances(1, rng)
    load = np.array([[10.0, 0.0, -98.0, 1.0, 2.0, 0.0]])
    error = []
    for _ in range(N):
        found = identify_tool_load(reading(R) + noise(cov, rng), cov, R, GRAVITY)
        sample = reading(pose, load=load) + noise(one, rng)
        error.append(found.load_wrench(sample[0], pose[0]) - load[0])
    stated = found.load_covariance(one[0], pose[0])
    white = np.linalg.solve(np.linalg.cholesky(stated), np.array(error).T)
    assert white @ white.T / N == pytest.approx(np.eye(6), abs=5 * np.sqrt(2 / N))


WEIGHT = np.array([0.0, 0.0, -98.0665, 0.0, 0.0, 0.0])
PULL = np.array([50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
FELT_STD = np.full(6, 0.1)


@given(size=st.floats(0.1, 300.0), share=st.floats(0.0, 0.3), off=st.floats(0.0, 2.0))
def test_a_load_is_right_within_newtons_or_its_share(size, share, off):
    expected = np.array([0.0, 0.0, -size, 0.0, 0.0, 0.0])
    limit = max(3.0, share * size)
    measured = expected + np.array([off * limit, 0.0, 0.0, 0.0, 0.0, 0.0])
    right, text = compare(expected, measured, FELT_STD, 3.0, share, GRAVITY)
    if abs(off - 1.0) > 1e-9:
        assert right == (off < 1.0)
    assert "\n" not in text


SIN, COS = np.sin(np.radians(14.0)), np.cos(np.radians(14.0))
ASLANT = np.linalg.norm(WEIGHT[:3]) * np.array([SIN, 0.0, -COS, 0.0, 0.0, 0.0])
MOMENT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0])
OFF = np.array([1.0, -1.0, 1.0, 5.0, -3.0, 1.0])
UNSURE = "asked for 10 kg (98.1 N), felt 98.1 N ± 6.0 N: too uncertain to tell"


@pytest.mark.parametrize(
    ("expected", "measured", "std", "right", "text"),
    [
        (WEIGHT, WEIGHT + OFF, 0.1, True, "asked for 10 kg (98.1 N), felt 97.1 N"),
        (0 * WEIGHT, np.full(6, 0.5), 0.1, True, "asked for nothing, felt 0.9 N"),
        (WEIGHT, WEIGHT / 2, 0.1, False, "asked for 10 kg (98.1 N), felt 49.0 N: that is about 5"),
        (
            WEIGHT, ASLANT, 0.1, False,  # a sensor that is mounted otherwise than described
            "asked for 10 kg (98.1 N), felt 98.1 N: that is 100 % of it, 14° off its direction",
        ),
        (WEIGHT, 0.01 * WEIGHT, 0.1, False, "asked for 10 kg (98.1 N), felt 1.0 N: that is"),
        (0 * WEIGHT, WEIGHT / 2, 0.1, False, "asked for nothing, felt 49.0 N: about 5.0 kg still"),
        (0 * WEIGHT, PULL, 0.1, False, "asked for nothing, felt 50.0 N: something still pulls"),
        (PULL, 0.8 * PULL, 0.1, False, "asked for 50.0 N, felt 40.0 N: that is 80 % of it, 0° off"),
        (
            PULL, np.roll(PULL, 1), 0.1, False,
            "asked for 50.0 N, felt 50.0 N: that is 100 % of it, 90° off its direction",
        ),
        (WEIGHT, np.full(6, np.nan), 0.1, False, "asked for 10 kg (98.1 N), felt nan N: the"),
        (WEIGHT, WEIGHT, 2.0, False, UNSURE),
        (MOMENT, MOMENT, 0.01, True, "asked for 10.0 N·m, felt 10.0 N·m"),
        (
            MOMENT, 0.5 * MOMENT, 0.01, False,
            "asked for 10.0 N·m, felt 5.0 N·m: that is 50 % of it, 0° off its direction",
        ),
    ],
)  # fmt: skip
def test_what_hangs_is_told_in_words(expected, measured, std, right, text):
    found, said = compare(expected, measured, np.full(6, std), 3.0, 0.0, GRAVITY)
    assert (found, said[: len(text)]) == (right, text)
