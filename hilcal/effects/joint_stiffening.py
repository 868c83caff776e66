"""`joint_stiffening`: a gear stiffens under load."""

import numpy as np

from hilcal.effects.options import rated_torques
from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats


class JointStiffening(Effect):
    """dq_j = s_j τ_j³ beside the linear term; a gear that stiffens has s_j < 0."""

    name = "joint_stiffening"
    summary = "dq_j = s_j τ_j³: compliance changes with the torque (s_j < 0: stiffens)"
    elastic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One coefficient per joint; as much as the compliance at the joint's rated torque."""
        return tuple(
            Parameter(f"j{j + 1}", "rad/(N·m)³", 3e-3 / rated**3, f"stiffening of joint {j + 1}")
            for j, rated in enumerate(rated_torques(self.cell))
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Cubes of the torques: ∂dq_j/∂s_j = τ_j³."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, s.torque**3),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return dq_j = 3 s_j τ_j² dτ_j."""
        slope = 3 * theta * s.torque**2
        return Response(dq=change[:, :, :-1, 5] * slope[:, None, :])
