"""What the poses cannot tell of base and target stays near the start, is listed, costs nothing."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hilcal.identification.baseline import with_effects
from hilcal.identification.fit import fit
from hilcal.identification.registration import register
from hilcal.present.registration import registration_lines
from tests.unit.identification.test_registration import pose_of, seen, told

BASE = pose_of(Rotation.from_rotvec([0.4, -0.2, 2.0]).as_matrix(), [0.4, -0.4, 1.9])
OFFSET = np.array([0.1, 0.05, 0.2])


def target_of(m):
    turn = Rotation.from_rotvec([0.3, -1.0, 0.6]).as_matrix() if m == 6 else np.eye(3)
    return pose_of(turn, OFFSET)


def pointing_down(count, jitter=0.0):
    """Poses of the UR10e whose tool has one orientation: q2 + q3 + q4 and q1 − q6 are constant."""
    rng = np.random.default_rng(3)
    q = np.empty((count, 6))
    q[:, 0], q[:, 1], q[:, 2] = rng.uniform([-0.8, -1.8, 0.8], [0.8, -1.0, 1.8], (count, 3)).T
    q[:, 3] = -np.pi / 2 - q[:, 1] - q[:, 2]
    q[:, 4], q[:, 5] = -np.pi / 2, q[:, 0]
    q[:, 3:] += jitter * rng.normal(size=(count, 3))
    return q


def one_axis(count):
    q = np.tile([0.1, -1.3, 1.2, -1.0, -1.2, 0.4], (count, 1))
    q[:, 0] += np.linspace(0, 1.5, count)
    return q


@pytest.mark.parametrize("m", [3, 6])
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_one_orientation_registers_to_the_noise_and_holds_the_target(m, noise):
    readings = seen(BASE, target_of(m), m, pointing_down(40), noise)
    found = register(told(BASE, np.eye(4), False, False), readings)
    assert found.rms < 2 * noise + 1e-9
    assert len(found.undetermined) == 3
    np.testing.assert_allclose(found.cell.target[:3, 3], 0, atol=1e-3)
    assert np.linalg.norm(found.cell.registration[:3, 3] - BASE[:3, 3]) < 0.3
    for u in found.undetermined:
        np.testing.assert_allclose(
            np.linalg.norm(u.target_shift), np.linalg.norm(u.base_shift), rtol=0.1
        )
    words = " ".join(registration_lines(found))
    assert "the target's offset along the flange's z from the height of the base" in words


@pytest.mark.parametrize("m", [3, 6])
def test_one_axis_registers_to_the_noise_at_ordinary_places(m):
    readings = seen(BASE, target_of(m), m, one_axis(12), 1e-5)
    found = register(told(BASE, np.eye(4), False, False), readings)
    assert found.rms < 3e-5
    assert found.undetermined
    assert np.linalg.norm(found.cell.target[:3, 3]) < 1.0
    assert np.linalg.norm(found.cell.registration[:3, 3]) < 5.0
    assert "joints 2 to 6 never turned" in " ".join(registration_lines(found))


@pytest.mark.parametrize("m", [3, 6])
def test_poses_that_turn_leave_nothing_undetermined(m):
    q = np.random.default_rng(1).uniform(-2, 2, (30, 6))
    found = register(told(BASE, np.eye(4), False, False), seen(BASE, target_of(m), m, q, 1e-5))
    assert found.undetermined == ()
    np.testing.assert_allclose(found.cell.target[:3, 3], OFFSET, atol=1e-4)


def test_positions_count_although_attitudes_of_one_axis_are_blind():
    """Attitudes alone leave the base's turn about the common axis open; positions tell it."""
    q = pointing_down(40)
    q[:, 5] += np.linspace(0, 2, 40)  # turns about the vertical only
    found = register(told(BASE, np.eye(4), False, True), seen(BASE, np.eye(4), 6, q, 1e-5))
    assert found.rms < 3e-5
    np.testing.assert_allclose(found.cell.registration, BASE, atol=2e-4)


@pytest.mark.parametrize("m", [3, 6])
def test_an_undetermined_target_costs_no_accuracy(m):
    """Orientations that scatter by 0.1 mrad do not tell the target's offset but depend on it."""
    target = target_of(m)
    readings = seen(BASE, target, m, pointing_down(80, 1e-4), 1e-5)
    known, unknown = (told(BASE, target, False, is_known) for is_known in (True, False))
    first, second = readings[:40], readings[40:]
    error = []
    for cell in (known, unknown):
        found = fit(with_effects(cell, first, "absolute", []), first, "absolute")
        off = found.predict(second.states).position - second.value[:, :3]
        error.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    assert error[1] < 1.15 * error[0]


def test_a_known_frame_is_left_alone():
    readings = seen(BASE, target_of(3), 3, pointing_down(10), 1e-5)
    cell = told(BASE, target_of(3), True, True)
    found = register(cell, readings)
    assert found.cell is cell
    assert not found.estimated
    moved = register(replace(cell, registration=np.eye(4)), readings)
    assert moved.rms > 1.0
