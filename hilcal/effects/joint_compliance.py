"""`joint_compliance`: the drive train twists under torque."""

import numpy as np

from hilcal.effects.options import rated_torques
from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats


class JointCompliance(Effect):
    """dq_j = c_j τ_j, one compliance per joint [rad/(N·m)]."""

    name = "joint_compliance"
    summary = "dq_j = c_j τ_j: each joint gives way in proportion to its torque"
    elastic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One compliance per joint; 3 mrad at the joint's rated torque are ordinary."""
        return tuple(
            Parameter(f"j{j + 1}", "rad/(N·m)", 3e-3 / rated, f"compliance of joint {j + 1}")
            for j, rated in enumerate(rated_torques(self.cell))
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Torques: ∂dq_j/∂c_j = τ_j."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, s.torque),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return dq_j = c_j dτ_j."""
        return Response(dq=change[:, :, :-1, 5] * theta)

    def compliance(self, theta: Floats) -> Floats:
        """Return c itself: `creep` builds on it."""
        return theta
