"""`joint_stiffening`: a gear stiffens under load."""

from hilcal.effects.options import ordinary_give, rated_torques
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Columns, Response, Situation
from hilcal.types import Floats


class JointStiffening(PerJoint):
    """dq_j = s_j τ_j³ beside the linear term; a gear that stiffens has s_j < 0."""

    name = "joint_stiffening"
    unit, meaning = "rad/(N·m)³", "stiffening of {joint}"
    summary = "dq_j = s_j τ_j³: compliance changes with the torque (s_j < 0: stiffens)"
    plausible = 10.0  # 30 mrad at the rated torque, as for joint_compliance. A choice.
    elastic = True
    local_response = True

    def ordinary(self) -> Floats:
        """As much as the compliance at the joint's rated torque."""
        return ordinary_give(self.cell) / rated_torques(self.cell) ** 3

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Cubes of the torques: ∂dq_j/∂s_j = τ_j³."""
        return (self.joint_columns("dq", s.torque**3),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return dq_j = 3 s_j τ_j² dτ_j."""
        slope = 3 * self.of_joints(theta) * s.torque**2
        return Response(dq=s.along(change) * slope[:, None, :])
