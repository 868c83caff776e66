"""Where the bodies of an arm are."""

import numpy as np
import pinocchio as pin
import pytest

from hilcal.robot.body import body_poses
from hilcal.robot.pinocchio_model import FLANGE, pinocchio_model
from tests.support.arm_cases import ARMS, arm_of


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
