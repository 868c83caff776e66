"""`encoder_offset`: the joints' zeros are off."""

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter, Situation


class EncoderOffset(Effect):
    """dq_j = o_j, constant [rad]."""

    name = "encoder_offset"
    summary = "dq_j = o_j: the zero of each joint is off"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One offset per joint."""
        return tuple(
            Parameter(f"j{j + 1}", "rad", 1e-3, f"zero offset of joint {j + 1}")
            for j in range(self.cell.arm.n)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit steps: ∂dq_j/∂o_j = 1."""
        joints = np.arange(self.cell.arm.n)
        return (Columns("dq", joints, joints, np.ones((1, len(joints)))),)
