"""What the errors of a force sensor share: its axes, and the states in which it measured."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from hilcal.data.readings import States
from hilcal.effects.options import numbers
from hilcal.effects.protocol import Columns, Effect, Situation
from hilcal.robot import se3
from hilcal.robot.statics import load_wrench_change
from hilcal.types import Floats

FORCE_AXES = ("x", "y", "z")


class ForceSensorEffect(Effect):
    """The recorded wrench is what the force sensor measured; the acting one differs from it.

    It acts through the elastic effects only. With R the sensor's axes in base axes (the
    deflected flange, times an optional turn), w the recorded wrench at the load point as
    force and moment in sensor axes, and h the sensor's error:

        acting = w − R h(θ, Rᵀ w)

    States whose recorded wrench is exactly zero are unloaded: nothing was measured there.
    Errors of several kinds each act on the recorded wrench; their products are left out.
    """

    option_help: ClassVar = {
        "rotvec_rad": "the sensor's axes as configured in flange axes, a rotation vector; unless "
        "given, the flange's own."
    }

    def setup(self, states: States) -> None:
        """Read the sensor's axes in flange axes."""
        self.options.setdefault("rotvec_rad", [0.0, 0.0, 0.0])
        turn = numbers(self.name, self.options, "rotvec_rad", 3)
        self.axes = se3.rotation(turn)

    @abstractmethod
    def error(self, theta: Floats, recorded: Floats) -> Floats:
        """Return h (N, 6) for recorded wrenches (N, 6), both in sensor axes."""

    @abstractmethod
    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Derivative of h by the parameters, (N, P, 6) or (1, P, 6)."""

    def columns(self, s: Situation) -> tuple[Columns, ...]:
        """No deviation of its own."""
        return ()

    def wrench_change(self, theta: Floats, s: Situation) -> Floats:
        """Return −R h."""
        r = self._sensor(s)
        return -_turned(r, self.error(theta, self._recorded(s, r))) * _loaded(s)

    def wrench_columns(self, theta: Floats, s: Situation) -> Floats:
        """Slot wrenches by the derivative of −R h."""
        r = self._sensor(s)
        change = -_turned(r[:, None], self.error_columns(theta, self._recorded(s, r)))
        return load_wrench_change(s.chain, s.load, change * _loaded(s)[:, None])

    def _sensor(self, s: Situation) -> Floats:
        """(N, 3, 3) sensor axes in base axes."""
        return np.asarray(se3.product(s.chain.rotation[-1], self.axes))

    def _recorded(self, s: Situation, r: Floats) -> Floats:
        """(N, 6) recorded wrench, sensor axes."""
        return _turned(np.swapaxes(r, 1, 2), s.states.wrench)


def _turned(r: Floats, wrench: Floats) -> Floats:
    """Force and moment (..., 6) in the axes that R (..., 3, 3) leads to."""
    return np.concatenate([se3.apply(r, wrench[..., :3]), se3.apply(r, wrench[..., 3:])], axis=-1)


def _loaded(s: Situation) -> Floats:
    """(N, 1) 1 where a wrench was recorded, 0 where it is exactly zero."""
    return np.asarray(np.any(s.states.wrench != 0, axis=1)[:, None], dtype=float)
