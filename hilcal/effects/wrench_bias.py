"""`wrench_bias`: the force sensor reads something when nothing pulls."""

import numpy as np

from hilcal.effects.force_sensor import ForceSensorEffect
from hilcal.effects.protocol import Changeable, Parameter
from hilcal.types import Floats


class WrenchBias(ForceSensorEffect):
    """Recorded = true + b, so that acting = w − R b; b at the load point, sensor axes [N, N·m]."""

    name = "wrench_bias"
    summary = "wrench read = true + b: the force sensor has a constant offset, in its own axes"
    change = Changeable("setup", "force sensor", "the zero of the force sensor")
    plausible = 30.0  # 30 N, 3 N·m: a sensor that was not zeroed with its tool. A choice.

    parameters = (
        *(Parameter(f"f{a}", "N", 1.0, f"offset of the force along {a}") for a in "xyz"),
        *(Parameter(f"m{a}", "N·m", 0.1, f"offset of the moment about {a}") for a in "xyz"),
    )

    def error(self, theta: Floats, recorded: Floats) -> Floats:
        """Return b."""
        return np.broadcast_to(theta, recorded.shape)

    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Units."""
        return np.eye(6)[None]
