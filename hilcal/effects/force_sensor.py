"""Base of the errors of a force sensor: its axes, and the states in which it measured."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from hilcal.effects.options import numbers
from hilcal.effects.protocol import Columns, Effect, Situation
from hilcal.readings.readings import States
from hilcal.robot import se3
from hilcal.robot.statics import load_wrench_change
from hilcal.types import Floats

ALONG_FLANGE: Floats = np.eye(3)  # Axes of a force sensor that are those of the flange


class ForceSensorEffect(Effect):
    """The recorded wrench is what the force sensor measured; the acting one differs from it.

    It acts through the elastic effects only. With R the sensor's axes in base axes (the
    deflected flange, times an optional turn), w the recorded wrench at the load point as
    force and moment in sensor axes, and h the sensor's error:

        acting = w − R h(θ, Rᵀ w)

    States whose recorded wrench is exactly zero are unloaded: nothing was measured there.
    Errors of several kinds each act on the recorded wrench; their products are left out.
    """

    of_setup = True
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
        return acting_change(s, self.error(theta, recorded(s, self.axes)), self.axes)

    def load_columns(self, theta: Floats, s: Situation) -> Floats:
        """Derivative of −R h."""
        return _acting(s, self.error_columns(theta, recorded(s, self.axes)), self.axes)


def recorded(s: Situation, axes: Floats = ALONG_FLANGE) -> Floats:
    """Return the recorded wrench (N, 6) in sensor axes (3, 3) of the flange, N and N·m."""
    return _turned(np.swapaxes(_sensor(s, axes), 1, 2), s.states.wrench)


def acting_change(s: Situation, error: Floats, axes: Floats = ALONG_FLANGE) -> Floats:
    """Return −R h (N, 6), base axes, of the sensor's error h (N, 6); see `recorded`."""
    return -_turned(_sensor(s, axes), error) * _loaded(s)


def acting_columns(s: Situation, columns: Floats) -> Floats:
    """Slot wrenches (N, P, n + 1, 6) by −R h, of the derivative (N or 1, P, 6) of h."""
    return load_wrench_change(s.chain, s.load, _acting(s, columns, ALONG_FLANGE))


def sensor_error(s: Situation, change: Floats) -> Floats:
    """Return h (N, 6), flange axes, of a change −R h (N, 6) of the load's wrench."""
    return -_turned(np.swapaxes(_sensor(s, ALONG_FLANGE), 1, 2), change)


def _acting(s: Situation, columns: Floats, axes: Floats) -> Floats:
    """−R h (N, P, 6), base axes, of the derivative (N or 1, P, 6) of h."""
    return -_turned(_sensor(s, axes)[:, None], columns) * _loaded(s)[:, None]


def _sensor(s: Situation, axes: Floats) -> Floats:
    """(N, 3, 3) sensor axes in base axes."""
    return np.asarray(se3.product(s.chain.rotation[-1], axes))


def _turned(r: Floats, wrench: Floats) -> Floats:
    """Force and moment (..., 6), rotated by R (..., 3, 3)."""
    return np.concatenate([se3.apply(r, wrench[..., :3]), se3.apply(r, wrench[..., 3:])], axis=-1)


def _loaded(s: Situation) -> Floats:
    """(N, 1) 1 where a wrench was recorded, 0 where it is exactly zero."""
    return np.asarray(np.any(s.states.wrench != 0, axis=1)[:, None], dtype=float)
