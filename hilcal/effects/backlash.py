"""`backlash`: the gear's play is taken up on the side to which the torque pushes."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import positive, rated_torques
from hilcal.effects.per_joint import PerJoint, joint_change
from hilcal.effects.protocol import Columns, Response, Situation
from hilcal.readings.readings import States
from hilcal.types import Floats


class Backlash(PerJoint):
    """dq_j = b_j sign(τ_j), crossing smoothly: b_j tanh(τ_j/τ0_j) [rad]."""

    name = "backlash"
    unit, size, meaning = "rad", 5e-5, "half the play of {joint}"
    summary = "dq_j = b_j sign(τ_j): the joint's play is taken up to the side of the torque"
    change = joint_change("play", "wear or repair?", listed=True)
    plausible = 20.0  # 1 mrad; makers of gears state 0.3 mrad at most. A choice.
    elastic = True
    local_response = True
    option_help: ClassVar = {
        **PerJoint.option_help,
        "crossing": "τ0_j as a share of the joint's rated torque, more than 0; unless given, 0.01.",
    }

    def setup(self, states: States) -> None:
        """Read how wide the crossing is."""
        super().setup(states)
        self.options.setdefault("crossing", 0.01)
        self.crossing = positive(self.name, self.options, "crossing") * rated_torques(self.cell)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Sides: ∂dq_j/∂b_j = tanh(τ_j/τ0_j)."""
        return (self.joint_columns("dq", np.tanh(s.torque / self.crossing)),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return b_j (1 − tanh²(τ_j/τ0_j))/τ0_j dτ_j."""
        side = np.tanh(s.torque / self.crossing)
        slope = self.of_joints(theta) * (1 - side**2) / self.crossing
        return Response(dq=s.along(change) * slope[:, None, :])
