"""Errors of a force sensor: zero, gain and mounting."""

from abc import abstractmethod
from typing import ClassVar

import numpy as np

from hilcal.effects.options import numbers
from hilcal.effects.protocol import Changeable, Columns, Effect, Parameter, Situation
from hilcal.errors import CannotAnswerError
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


class WrenchGain(ForceSensorEffect):
    """Recorded = (1 + g) true on each of the sensor's axes, exactly [1].

    acting = R diag(1/(1 + g)) Rᵀ w = w − R diag(g/(1 + g)) Rᵀ w. A common gain of all axes
    is the same as a common factor on all compliances, except for the deflection by weights.
    """

    name = "wrench_gain"
    summary = "wrench read = (1 + g) true per axis: the force sensor has a gain error"
    change = Changeable("setup", "force sensor", "the gain of the force sensor")
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
                f"{self.name}: a gain error of {100 * theta.min():.0f} % turns the wrench round; "
                "measure loads in more directions, or leave the effect out"
            )
        return np.asarray(recorded * (theta / (1 + theta)))

    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Return w/(1 + g)² on its own axis."""
        return np.asarray((recorded / (1 + theta) ** 2)[:, :, None] * np.eye(6))


class SensorMisalignment(ForceSensorEffect):
    """The sensor stands turned by δ: acting = R exp([δ]×) Rᵀ w, force and moment, exactly [rad]."""

    name = "sensor_misalignment"
    summary = "acting = R exp(δ) Rᵀ wrench: the force sensor's axes are turned by δ"
    plausible = 20.0  # 0.2 rad: bolted on by eye. A choice.

    parameters = tuple(
        Parameter(f"r{a}", "rad", 1e-2, f"turn of the sensor about its {a}") for a in "xyz"
    )

    def error(self, theta: Floats, recorded: Floats) -> Floats:
        """Return w − exp([δ]×) w."""
        turn = se3.rotation(theta)
        parts = [recorded[:, :3], recorded[:, 3:]]
        return np.concatenate([v - v @ turn.T for v in parts], axis=1)

    def error_columns(self, theta: Floats, recorded: Floats) -> Floats:
        """Return exp([δ]×) [w]× J_r(δ), the derivative of −exp([δ]×) w."""
        twist = np.concatenate([np.zeros(3), theta])
        turn, j = se3.rotation(theta), se3.right_jacobian_blocks(twist)[0]
        parts = [turn @ se3.skew(v) @ j for v in (recorded[:, :3], recorded[:, 3:])]
        return np.swapaxes(np.concatenate(parts, axis=1), 1, 2)
