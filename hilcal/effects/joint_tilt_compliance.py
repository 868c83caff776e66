"""`joint_tilt_compliance`: the joints' bearings tilt across their axes."""

import numpy as np

from hilcal.effects.changed import Changeable
from hilcal.effects.options import rated_torques
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Columns, Parameter, Response, Situation
from hilcal.types import Floats

ACROSS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])


class JointTiltCompliance(PerJoint):
    """Rotation at p_j of k_j (t_j − z_j z_jᵀ t_j), a compliance of each joint [rad/(N·m)]."""

    name = "joint_tilt_compliance"
    summary = "rotation k_j t_j⊥ at joint j: its bearing tilts under the moment across its axis"
    change = Changeable(
        "joint", words="tilt compliance", cause="wear or crash?", options={"joints": "each"}
    )
    plausible = 10.0
    """10 mrad at the rated torque; cross-roller bearings state under 1. A choice."""
    elastic = True
    local_response = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One tilt compliance per joint; 1 mrad at the joint's rated torque is ordinary."""
        ordinary = 1e-3 / rated_torques(self.cell)
        return self.group_parameters("rad/(N·m)", ordinary, "tilt compliance of {joint}")

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot j by the moment across the axis; slot axes have z along it."""
        return (self.joint_columns("twist", s.wrench[:, :-1] * ACROSS),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Rotation k_j dt_j⊥."""
        k = np.append(self.of_joints(theta), 0.0)
        return Response(twist=change * (k[:, None] * ACROSS))
