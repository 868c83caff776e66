"""`encoder_offset`: the joints' zeros are off."""

import numpy as np

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Changeable, Columns, Situation


class EncoderOffset(PerJoint):
    """dq_j = o_j, constant [rad]."""

    name = "encoder_offset"
    unit, size, meaning = "rad", 1e-3, "zero offset of {joint}"
    summary = "dq_j = o_j: the zero of each joint is off"
    kinematic = True
    change = Changeable(
        "joint",
        words="zero",
        cause="repair, crash or a slipped joint?",
        listed=True,
        by_frame=True,
        with_others=True,
    )
    plausible = 5.0  # 5 mrad: mastering to a mark, without a gauge, leaves 0.1° to 0.5°. A choice.

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit steps: ∂dq_j/∂o_j = 1."""
        return (self.joint_columns("dq", np.ones((1, self.cell.arm.n))),)
