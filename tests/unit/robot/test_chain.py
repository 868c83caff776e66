"""The deviated chain, its bodies and Jacobians: Pinocchio, matrix products and differences."""

import numpy as np
import pinocchio as pin
import pytest

from hilcal.robot import se3
from hilcal.robot.chain import Deviation, evaluate
from hilcal.robot.scene import FLANGE, body_poses, pinocchio_model
from hilcal.robot.statics import Load, slot_wrenches
from tests.support.arm_cases import (
    ARMS,
    arm_of,
    displacement,
    flange_at,
    twisted,
)

COUNT = 12


def angles(arm, count=COUNT):
    return np.random.default_rng(1).uniform(-np.pi, np.pi, (count, arm.n))


def random_deviation(arm, size, count=COUNT):
    """Joint displacements and link twists of a size; the second slot has none."""
    rng = np.random.default_rng(2)
    twist = size * rng.normal(size=(count, arm.n + 1, 6))
    twist[:, 1] = 0.0
    return Deviation(dq=size * rng.normal(size=(count, arm.n)), twist=twist)


def pinocchio_flange(arm, q):
    model = pinocchio_model(arm)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(FLANGE)]


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3, 0.5])
def test_flange_is_where_pinocchio_has_it(name, size):
    arm = arm_of(name)
    q, d = angles(arm), random_deviation(arm, size)
    chain = evaluate(arm, q, d if size else None)
    for i in range(COUNT):
        flange = pinocchio_flange(twisted(arm, d.twist[i]), q[i] + d.dq[i])
        flange_at(chain, i, flange.homogeneous)


@pytest.mark.parametrize("name", ARMS)
def test_bodies_and_flange_are_where_pinocchio_has_them(name):
    arm = arm_of(name)
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (4, arm.n))
    poses = body_poses(arm, q)
    assert poses.shape == (4, arm.n + 2, 4, 4)
    model = pinocchio_model(arm)
    data = model.createData()
    for angles, found in zip(q, poses, strict=True):
        pin.framesForwardKinematics(model, data, angles)
        placed = [np.eye(4), *(data.oMi[k].homogeneous for k in range(1, arm.n + 1))]
        placed.append(data.oMf[model.getFrameId(FLANGE)].homogeneous)
        np.testing.assert_allclose(found, placed, rtol=0, atol=1e-12)


MAGNITUDES = (0.0, 1e-9, 1e-6, 1e-3, 0.1, 0.499, 0.501, 1.0, 3.0, 3.14)


def vectors(seed, magnitude, count=4):
    """Random vectors (count, 3) of one length."""
    v = np.random.default_rng(seed).normal(size=(count, 3))
    return magnitude * v / np.linalg.norm(v, axis=1, keepdims=True)


def twists(seed, magnitude, count=4):
    """Twists (count, 6) that turn by `magnitude` and shift by about 1."""
    v = np.random.default_rng(seed + 1).normal(size=(count, 3))
    return np.hstack([v, vectors(seed, magnitude, count)])


@pytest.mark.parametrize("magnitude", MAGNITUDES)
def test_exp_is_the_matrix_exponential(magnitude):
    xi = twists(0, magnitude)
    expected = np.array([displacement(x) for x in xi])
    np.testing.assert_allclose(se3.matrix(*se3.exp(xi)), expected, rtol=0, atol=1e-14)
    np.testing.assert_allclose(se3.rotation(xi[:, 3:]), expected[:, :3, :3], rtol=0, atol=1e-14)


@pytest.mark.parametrize("short", [0.0, 1e-15, 1e-12, 1e-8, 1e-4, 0.1])
def test_vectors_of_rotations_by_about_half_a_turn(short):
    w = np.random.default_rng(2).standard_normal((200, 3))
    w = np.vstack([w, np.eye(3), -np.eye(3), np.eye(3)[:2] + np.eye(3)[1:]])
    w *= (np.pi - short) / np.linalg.norm(w, axis=1, keepdims=True)
    r = se3.rotation(w)
    found = se3.rotation_vector(r)
    assert np.linalg.norm(found, axis=1).max() <= np.pi + 1e-15
    np.testing.assert_allclose(se3.rotation(found), r, rtol=0, atol=1e-14)


STATES = 8
GRAVITIES = {"floor": (0.0, 0.0, -9.80665), "odd": (3.0, -7.0, 4.0)}


def case(arm, gravity):
    """States, a deviation with large twists, and a load that pulls and turns."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-np.pi, np.pi, (STATES, arm.n))
    d = Deviation(
        dq=0.1 * rng.normal(size=(STATES, arm.n)),
        twist=0.1 * rng.normal(size=(STATES, arm.n + 1, 6)),
    )
    load = Load(
        wrench=rng.normal(size=(STATES, 6)) * [80, 80, 80, 9, 9, 9],
        point=np.array([0.04, -0.03, 0.15]),
        tool_mass=2.1,
        tool_com=np.array([0.02, 0.01, 0.07]),
        gravity=np.array(gravity),
    )
    return q, d, load


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("gravity", GRAVITIES)
def test_torques_are_those_that_pinocchio_holds_against(name, gravity):
    # Pinocchio's generalized gravity holds the arm; weight and load pull the other way.
    arm = arm_of(name)
    q, d, load = case(arm, GRAVITIES[gravity])
    found = slot_wrenches(arm, evaluate(arm, q, d), load)
    for i in range(STATES):
        model = pinocchio_model(twisted(arm, d.twist[i]))
        model.gravity.linear = load.gravity
        flange = model.frames[model.getFrameId(FLANGE)]
        tool = pin.Inertia(load.tool_mass, load.tool_com, np.zeros((3, 3)))
        model.appendBodyToJoint(flange.parentJoint, tool, flange.placement)
        at_load = flange.placement * pin.SE3(np.eye(3), load.point)
        kind, axes = pin.FrameType.OP_FRAME, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        point = model.addFrame(pin.Frame("load", flange.parentJoint, 0, at_load, kind))
        data, angle = model.createData(), q[i] + d.dq[i]
        jacobian = pin.computeFrameJacobian(model, data, angle, point, axes)
        held = pin.computeGeneralizedGravity(model, data, angle)
        torque = jacobian.T @ load.wrench[i] - held
        np.testing.assert_allclose(arm.joint_components(found)[i], torque, rtol=0, atol=1e-10)
