"""`wrench_gain`: the force sensor's axes each read too much or too little."""

import numpy as np

from hilcal.effects.force_sensor import ForceSensorEffect
from hilcal.effects.protocol import Changeable, Parameter
from hilcal.errors import CannotAnswerError
from hilcal.types import Floats


class WrenchGain(ForceSensorEffect):
    """Recorded = (1 + g) true on each of the sensor's axes, exactly [1].

    acting = R diag(1/(1 + g)) Rᵀ w = w − R diag(g/(1 + g)) Rᵀ w. A common gain of all axes
    is the same as a common factor on all compliances, except for the deflection by weights.
    """

    name = "wrench_gain"
    summary = "wrench read = (1 + g) true per axis: the force sensor has a gain error"
    change = Changeable(
        "setup", "force sensor", "the gain of the force sensor, or the masses stated of the loads"
    )
    plausible = 50.0  # 50 %: a wrong calibration matrix, a channel that hardly reads. A choice.

    parameters = tuple(
        Parameter(f"{kind}{a}", "1", 1e-2, f"gain error of the {word} {a}")
        for kind, word in (("f", "force along"), ("m", "moment about"))
        for a in "xyz"
    )

    def error(self, theta: Floats, recorded: Floats) -> Floats:
        """Return g/(1 + g) w per axis."""
        if np.any(theta <= -1):
            raise CannotAnswerError(
                f"{self.name}: a gain error of {100 * theta.min():.0f} % reverses the wrench; "
                "measure loads in more directions, or leave the effect out"
            )
        return np.asarray(recorded * (theta / (1 + theta)))

    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Return w/(1 + g)² on its own axis."""
        return np.asarray((recorded / (1 + theta) ** 2)[:, :, None] * np.eye(6))
