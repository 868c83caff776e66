"""Where the tracker stands and where targets sit; what the poses cannot tell, and costs nothing."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hilcal.errors import CannotAnswerError
from hilcal.identification.prediction.full_prediction import gross_errors
from hilcal.identification.registration.registration import register
from hilcal.present.registration import registration_lines
from hilcal.readings.whitening import MODES
from hilcal.robot.se3 import rotation_vector
from studies.random_descriptions import readings_of
from tests.support.arm_cases import slots_of
from tests.support.campaigns import cell_of, plan
from tests.support.fit_cases import fitted_model
from tests.support.reflector_cases import OFFSETS, reflectors
from tests.support.rows import first

CELL = replace(cell_of(), target_known=False)
KNOWN = [(False, False), (False, True), (True, False), (True, True)]
EITHER = pytest.mark.parametrize("m", [3, 6])

angles = st.floats(-np.pi, np.pi)
turns = st.tuples(angles, angles, angles).map(lambda a: Rotation.from_euler("ZYX", a).as_matrix())
places = st.tuples(*[st.floats(-8.0, 8.0)] * 3).map(np.array)
offsets = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)


def pose_of(turn, place):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, place
    return pose


def at(*place):
    return pose_of(np.eye(3), place)


def poses(count=12):
    p = plan(count)
    return p.states.q[np.unique(p.pose, return_index=True)[1]]


def flanges_at(q):
    return np.array([slots_of(CELL.arm, each)[-1] for each in q])


def seen(registration, target, m, q=None, noise=0.0, seed=0):
    """Readings of the rigid arm, by products of homogeneous matrices."""
    q = poses() if q is None else q
    there = registration @ flanges_at(q) @ target
    rng = np.random.default_rng(seed)
    value = there[:, :3, 3] + noise * rng.normal(size=(len(q), 3))
    if m == 6:
        turned = Rotation.from_rotvec(noise * rng.normal(size=(len(q), 3)))
        value = np.hstack([value, (turned * Rotation.from_matrix(there[:, :3, :3])).as_rotvec()])
    return readings_of(q, value, np.full(m, 1e-5))


def told(registration, target, registration_known, target_known):
    """A cell that knows what it is said to know, and something wrong of the rest."""
    return replace(
        CELL,
        registration=registration if registration_known else np.eye(4),
        target=target if target_known else np.eye(4),
        registration_known=registration_known,
        target_known=target_known,
    )


def registered(readings, target=None):
    """Readings from an unknown base, of a target that is unknown unless given."""
    known = target is not None
    return register(told(np.eye(4), target if known else np.eye(4), False, known), readings)


@pytest.mark.parametrize("m", first(1, [6, 3]))
@pytest.mark.parametrize(("registration_known", "target_known"), KNOWN)
@given(turn=turns, place=places, tool=turns, offset=offsets)
def test_what_is_unknown_is_found_exactly(
    m, registration_known, target_known, turn, place, tool, offset
):
    registration, target = pose_of(turn, place), pose_of(tool, offset)
    cell = told(registration, target, registration_known, target_known)
    if m == 3 and not target_known:  # the target's axes cannot be seen in positions
        target = at(*offset)
    found = register(cell, seen(registration, target, m)).cell
    # Rounding of readings up to 14 m away, through a few well-conditioned systems; the
    # alternation for positions stops when it moves by less than 1e-12 m.
    np.testing.assert_allclose(found.registration, registration, rtol=0, atol=2e-9)
    np.testing.assert_allclose(found.target, target, rtol=0, atol=2e-9)


@EITHER
def test_too_few_poses_cannot_answer(m):
    for q in (poses()[:3], np.repeat(poses()[:3], 5, axis=0)):
        with pytest.raises(CannotAnswerError, match="3 distinct poses; measure at least 4"):
            registered(seen(at(1.0, 0.0, 0.0), np.eye(4), m, q))


@pytest.mark.parametrize("noise", [0.0, 1e-5])
def test_positions_on_a_line_or_in_one_point_cannot_answer(noise):
    """The last joint turns about the target; or about one tip on the first joint's axis."""
    line = np.repeat(poses()[:2], 3, axis=0)
    line[:, 5] += np.tile([0.0, 1.0, 2.0], 2)
    point = np.tile(np.array([0.0, -np.pi / 2, 0.1, -np.pi / 2, 0.2, 0.3]), (8, 1))
    point[:, 0] = np.linspace(-2, 2, 8)
    tip = np.linalg.inv(flanges_at(point)[0]) @ np.array([0.0, 0.0, 1.0, 1.0])
    for q, target in ((line, at(0.0, 0.0, 0.2)), (point, at(*tip[:3]))):
        with pytest.raises(CannotAnswerError, match="spread in space"):
            registered(seen(at(1.0, 0.0, 0.0), target, 3, q, noise), target)


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


