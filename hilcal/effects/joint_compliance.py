"""`joint_compliance`: the drive train twists under torque."""

import numpy as np

from hilcal.effects.options import ordinary_joint_motions
from hilcal.effects.per_joint import TorqueLaw
from hilcal.effects.protocol import Changeable, Situation
from hilcal.types import Floats


class JointCompliance(TorqueLaw):
    """dq_j = c_j τ_j, a compliance of each joint [rad/(N·m)]; of a slide c_j f_j [m/N]."""

    name = "joint_compliance"
    unit, meaning = "rad/(N·m)", "compliance of {joint}"
    summary = "dq_j = c_j τ_j: each joint gives way in proportion to its torque"
    change = Changeable(
        "joint", words="compliance", cause="wear, crash or repair?", listed=True, with_others=True
    )
    plausible = 10.0  # 30 mrad at the rated torque; gears state 1 to 5. A choice.
    spread = 0.5  # Springs and oil of one type of gear scatter by a third; a choice
    role = "baseline"

    def ordinary(self) -> Floats:
        """3 mrad (0.1 mm) at the rated torque (force)."""
        return ordinary_joint_motions(self.cell) / self.cell.arm.ratings

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return τ_j, and 1."""
        return s.torque, np.ones((1, self.cell.arm.n))

    def compliance(self, theta: Floats) -> Floats:
        """Return c itself: `creep` builds on it."""
        return self.of_joints(theta)
