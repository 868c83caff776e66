"""`joint_stiffening`: a gear stiffens under load."""

from hilcal.effects.options import ordinary_joint_motions
from hilcal.effects.per_joint import TorqueLaw
from hilcal.effects.protocol import Situation
from hilcal.types import Floats


class JointStiffening(TorqueLaw):
    """dq_j = s_j τ_j³ in addition to the linear term; a gear that stiffens has s_j < 0."""

    name = "joint_stiffening"
    unit, meaning = "rad/(N·m)³", "stiffening of {joint}"
    summary = "dq_j = s_j τ_j³: compliance changes with the torque (s_j < 0: stiffens)"
    plausible = 10.0  # 30 mrad at the rated torque, as for joint_compliance. A choice.

    def ordinary(self) -> Floats:
        """As much as the compliance at the joint's rated torque."""
        return ordinary_joint_motions(self.cell) / self.cell.arm.ratings**3

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return τ_j³, and 3 τ_j²."""
        return s.torque**3, 3 * s.torque**2
