"""`tool_compliance`: what is bolted to the flange tilts under the moment there."""

import numpy as np

from hilcal.effects.options import rated_moments
from hilcal.effects.protocol import Changeable, Parameter
from hilcal.effects.slot_compliance import SlotCompliance
from hilcal.types import Floats, Ints


class ToolCompliance(SlotCompliance):
    """Rotation at the flange of a t_z z + c t_⊥, t the moment there: adapter, sensor, changer.

    t is the moment about the flange's origin of tool and load; a (along) and c (across the
    flange's z axis) in rad/(N·m). Where the last joint turns about z, a is the same as that
    joint's compliance.
    """

    name = "tool_compliance"
    summary = "rotation a t_z + c t_⊥ at the flange: tool or force sensor tilts under the moment"
    change = Changeable("tool", "tool", "the stiffness of what is bolted to the flange")
    plausible = 30.0  # 30 mrad at the rated torque of the last joint: a slender tool. A choice.
    of_setup = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Along and across; 1 mrad at the rated torque of the last joint is ordinary."""
        scale = 1e-3 / float(rated_moments(self.cell)[-1])
        return (
            Parameter("along", "rad/(N·m)", scale, "turn about the flange's z axis"),
            Parameter("across", "rad/(N·m)", scale, "tilt across the flange's z axis"),
        )

    def laws(self) -> tuple[Ints, Floats]:
        """Twist of slot n by the moment at the flange, about z and across it."""
        parts = np.diag([0, 0, 0, 0, 0, 1.0]), np.diag([0, 0, 0, 1.0, 1.0, 0])
        return np.full(2, self.cell.arm.n), np.array(parts)
