"""`load_point`: the load acts elsewhere than configured."""

import numpy as np

from hilcal.effects.protocol import Changeable, Columns, Effect, LoadChange, Parameter, Situation
from hilcal.robot import se3
from hilcal.robot.statics import slot_wrench_change
from hilcal.types import Floats


class LoadPoint(Effect):
    """Shift of the point where the wrench acts, flange axes [m].

    It acts through the elastic effects only: a shift δ changes the moment at the flange
    by (R δ) × f.
    """

    name = "load_point"
    summary = "the load acts elsewhere than configured (flange axes)"
    change = Changeable("tool", "load point", "where the load acts on the tool")
    plausible = 10.0  # 10 cm: a hook or an eye instead of the flange. A choice.
    of_setup = True

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Shift along x, y and z of the flange."""
        return tuple(Parameter(a, "m", 1e-2, f"shift along flange {a}") for a in "xyz")

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

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats:
        """Moments of unit shifts, carried by all slots."""
        change = self.load_columns(theta, s)
        return slot_wrench_change(s.chain, change[..., :3], change[..., 3:])
