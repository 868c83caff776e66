"""`invented`: a law that the catalogue lacks, for `hilcal demo --hide invented`.

It is hidden like a user's effect (`user_effect`); the program that fits does not get this file.
"""

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Parameter, Response, Situation
from hilcal.types import Floats

JOINT, BY = 2, 4  # index of the compliant joint, and of the joint whose angle sets the compliance


class Invented(Effect):
    """dq_3 = a cos(q_5) τ_3: the wrist's angle changes the compliance of joint 3, like a hose."""

    name = "invented"
    summary = "dq_3 = a·cos(q_5)·τ_3"
    elastic = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The coefficient."""
        return (Parameter("a", "rad/(N·m)", 1e-6, "joint 3"),)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Derivative of the joint's displacement with respect to the coefficient."""
        values = np.cos(s.angle[:, BY]) * s.torque[:, JOINT]
        return (Columns("dq", np.array([0]), np.array([JOINT]), values[:, None]),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Change of the displacement by changes (N, P, n + 1, 6) of the wrenches."""
        slots = change.shape[2]
        dq = np.zeros((len(s.angle), change.shape[1], slots - 1))
        compliance = theta[0] * np.cos(s.angle[:, BY])
        dq[:, :, JOINT] = compliance[:, None] * change[:, :, JOINT, 5]
        return Response(dq=dq, twist=np.zeros((len(s.angle), change.shape[1], slots, 6)))
