"""The law that links, the base and the tool share: a slot of the chain yields."""

from abc import abstractmethod

import numpy as np

from hilcal.effects.protocol import Columns, Effect, Response, Situation
from hilcal.types import Floats, Ints


class SlotCompliance(Effect):
    """Twist θ_p L_p w of a slot by the wrench w there, for each parameter θ_p."""

    elastic = True
    local_response = True

    @abstractmethod
    def laws(self) -> tuple[Ints, Floats]:
        """Slots (P,) and L (P, 6, 6), in the axes of the slot."""

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Twist of each slot by the wrench there, for a unit of each parameter."""
        slots, laws = self.laws()
        values = np.stack([s.wrench[:, k] @ x.T for k, x in zip(slots, laws, strict=True)], axis=1)
        return (Columns("twist", np.arange(len(slots)), slots, values),)

    def response(self, theta: Floats, s: Situation, change: Floats) -> Response:
        """Twist of each slot by the change of the wrench there."""
        twist = np.zeros_like(change)
        for k, law, t in zip(*self.laws(), theta, strict=True):
            twist[:, :, k] += change[:, :, k] @ (t * law.T)
        return Response(twist=twist)
