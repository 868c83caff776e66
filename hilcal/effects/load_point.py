"""`load_point`: the load acts elsewhere than configured."""

import numpy as np

from hilcal.effects.protocol import (
    Changeable,
    Columns,
    Effect,
    LoadChange,
    Parameter,
    Situation,
)
from hilcal.robot import se3
from hilcal.types import Floats


class LoadPoint(Effect):
    """Shift δ of the point where the wrench acts, flange axes [m]; it adds the moment (R δ) × f."""

    name = "load_point"
    summary = "the load acts elsewhere than configured (flange axes)"
    change = Changeable("tool", "load point", "where the load acts on the tool")
    plausible = 10.0  # 10 cm: a hook or an eye instead of the flange. A choice.
    of_setup = True

    parameters = tuple(Parameter(a, "m", 1e-2, f"shift along flange {a}") for a in "xyz")

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """No deviation of its own."""
        return ()

    def load_change(self, theta: Floats) -> LoadChange:
        """Shift of the load point."""
        return LoadChange(point=theta)

    def load_columns(self, theta: Floats, s: Situation) -> Floats:
        """Moment (R e) × f for a unit shift along each flange axis e."""
        axes = np.swapaxes(s.chain.rotation[-1], 1, 2)
        moment = se3.cross(axes, s.load.wrench[:, None, :3])
        return np.concatenate([np.zeros_like(moment), moment], axis=2)
