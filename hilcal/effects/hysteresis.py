"""`hysteresis`: friction and lost motion, by the side from which a joint arrived."""

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter, Situation


class Hysteresis(Effect):
    """dq_j = h_j s_j with s_j = ±1 the side from which joint j arrived [rad]."""

    name = "hysteresis"
    summary = "dq_j = h_j s_j: the joint stops short on the side from which it arrived"
    needs = ("approach",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Half width of the loop, per joint."""
        return tuple(
            Parameter(f"j{j + 1}", "rad", 2e-5, f"half hysteresis of joint {j + 1}")
            for j in range(self.cell.arm.n)
        )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Sides: ∂dq_j/∂h_j = s_j."""
        joints = np.arange(self.cell.arm.n)
        assert s.states.approach is not None  # noqa: S101 - checked at construction
        return (Columns("dq", joints, joints, s.states.approach),)
