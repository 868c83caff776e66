"""`base_compliance`: the ground or pedestal under the arm gives way."""

import numpy as np

from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Response, Situation
from hilcal.robot import se3
from hilcal.types import Floats


class BaseCompliance(Effect):
    """Rotation B t_0 of the whole arm about the base origin; B diagonal, rad/(N·m).

    t_0 is the moment about the base origin, base axes. Slot 0 is the frame of the first
    joint, so moments are carried to the base origin and rotations back by L_0, exactly.
    """

    name = "base_compliance"
    summary = "rotation B t_0 about the base origin: the ground gives way"
    change = Changeable("base", "base", "the ground under the base", "loose bolts?")
    plausible = 30.0  # 90 µrad/(N·m): an arm on a trolley. A choice.
    elastic = True
    local_response = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Compliance about x, y and z of the base."""
        return tuple(
            Parameter(axis, "rad/(N·m)", 3e-6, f"rotation of the base about {axis}")
            for axis in "xyz"
        )

    def _moment(self, wrench: Floats) -> Floats:
        """Moment about the base origin, base axes, of slot-0 wrenches (..., 6)."""
        l0 = self.cell.arm.links[0]
        r, p = l0[:3, :3], l0[:3, 3]
        f, t = se3.apply(r, wrench[..., :3]), se3.apply(r, wrench[..., 3:])
        return t + se3.cross(p, f)

    def _twists(self) -> Floats:
        """(3, 6) twist in slot-0 axes of a unit rotation about each base axis."""
        back = se3.inverse(self.cell.arm.links[0])
        ad = se3.adjoint(back[:3, :3], back[:3, 3])
        return np.asarray(ad[:, 3:].T)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot 0 by t_0."""
        moment = self._moment(s.wrench[:, 0])
        values = moment[:, :, None] * self._twists()
        return (Columns("twist", np.arange(3), np.zeros(3, dtype=np.int64), values),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Twist of slot 0 by B dt_0."""
        twist = np.zeros_like(change)
        twist[:, :, 0] = (self._moment(change[:, :, 0]) * theta) @ self._twists()
        return Response(twist=twist)
