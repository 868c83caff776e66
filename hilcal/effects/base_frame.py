"""`base_frame`: the registration of the tracker to the base is off."""

from typing import ClassVar

import numpy as np

from hilcal.effects.options import PRIOR_HELP
from hilcal.effects.protocol import Columns, Effect, Parameter, Situation


class BaseFrame(Effect):
    """Twist of the base relative to its registration, base axes [m, rad]."""

    name = "base_frame"
    summary = "registration of the tracker to the arm's base is off"
    plausible = 20.0  # 20 mm, 20 mrad: a base that was surveyed by hand. A choice.
    of_setup = True
    option_help: ClassVar = PRIOR_HELP
    role = "registration"

    parameters = (
        *(Parameter(a, "m", 1e-3, f"base shift along {a}") for a in "xyz"),
        *(Parameter(f"r{a}", "rad", 1e-3, f"base turn about {a}") for a in "xyz"),
    )

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """Unit twists of the base."""
        index = np.arange(6)
        return (Columns("base", index, 0 * index, np.eye(6)[None]),)