@EITHER
@pytest.mark.parametrize("noise", [0.0, 2e-5])
def test_one_orientation_registers_to_the_noise_and_holds_the_target(m, noise):
    found = registered(seen(BASE, target_of(m), m, pointing_down(40), noise))
    assert found.rms < 2 * noise + 1e-9
    assert len(found.undetermined) == 3
    np.testing.assert_allclose(found.cell.target[:3, 3], 0, atol=1e-3)
    assert np.linalg.norm(found.cell.registration[:3, 3] - BASE[:3, 3]) < 0.3
    for u in found.undetermined:
        shifts = [np.linalg.norm(x) for x in (u.target_shift, u.base_shift)]
        assert shifts[0] == pytest.approx(shifts[1], rel=0.1)
    words = " ".join(registration_lines(found))
    assert "the target's offset along the flange's z from the height of the base" in words


@EITHER
def test_one_axis_registers_to_the_noise_at_ordinary_places(m):
    q = np.tile([0.1, -1.3, 1.2, -1.0, -1.2, 0.4], (12, 1))
    q[:, 0] += np.linspace(0, 1.5, 12)
    found = registered(seen(BASE, target_of(m), m, q, 1e-5))
    assert found.rms < 3e-5
    assert found.undetermined
    assert np.linalg.norm(found.cell.target[:3, 3]) < 1.0
    assert np.linalg.norm(found.cell.registration[:3, 3]) < 5.0
    assert "joints 2 to 6 never turned" in " ".join(registration_lines(found))


def test_positions_count_although_attitudes_of_one_axis_are_blind():
    """Attitudes alone leave the base's turn about the common axis open; positions tell it."""
    q = pointing_down(40)
    q[:, 5] += np.linspace(0, 2, 40)  # turns about the vertical only
    found = registered(seen(BASE, np.eye(4), 6, q, 1e-5), np.eye(4))
    assert found.rms < 3e-5
    np.testing.assert_allclose(found.cell.registration, BASE, atol=2e-4)


@EITHER
def test_an_undetermined_target_costs_no_accuracy(m):
    """Orientations that scatter by 0.1 mrad do not tell the target's offset but depend on it."""
    target = target_of(m)
    readings = seen(BASE, target, m, pointing_down(80, 1e-4), 1e-5)
    some, other = readings[:40], readings[40:]
    error = []
    for known in (True, False):
        found = fitted_model(told(BASE, target, False, known), some, "absolute", [])
        off = found.predict(other.states).position - other.value[:, :3]
        error.append(np.sqrt(np.mean(np.sum(off**2, axis=1))))
    assert error[1] < 1.15 * error[0]


def test_a_known_frame_is_left_alone():
    readings = seen(BASE, target_of(3), 3, pointing_down(10), 1e-5)
    cell = told(BASE, target_of(3), True, True)
    found = register(cell, readings)
    assert found.cell is cell
    assert not found.estimated
    assert register(replace(cell, registration=np.eye(4)), readings).rms > 1.0


OF_THREE = [(True, True, True), (False, True, False), (False, False, False)]


@EITHER
@pytest.mark.parametrize("known", OF_THREE)
def test_base_and_targets_are_registered_together(known, m):
    c = reflectors(known=known, joint_std=0.0, m=m)
    cell = register(c.cell, c.readings).cell
    off = cell.all_targets[:, :3, 3] - (OFFSETS + c.world.offsets)
    # The nominal arm is rigid: its loads move the targets by up to 1 mm.
    assert np.abs(off).max() < 5e-4
    assert np.all(off[list(known)] == 0.0)
    turn = cell.registration[:3, :3] @ c.world.registration[:3, :3].T
    assert np.linalg.norm(rotation_vector(turn)) < 1e-3


@pytest.mark.parametrize(("mode", "known"), [(MODES[0], OF_THREE[0]), (MODES[1], OF_THREE[-1])])
def test_swapped_names_and_a_displaced_reading_are_named(mode, known):
    c = reflectors("base_compliance", known=known, seed=1, joint_std=1e-5, poses=14, strength=4.0)
    r = c.readings
    one, other, _ = np.flatnonzero((r.pose == 4) & (r.load == 2))
    lone = np.flatnonzero((r.pose == 7) & (r.load == 1))[2]
    number, value = r.target.copy(), r.value.copy()
    number[[one, other]] = number[[other, one]]
    value[lone] += [1e-3, 0.0, 0.0]
    wrong = replace(r, states=replace(r.states, target=number), value=value)
    reasons = {g.row: g.reason for g in gross_errors(fitted_model(c.cell, wrong, mode))}
    assert set(reasons) == {one, other, lone}
    assert reasons[one] == "target R2: lies where R1 is: were they swapped?"
    assert reasons[other] == "target R1: lies where R2 is: were they swapped?"
    assert reasons[lone].startswith("target R3: ")
