"""`hysteresis`: friction and lost motion, by the side from which a joint arrived."""

import numpy as np

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Changeable, Columns, Parameter, Situation


class Hysteresis(PerJoint):
    """dq_j = h_j s_j with s_j = ±1 the side from which joint j arrived [rad]."""

    name = "hysteresis"
    summary = "dq_j = h_j s_j: the joint stops short on the side from which it arrived"
    change = Changeable(
        "joint",
        words="lost motion",
        cause="wear or repair?",
        listed=True,
        options={"joints": "each"},
    )
    plausible = 50.0
    """1 mrad; lost motion that makers of gears state is 0.3 mrad at most. A choice."""
    needs = ("approach",)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Half width of the loop, per joint."""
        ordinary = np.full(self.cell.arm.n, 2e-5)
        return self.group_parameters("rad", ordinary, "half hysteresis of {joint}")

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Sides: ∂dq_j/∂h_j = s_j."""
        assert s.states.approach is not None  # noqa: S101 - checked at construction
        return (self.joint_columns("dq", s.states.approach),)
