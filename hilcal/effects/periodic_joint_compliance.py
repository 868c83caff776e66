"""`periodic_joint_compliance`: a gear is softer in some positions than in others."""

from typing import ClassVar

import numpy as np

from hilcal.effects.per_joint import PerJoint
from hilcal.effects.protocol import Columns, Parameter, Response, Situation
from hilcal.errors import InputError
from hilcal.readings.readings import States
from hilcal.types import Floats

MOST_ORDER = 1000


class PeriodicJointCompliance(PerJoint):
    """dq_j = τ_j Σ_k (a_jk cos k q_j + b_jk sin k q_j) beside the mean c_j τ_j [rad/(N·m)].

    Joints that share parameters have the same phase at their zeros.
    """

    name = "periodic_joint_compliance"
    summary = "dq_j = τ_j (a_j cos 2q_j + b_j sin 2q_j): compliance changes with the joint angle"
    plausible = 10.0  # Twice an ordinary compliance; more would make it negative. A choice.
    elastic = True
    local_response = True
    option_help: ClassVar = {
        **PerJoint.option_help,
        "orders": "periods k per turn of the joint, a list of whole numbers, 1 to 1000; unless "
        "given, [2]: the two-lobed wave generator of a strain wave gear.",
    }

    def setup(self, states: States) -> None:
        """Read the orders."""
        super().setup(states)
        orders = self.options.setdefault("orders", [2])
        if (
            not isinstance(orders, list | tuple)
            or not orders
            or len(set(orders)) < len(orders)
            or not all(type(k) is int and 1 <= k <= MOST_ORDER for k in orders)
        ):
            raise InputError(
                f"effect {self.name}: orders = {orders!r}; valid: a list of different whole "
                f"numbers, 1 to {MOST_ORDER}"
            )
        self.orders = np.array(orders)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Two per joint and order; a fifth of an ordinary compliance."""
        kinds = {f".{w}{k}": f"{w} {k} q" for k in self.orders for w in ("cos", "sin")}
        meaning = "part of the compliance of {joint} that goes with {kind}"
        ordinary = np.where(self.cell.arm.slides, 2e-5, 6e-4) / self.cell.arm.ratings
        return self.group_parameters("rad/(N·m)", ordinary, meaning, kinds)

    def _waves(self, s: Situation) -> Floats:
        """(N, n, 2 K) cosine and sine of each order."""
        phase = s.angle[:, :, None] * self.orders
        waves = np.stack([np.cos(phase), np.sin(phase)], axis=-1)
        return waves.reshape(*s.angle.shape, -1)

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Torque times wave: ∂dq_j/∂a_jk = τ_j cos k q_j."""
        return (self.kind_columns(s.torque[:, :, None] * self._waves(s)),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Return the compliance at the angle times dτ_j."""
        amplitudes = self.of_joints(theta.reshape(-1, 2 * len(self.orders)))
        compliance = np.sum(self._waves(s) * amplitudes, axis=2)
        return Response(dq=s.along(change) * compliance[:, None, :])
