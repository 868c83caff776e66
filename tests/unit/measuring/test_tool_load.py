"""What the force sensor weighs: zero, tool and load, with what it is known of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2 as chi2_law

from hilcal.errors import CannotAnswerError
from hilcal.measuring.force import compare, identify_tool_load, tare
from tests.support.refusals import refusal

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
        tool_load = identify_tool_load(wrench, covariances(poses, rng), R, gravity)
    except CannotAnswerError:
        u = np.swapaxes(R, 1, 2) @ gravity / 9.80665
        assert np.linalg.svd(u - u.mean(axis=0))[1][1] < 0.1 * np.sqrt(poses)
        return
    assert tool_load.bias == pytest.approx(bias, abs=1e-7)
    assert tool_load.mass == pytest.approx(mass, abs=1e-8)
    assert tool_load.moment == pytest.approx(mass * np.array(com), abs=1e-8)
    assert tool_load.chi2 == pytest.approx(0.0, abs=1e-8)
    assert tool_load.dof == 6 * poses - 10
    if mass > 0.5:
        assert tool_load.com == pytest.approx(np.array(com), abs=1e-6)
    assert tool_load.load_wrench(wrench, R) == pytest.approx(np.zeros((poses, 6)), abs=1e-6)


@pytest.mark.long
def test_estimates_scatter_as_their_covariance_says(rng):
    K, N = 8, 1500
    R, cov = rotations(K, rng), covariances(K, rng)
    truth = np.concatenate([BIAS, [MASS], MASS * COM])
    estimates = [
        identify_tool_load(reading(R) + noise(cov, rng), cov, R, GRAVITY) for _ in range(N)
    ]
    x = np.array([np.concatenate([f.bias, [f.mass], f.moment]) for f in estimates])
    inverse = np.linalg.inv(estimates[0].covariance)
    error = x - truth
    # squared Mahalanobis distances are chi² of 10; their mean has the variance 20 / N
    distance = np.einsum("ki,ij,kj->k", error, inverse, error)
    assert distance.mean() == pytest.approx(10.0, abs=4 * np.sqrt(20 / N))
    # each direction by itself: whitened scatter is the unit matrix
    L = np.linalg.cholesky(estimates[0].covariance)
    white = np.linalg.solve(L, error.T)
    assert white @ white.T / N == pytest.approx(np.eye(10), abs=5 * np.sqrt(2 / N))
    chi2 = np.array([f.chi2 for f in estimates])
    assert chi2.mean() == pytest.approx(6 * K - 10, abs=4 * np.sqrt(2 * (6 * K - 10) / N))
    assert np.mean(chi2 > chi2_law.ppf(0.95, 6 * K - 10)) == pytest.approx(0.05, abs=0.023)
    com = np.array([f.com for f in estimates])
    assert com.std(axis=0) == pytest.approx(estimates[0].com_std, rel=0.1)


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
        refusal("values that are not finite", identify_tool_load, **wrong, gravity=GRAVITY)


def test_a_massless_tool_has_its_centre_of_mass_nowhere(rng):
    R, cov = rotations(8, rng), covariances(8, rng)
    tool_load = identify_tool_load(reading(R, mass=0.0) + noise(cov, rng), cov, R, GRAVITY)
    assert np.all(np.isfinite(tool_load.com))
    assert abs(tool_load.mass) < 5 * np.sqrt(tool_load.covariance[6, 6])


@given(seed=st.integers(0, 2**32 - 1))
def test_tare_with_the_tool_known_gives_zero_and_load(seed):
    rng = np.random.default_rng(seed)
    R = rotations(4, rng)
    load = rng.normal(size=(4, 6)) * 50.0
    unloaded, cov = reading(R[:1])[0], covariances(1, rng)[0]
    tared = tare(unloaded, cov, R[0], GRAVITY, MASS, COM)
    assert tared.bias == pytest.approx(BIAS, abs=1e-9)
    assert tared.com == pytest.approx(COM)
    assert tared.covariance[:6, :6] == pytest.approx(cov)
    assert not np.any(tared.covariance[6:])
    felt = tared.load_wrench(reading(R, load=load), R)
    assert felt == pytest.approx(load, abs=1e-9)
    assert tared.load_wrench(reading(R, load=load)[1], R[1]) == pytest.approx(load[1], abs=1e-9)


def test_the_load_s_wrench_scatters_as_its_covariance_says(rng):
    K, N = 5, 1500
    R, cov = rotations(K, rng), covariances(K, rng)
    pose, one = rotations(1, rng), covariances(1, rng)
    load = np.array([[10.0, 0.0, -98.0, 1.0, 2.0, 0.0]])
    error = []
    for _ in range(N):
        tool_load = identify_tool_load(reading(R) + noise(cov, rng), cov, R, GRAVITY)
        sample = reading(pose, load=load) + noise(one, rng)
        error.append(tool_load.load_wrench(sample[0], pose[0]) - load[0])
    stated = tool_load.load_covariance(one[0], pose[0])
    white = np.linalg.solve(np.linalg.cholesky(stated), np.array(error).T)
    assert white @ white.T / N == pytest.approx(np.eye(6), abs=5 * np.sqrt(2 / N))


WEIGHT = np.array([0.0, 0.0, -98.0665, 0.0, 0.0, 0.0])
PULL = np.array([50.0, 0.0, 0.0, 0.0, 0.0, 0.0])
STD = np.full(6, 0.1)


@given(size=st.floats(0.1, 300.0), share=st.floats(0.0, 0.3), off=st.floats(0.0, 2.0))
def test_a_load_is_right_within_newtons_or_its_share(size, share, off):
    expected = np.array([0.0, 0.0, -size, 0.0, 0.0, 0.0])
    limit = max(3.0, share * size)
    measured = expected + np.array([off * limit, 0.0, 0.0, 0.0, 0.0, 0.0])
    right, text = compare(expected, measured, STD, 3.0, share, GRAVITY)
    if abs(off - 1.0) > 1e-9:
        assert right == (off < 1.0)
    assert "\n" not in text


SIN, COS = np.sin(np.radians(14.0)), np.cos(np.radians(14.0))
ASLANT = np.linalg.norm(WEIGHT[:3]) * np.array([SIN, 0.0, -COS, 0.0, 0.0, 0.0])
MOMENT = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 10.0])
OFF = np.array([1.0, -1.0, 1.0, 5.0, -3.0, 1.0])
UNSURE = "asked for 10 kg (98.1 N), measured 98.1 N ± 6.0 N: too uncertain"


@pytest.mark.parametrize(
    ("expected", "measured", "std", "right", "text"),
    [
        (WEIGHT, WEIGHT + OFF, 0.1, True, "asked for 10 kg (98.1 N), measured 97.1 N"),
        (0 * WEIGHT, np.full(6, 0.5), 0.1, True, "asked for nothing, measured 0.9 N"),
        (
            WEIGHT, WEIGHT / 2, 0.1, False,
            "asked for 10 kg (98.1 N), measured 49.0 N: that is about 5",
        ),
        (
            WEIGHT, ASLANT, 0.1, False,  # a sensor that is mounted otherwise than described
            "asked for 10 kg (98.1 N), measured 98.1 N: that is 100 % of it, 14° off its direction",
        ),
        (WEIGHT, 0.01 * WEIGHT, 0.1, False, "asked for 10 kg (98.1 N), measured 1.0 N: that is"),
        (0 * WEIGHT, WEIGHT / 2, 0.1, False, "asked for nothing, measured 49.0 N: about 5.0 kg"),
        (0 * WEIGHT, PULL, 0.1, False, "asked for nothing, measured 50.0 N: something still pulls"),
        (PULL, 0.8 * PULL, 0.1, False, "asked for 50.0 N, measured 40.0 N: that is 80 % of it, 0°"),
        (
            PULL, np.roll(PULL, 1), 0.1, False,
            "asked for 50.0 N, measured 50.0 N: that is 100 % of it, 90° off its direction",
        ),
        (WEIGHT, WEIGHT, 2.0, False, UNSURE),
        (MOMENT, MOMENT, 0.01, True, "asked for 10.0 N·m, measured 10.0 N·m"),
        (
            MOMENT, 0.5 * MOMENT, 0.01, False,
            "asked for 10.0 N·m, measured 5.0 N·m: that is 50 % of it, 0° off its direction",
        ),
    ],
)  # fmt: skip
def test_what_hangs_is_told_in_words(expected, measured, std, right, text):
    comparison, said = compare(expected, measured, np.full(6, std), 3.0, 0.0, GRAVITY)
    assert (comparison, said[: len(text)]) == (right, text)
