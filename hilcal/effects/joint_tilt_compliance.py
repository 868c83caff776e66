"""`joint_tilt_compliance`: the joints' bearings tilt across their axes."""

import numpy as np

from hilcal.effects.options import rated_moments
from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Changeable, Columns, Parameter, Response, Situation
from hilcal.types import Floats

ACROSS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 0.0])
TURNS = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


class JointTiltCompliance(PerJoint):
    """Rotation at p_j of k_j (t_j − z_j z_jᵀ t_j), a compliance of each joint [rad/(N·m)].

    The carriage of a slide turns about all three axes, about its point on the joint's axis, by the
    moment there: with q the travel, t = t_j − q z_j × f_j.
    """

    name = "joint_tilt_compliance"
    summary = "rotation k_j t_j⊥ at joint j: its bearing tilts under the moment across its axis"
    change = Changeable("joint", words="tilt compliance", cause="wear or crash?")
    plausible = 10.0  # 10 mrad at the rated torque; cross-roller bearings state under 1. A choice.
    elastic = True
    local_response = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """One tilt compliance per joint; 1 mrad at the joint's rated torque is ordinary."""
        ordinary = 1e-3 / rated_moments(self.cell)
        meaning = "tilt compliance of {joint}"
        return self.group_parameters("rad/(N·m)", ordinary, meaning, of_drive=False)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of slot j by the moment across the axis; slot axes have z along it."""
        return (self.joint_columns("twist", self._tilt(s.wrench[:, :-1], self._travel(s))),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Rotation k_j dt_j⊥."""
        k = np.append(self.of_joints(theta), 0.0)
        if not self.cell.arm.slides.any():
            return Response(twist=change * (k[:, None] * ACROSS))
        turned = self._tilt(change[:, :, :-1], self._travel(s)[:, None])
        return Response(twist=np.pad(turned, ((0, 0), (0, 0), (0, 1), (0, 0))) * k[:, None])

    def _travel(self, s: Situation) -> Floats:
        """(N, n) displacements of the slides, m; 0 of joints that turn."""
        return np.asarray(self.cell.arm.chain_angles(s.values) * self.cell.arm.slides)

    def _tilt(self, w: Floats, travel: Floats) -> Floats:
        """Twists (..., n, 6) of the slots by wrenches there, for a compliance of 1."""
        slides = self.cell.arm.slides
        if not slides.any():
            return np.asarray(w * ACROSS)
        turned = w * np.where(slides[:, None], TURNS, ACROSS) + 0.0 * travel[..., None]
        turned[..., 3] += travel * w[..., 1]
        turned[..., 4] -= travel * w[..., 0]
        turned[..., 0], turned[..., 1] = -travel * turned[..., 4], travel * turned[..., 3]
        return np.asarray(turned)
