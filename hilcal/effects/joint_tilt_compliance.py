"""`joint_tilt_compliance`: the joints' bearings tilt across their axes."""

import numpy as np

from hilcal.effects.options import rated_torques
from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats

ACROSS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])


class JointTiltCompliance(Effect):
    """Rotation at p_j of k_j (t_j − z_j z_jᵀ t_j), one compliance per joint [rad/(N·m)]."""

    name = "joint_tilt_compliance"
    summary = "rotation k_j t_j⊥ at joint j: its bearing tilts under the moment across its axis"
    elastic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One tilt compliance per joint; 1 mrad at the joint's rated torque is ordinary."""
        return tuple(
            Parameter(f"j{j + 1}", "rad/(N·m)", 1e-3 / rated, f"tilt compliance of joint {j + 1}")
            for j, rated in enumerate(rated_torques(self.cell))
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot j by the moment across the axis; slot axes have z along it."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("twist", joints, joints, s.wrench[:, :-1] * ACROSS),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Rotation k_j dt_j⊥."""
        k = np.append(theta, 0.0)
        return Response(twist=change * (k[:, None] * ACROSS))
