"""Which readings are copies of others, whatever they went through."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.readings.readings import Readings, States
from hilcal.readings.same_readings import already, never_fitted

LOADS = 3
NOISE_M = 5e-6


def campaign(m=3, poses=40, seed=0):
    """Poses with an unloaded and two loaded readings each."""
    rng = np.random.default_rng(seed)
    n = poses * LOADS
    pose = np.repeat(np.arange(poses), LOADS)
    load = np.tile(np.arange(LOADS), poses)
    value = rng.normal(size=(n, m))
    if m == 6:
        value[:, 3:] = Rotation.random(n, random_state=1).as_rotvec()
    return Readings(
        states=States(rng.uniform(-3, 3, (poses, 6))[pose], rng.normal(size=(n, 6))),
        pose=pose,
        load=load,
        cycle=np.zeros(n, dtype=np.int64),
        value=value,
        covariance=np.tile(np.eye(m) * NOISE_M**2, (n, 1, 1)),
        load_names=("none", "5kg", "10kg"),
        pose_names=tuple(f"p{k}" for k in range(poses)),
    )


@pytest.mark.parametrize("m", [3, 6])
def test_a_copy_is_known_whatever_it_went_through(m):
    r = campaign(m)
    order = np.random.default_rng(1).permutation(len(r))
    shuffled = r[order]
    value, states = shuffled.value.copy(), shuffled.states
    value[:, :3] = np.round(value[:, :3] * 1e3, 4) / 1e3  # mm, four decimals
    if m == 6:  # degrees, three decimals, and the other way round where that is as short
        value[:, 3:] = np.radians(np.round(np.degrees(value[:, 3:]), 3))
        value[:, 3:] -= (
            2 * np.pi * value[:, 3:] / np.linalg.norm(value[:, 3:], axis=1, keepdims=True)
        )
    copy = replace(
        shuffled,
        value=value,
        states=replace(
            states, q=np.radians(np.round(np.degrees(states.q), 3)), wrench=states.wrench * 1.02
        ),
        covariance=shuffled.covariance * 4,
        load_names=("none", "five", "ten"),
        pose_names=tuple(f"P {k}" for k in range(len(r.pose_names))),
    )
    assert already(copy, r).all()
    assert already(r, copy).all()


def test_positions_alone_are_compared_with_positions():
    r = campaign(6)
    alone = replace(r, value=r.value[:, :3], covariance=r.covariance[:, :3, :3])
    assert already(alone, r).all()


def test_what_was_measured_again_is_another_reading():
    r = campaign(poses=300)
    again = replace(r, value=r.value + np.random.default_rng(2).normal(0, NOISE_M, r.value.shape))
    assert already(again, r).mean() < 0.002  # (0.2 µm)³ in (5 µm √2π)³: none is expected
    turned = replace(r, states=replace(r.states, q=r.states.q + 1e-3))
    assert not already(turned, r).any()


def test_loaded_and_unloaded_readings_differ_and_arms_with_other_joints():
    r = campaign()
    swapped = replace(r, load=np.where(r.load == 0, 1, 0))
    assert not already(swapped, r)[r.load < 2].any()
    assert not already(replace(r, states=replace(r.states, q=r.states.q[:, :5])), r).any()
    assert not already(r, r[:0]).any()
    assert len(already(r[:0], r)) == 0


def test_a_deflection_is_unseen_only_if_neither_reading_of_it_was_fitted():
    r = campaign(poses=4)
    fitted = r[[0, 4, 8]]  # p0 unloaded, p1 under 5kg, p2 under 10kg
    known, unseen = never_fitted(r, fitted, deflections=True)
    assert np.flatnonzero(known).tolist() == [0, 4, 8]
    assert np.flatnonzero(unseen).tolist() == [3, 5, 6, 7, 9, 10, 11]
    known, unseen = never_fitted(r, fitted, deflections=False)
    assert np.flatnonzero(~unseen).tolist() == [0, 4, 8]
    known, unseen = never_fitted(r, r[[1, 2]], deflections=True)
    assert not unseen[:3].any()  # the unloaded reading alone tells nothing
