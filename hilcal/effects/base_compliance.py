"""`base_compliance`: the ground or pedestal under the arm gives way."""

import numpy as np

from hilcal.effects.options import rated_moments
from hilcal.effects.protocol import Changeable, Parameter
from hilcal.effects.slot_compliance import SlotCompliance
from hilcal.robot import se3
from hilcal.types import Floats, Ints


class BaseCompliance(SlotCompliance):
    """Rotation B t_0 of the whole arm about the base origin; B diagonal, rad/(N·m).

    t_0 is the moment about the base origin, base axes. Slot 0 is the frame of the first
    joint, so moments are carried to the base origin and rotations back by L_0, exactly.
    """

    name = "base_compliance"
    summary = "rotation B t_0 about the base origin: the ground gives way"
    change = Changeable("base", "base", "the ground under the base", "loose bolts?")
    plausible = 30.0  # 30 mrad at the rated torque of the first joint: on a trolley. A choice.

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """About x, y, z; 1 mrad at the rated torque of the first joint is ordinary."""
        scale = 1e-3 / float(rated_moments(self.cell)[0])
        return tuple(
            Parameter(axis, "rad/(N·m)", scale, f"rotation of the base about {axis}")
            for axis in "xyz"
        )

    def laws(self) -> tuple[Ints, Floats]:
        """Twist of slot 0 by the rotation about each base axis that the moment about it causes."""
        l0 = self.cell.arm.links[0]
        back, r = se3.inverse(l0), l0[:3, :3]
        moments = np.hstack([se3.skew(l0[:3, 3]) @ r, r])
        twists = se3.adjoint(back[:3, :3], back[:3, 3])[:, 3:]
        return np.zeros(3, dtype=np.int64), np.einsum("ia,aj->aij", twists, moments)
