"""`joint_compliance`: the drive train twists under torque."""

from hilcal.effects.options import ordinary_give, rated_torques
from hilcal.effects.per_joint import PerJoint, joint_change
from hilcal.effects.protocol import Columns, Response, Situation
from hilcal.types import Floats


class JointCompliance(PerJoint):
    """dq_j = c_j τ_j, a compliance of each joint [rad/(N·m)]; of a slide c_j f_j [m/N]."""

    name = "joint_compliance"
    unit, meaning = "rad/(N·m)", "compliance of {joint}"
    summary = "dq_j = c_j τ_j: each joint gives way in proportion to its torque"
    change = joint_change("compliance", "wear, crash or repair?", listed=True, with_others=True)
    plausible = 10.0  # 30 mrad at the rated torque; gears state 1 to 5. A choice.
    spread = 0.5  # Springs and oil of one type of gear scatter by a third; a choice
    elastic = True
    local_response = True
    role = "baseline"

    def ordinary(self) -> Floats:
        """3 mrad (0.1 mm) at the rated torque (force)."""
        return ordinary_give(self.cell) / rated_torques(self.cell)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Torques: ∂dq_j/∂c_j = τ_j."""
        return (self.joint_columns("dq", s.torque),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return dq_j = c_j dτ_j."""
        return Response(dq=s.along(change) * self.of_joints(theta))

    def compliance(self, theta: Floats) -> Floats:
        """Return c itself: `creep` builds on it."""
        return self.of_joints(theta)
