"""The deviated chain, its bodies and Jacobians: Pinocchio, matrix products and differences."""

import numpy as np
import pinocchio as pin
import pytest

from hilcal.robot import se3
from hilcal.robot.arm import Arm
from hilcal.robot.body import body_poses
from hilcal.robot.chain import Deviation, evaluate, joint_jacobian, twist_jacobian
from hilcal.robot.scene import FLANGE, pinocchio_model
from hilcal.types import Floats
from tests.support.arm_cases import ARMS, ODD, arm_of, displacement, slope, twisted

TOLERANCE = 1e-12
COUNT = 12


def angles(arm: Arm, count: int = COUNT) -> Floats:
    return np.random.default_rng(1).uniform(-np.pi, np.pi, (count, arm.n))


def random_deviation(arm: Arm, size: float, count: int = COUNT) -> Deviation:
    """Joint displacements and link twists of a size; the second slot has none."""
    rng = np.random.default_rng(2)
    twist = size * rng.normal(size=(count, arm.n + 1, 6))
    twist[:, 1] = 0.0
    return Deviation(dq=size * rng.normal(size=(count, arm.n)), twist=twist)


def pinocchio_flange(arm: Arm, q: Floats) -> pin.SE3:
    model = pinocchio_model(arm)
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(FLANGE)]


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [0.0, 1e-3])
def test_joints_agree_with_pinocchio(name: str, size: float) -> None:
    arm = arm_of(name)
    q, dq = angles(arm), size * np.random.default_rng(3).normal(size=(COUNT, arm.n))
    chain = evaluate(arm, q, Deviation(dq=dq) if size else None)
    for i in range(COUNT):
        flange = pinocchio_flange(arm, q[i] + dq[i])
        np.testing.assert_allclose(
            chain.position[-1, i], flange.translation, rtol=0, atol=TOLERANCE
        )
        np.testing.assert_allclose(chain.rotation[-1, i], flange.rotation, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.5])
def test_twisted_links_agree_with_pinocchio(name: str, size: float) -> None:
    arm = arm_of(name)
    q, d = angles(arm), random_deviation(arm, size)
    assert d.dq is not None
    assert d.twist is not None
    chain = evaluate(arm, q, d)
    for i in range(COUNT):
        flange = pinocchio_flange(twisted(arm, d.twist[i]), q[i] + d.dq[i])
        np.testing.assert_allclose(
            chain.position[-1, i], flange.translation, rtol=0, atol=TOLERANCE
        )
        np.testing.assert_allclose(chain.rotation[-1, i], flange.rotation, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("name", ["ur10e", ODD])
def test_every_frame_is_its_matrix_product(name: str) -> None:
    arm = arm_of(name)
    q, d = angles(arm), random_deviation(arm, 0.02)
    assert d.dq is not None
    assert d.twist is not None
    chain = evaluate(arm, q, d)
    for i in range(COUNT):
        links = arm.links @ np.array([displacement(t) for t in d.twist[i]])
        pose = links[0]
        for k in range(arm.n + 1):
            here = se3.matrix(chain.rotation[k, i], chain.position[k, i])
            np.testing.assert_allclose(here, pose, rtol=0, atol=TOLERANCE)
            if k < arm.n:
                pose = pose @ displacement([0, 0, 0, 0, 0, q[i, k] + d.dq[i, k]])
                com = pose[:3, :3] @ arm.coms[k] + pose[:3, 3]
                np.testing.assert_allclose(chain.com[k, i], com, rtol=0, atol=TOLERANCE)
                pose = pose @ links[k + 1]


def motion_by(arm: Arm, q: Floats, d: Deviation, change: Deviation, offset: Floats) -> Floats:
    """Motion (N, 6) of a flange-fixed point per change along a deviation, by differences."""
    r0 = evaluate(arm, q, d).rotation[-1]

    def moved(t: float) -> Floats:
        scaled = Deviation(
            dq=None if change.dq is None else t * change.dq,
            twist=None if change.twist is None else t * change.twist,
        )
        chain = evaluate(arm, q, d + scaled)
        turn = chain.rotation[-1] @ np.swapaxes(r0, 1, 2)
        spin = [turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]]
        return np.column_stack([chain.point(offset), *spin])

    return slope(moved, 1e-3)


OFFSET = np.array([0.05, -0.1, 0.2])


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("size", [0.0, pytest.param(1e-3, marks=pytest.mark.slow), 0.3])
def test_jacobians_are_slopes(name: str, size: float) -> None:
    arm = arm_of(name)
    count = 3
    q, d = angles(arm, count), random_deviation(arm, size, count)
    chain = evaluate(arm, q, d)
    x = chain.point(OFFSET)
    by_joint = joint_jacobian(chain, x)
    for j in range(arm.n):
        change = np.zeros((count, arm.n))
        change[:, j] = 1.0
        expected = motion_by(arm, q, d, Deviation(dq=change), OFFSET)
        assert_close_relative(by_joint[:, :, j], expected)
    for k in range(arm.n + 1):
        own = None if chain.twist is None else chain.twist[k]
        by_slot = twist_jacobian(chain.rotation[k], x - chain.position[k], own)
        for axis in range(6):
            twist = np.zeros((count, arm.n + 1, 6))
            twist[:, k, axis] = 1.0
            expected = motion_by(arm, q, d, Deviation(twist=twist), OFFSET)
            assert_close_relative(by_slot[:, :, axis], expected)


def assert_close_relative(found: Floats, expected: Floats) -> None:
    """Within 1e-7 of the longest motion."""
    assert np.abs(found - expected).max() <= 1e-7 * np.abs(expected).max()


def test_no_states() -> None:
    arm = arm_of("ur10e")
    chain = evaluate(arm, np.zeros((0, 6)), Deviation(twist=np.zeros((0, 7, 6))))
    assert chain.position.shape == (7, 0, 3)
    assert joint_jacobian(chain, chain.position[-1]).shape == (0, 6, 6)


@pytest.mark.parametrize("name", ARMS)
def test_bodies_and_flange_are_where_pinocchio_has_them(name: str) -> None:
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
