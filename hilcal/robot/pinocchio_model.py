"""The arm as a Pinocchio model, for cross-checks and for the simulated world."""

import numpy as np
import pinocchio as pin

from hilcal.robot.arm import Arm

FLANGE = "flange"


def pinocchio_model(arm: Arm) -> pin.Model:
    """Build a Pinocchio model with the same chain, masses and limits.

    Joint i is a revolute joint about z, or a prismatic one along z, with the placement L_{i-1} in
    body i - 1; bodies are point masses at their centres of mass; the frame "flange" has the
    placement L_n in the last body. Gravity is Pinocchio's default.
    """
    model = pin.Model()
    model.name = arm.name
    joint = 0
    for i in range(arm.n):
        joint = model.addJoint(
            joint,
            pin.JointModelPZ() if arm.slides[i] else pin.JointModelRZ(),
            pin.SE3(arm.links[i]),
            arm.joint_names[i],
            arm.torque_max[i : i + 1],
            np.array([np.inf]),
            arm.q_min[i : i + 1],
            arm.q_max[i : i + 1],
        )
        body = pin.Inertia(float(arm.masses[i]), arm.coms[i], np.zeros((3, 3)))
        model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    model.addFrame(pin.Frame(FLANGE, joint, 0, pin.SE3(arm.links[arm.n]), pin.FrameType.OP_FRAME))
    return model
