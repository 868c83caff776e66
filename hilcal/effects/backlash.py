"""`backlash`: the gear's play is taken up on the side to which the torque pushes."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import positive
from hilcal.effects.per_joint import TorqueLaw
from hilcal.effects.protocol import Changeable, Situation
from hilcal.readings.readings import States
from hilcal.types import Floats


class Backlash(TorqueLaw):
    """dq_j = b_j sign(τ_j), crossing smoothly: b_j tanh(τ_j/τ0_j) [rad]."""

    name = "backlash"
    unit, size, meaning = "rad", 5e-5, "half the play of {joint}"
    summary = "dq_j = b_j sign(τ_j): the joint's play is taken up to the side of the torque"
    change = Changeable("joint", words="play", cause="wear or repair?", listed=True)
    plausible = 20.0  # 1 mrad; makers of gears state 0.3 mrad at most. A choice.
    option_help: ClassVar = {
        **TorqueLaw.option_help,
        "crossing": "τ0_j as a share of the joint's rated torque, more than 0; unless given, 0.01.",
    }

    def setup(self, states: States) -> None:
        """Read how wide the crossing is."""
        super().setup(states)
        self.options.setdefault("crossing", 0.01)
        self.crossing = positive(self.name, self.options, "crossing") * self.cell.arm.ratings

    def of_torque(self, s: Situation) -> tuple[Floats, Floats]:
        """Return tanh(τ_j/τ0_j), and (1 − tanh²(τ_j/τ0_j))/τ0_j."""
        side = np.tanh(s.torque / self.crossing)
        return side, (1 - side**2) / self.crossing
