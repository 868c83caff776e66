"""Arms of fewer than six joints: the position is corrected, the orientation as far as it can be."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.calibration.compensation import MOST_TURNED, invert, nominal_pose
from hilcal.calibration.points import read_points
from hilcal.robot import se3
from hilcal.robot.urdf import arm_from_urdf
from tests.support.refusals import refusal
from tests.support.serial_urdf import serial_urdf

FLANGE = {"link": "tool0", "type": "fixed", "xyz": "0.05 0 0.05"}
PITCH = {"axis": "0 1 0"}
FIVE = serial_urdf([
    {"xyz": "0 0 0.3"}, {**PITCH, "xyz": "0.1 0 0.1"}, {**PITCH, "xyz": "0 0 0.5"},
    {**PITCH, "xyz": "0.4 0 0"}, {"axis": "1 0 0", "xyz": "0.1 0 0"}, FLANGE,
])  # fmt: skip


def follower(joint):
    return {"mimic": f'<mimic joint="{joint}" multiplier="-1"/>'}


PALLETIZER = serial_urdf([
    {"xyz": "0 0 0.5"}, {**PITCH, "xyz": "0.2 0 0.1"}, {**PITCH, "xyz": "0 0 0.9"},
    {**PITCH, **follower("j2")}, {**PITCH, **follower("j3"), "xyz": "1 0 0"},
    {"axis": "0 0 -1", "xyz": "0.2 0 -0.1"}, FLANGE,
])  # fmt: skip
"""The rods of two parallelograms hold the flange level."""
TOOL = se3.matrix(np.eye(3), np.array([0.06, 0.02, 0.12]))
ARMS = {"five": (FIVE, [0.1, -0.5, 1.0, -0.4, 0.2]),
        "palletizer": (PALLETIZER, [0.1, -0.2, 0.5, 0.2, -0.5, 0.3])}  # fmt: skip


def arm_of(name, tmp_path):
    (tmp_path / "arm.urdf").write_text(ARMS[name][0])
    return arm_from_urdf(tmp_path / "arm.urdf")


@pytest.mark.parametrize("name", ARMS)
def test_the_position_is_met_and_the_orientation_as_near_as_it_can_be(name, tmp_path):
    arm, rng = arm_of(name, tmp_path), np.random.default_rng(1)
    errors = 1e-3 * rng.standard_normal((arm.n + 1, 6))
    true = replace(arm, links=arm.links @ se3.matrix(*se3.exp(errors)))
    q = arm.complete(np.array(ARMS[name][1]) + 0.2 * rng.uniform(-1, 1, (20, arm.n)))
    rotation, position, _ = nominal_pose(arm, TOOL, q)

    def found_from(start):
        return invert(arm, lambda at, _: nominal_pose(true, TOOL, at), start, rotation, position)

    solution = found_from(q)
    assert solution.solved.all()
    turned, reached, _ = nominal_pose(true, TOOL, solution.q)
    np.testing.assert_allclose(reached, position, rtol=0, atol=1e-9)
    np.testing.assert_allclose(solution.q, arm.complete(solution.q), rtol=0, atol=1e-15)
    angle = np.linalg.norm(se3.rotation_vector(turned @ np.swapaxes(rotation, 1, 2)), axis=1)
    np.testing.assert_allclose(angle, solution.residual_rad, atol=1e-9)
    assert 1e-4 < angle.max() < MOST_TURNED
    # The best there is: one, wherever the search begins.
    again = found_from(arm.complete(q + 0.02 * rng.uniform(-1, 1, q.shape)))
    np.testing.assert_allclose(again.q, solution.q, rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ARMS)
def test_an_orientation_that_the_arm_cannot_have_is_not_solved(name, tmp_path):
    arm = arm_of(name, tmp_path)
    q = np.array(ARMS[name][1])[None]
    rotation, position, _ = nominal_pose(arm, TOOL, q)
    across = rotation @ se3.rotation(np.array([[0.1, 0.1, 0.1]]))
    solution = invert(arm, lambda at, _: nominal_pose(arm, TOOL, at), q, across, position)
    assert solution.residual_m < 1e-9
    assert not solution.solved.any()


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_points_may_leave_out_the_joints_that_follow(unit, tmp_path):
    arm, path = arm_of("palletizer", tmp_path), tmp_path / "points.csv"
    path.write_text(f"pose,q1_{unit},q2_{unit},q3_{unit},q6_{unit}\na,0.1,-0.2,0.3,0.4\n")
    factor = 1.0 if unit == "rad" else np.pi / 180
    points = read_points(path, arm, {})
    np.testing.assert_allclose(points.q, factor * np.array([[0.1, -0.2, 0.3, 0.2, -0.3, 0.4]]))
    path.write_text(f"pose,q1_{unit},q2_{unit},q3_{unit}\na,0.1,-0.2,0.3\n")
    refusal(f"column 'q6_{unit}' is missing", read_points, path, arm, {})
