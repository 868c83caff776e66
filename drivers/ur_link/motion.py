"""A motion under way: has it arrived, and is it overdue."""

import time

import numpy as np

from hilcal.drivers.ur_link.reading import Reading
from hilcal.measuring.route import duration
from hilcal.types import Floats

STANDS_RAD_S = 0.01
"""Joints slower than this stand; measured speeds are noisy, rad/s."""
MARGIN_S = 5.0
"""What a motion may take longer than it should, and how long it may be paused, real s."""
SLACK = 1.5
"""A motion may take so many times its computed time."""
SLOWEST = 0.02
"""A motion is not waited for at a smaller share of its speed."""
_TARGET_RAD = 1e-5
_BRAKE_S = 0.15
_BRAKE_MIN, _BRAKE_MAX = 2.0, 10.0


def deceleration(speed: float) -> float:
    """Return how the leading joint brakes from a speed, rad/s²; about 0.15 s to a stand."""
    return float(np.clip(speed / _BRAKE_S, _BRAKE_MIN, _BRAKE_MAX))


def stands(reading: Reading) -> bool:
    """Whether no joint moves."""
    return float(np.abs(reading.sample.qd).max()) < STANDS_RAD_S


class MotionInProgress:
    """A commanded motion, and how much of its time it has used.

    Attributes:
        brake: deceleration for stopping it, rad/s².
    """

    def __init__(
        self,
        start: Floats,
        goal: Floats,
        speed: float,
        acceleration: float,
        arrival: float,
        clock: float,
    ) -> None:
        """Begin, from `start` to `goal` (6,), rad.

        Speed and acceleration are of the leading joint, rad/s and rad/s²; `arrival` is the largest
        joint error at its end, rad; `clock` cell seconds per real second.
        """
        self.brake = deceleration(speed)
        self._goal, self._arrival = goal, arrival
        self._usual = duration(start, goal, speed, acceleration) / clock
        self._spent = 0.0
        self._looked = time.monotonic()
        self._paused: float | None = None

    def arrived(self, reading: Reading) -> bool:
        """Whether target and actual joints are at the goal, and stand."""
        sample = reading.sample
        return (
            float(np.abs(sample.q_target - self._goal).max()) <= _TARGET_RAD
            and float(np.abs(sample.q - self._goal).max()) <= self._arrival
            and stands(reading)
        )

    def overdue(self, reading: Reading) -> str | None:
        """Return in one line why the motion is given up, or None; call at every look.

        Time counts by the share of the speed that the controller allows.
        """
        sample, now = reading.sample, time.monotonic()
        since, self._looked = now - self._looked, now
        self._spent += since * max(min(sample.speed_scaling, 1.0), SLOWEST)
        if sample.speed_scaling >= SLOWEST:
            self._paused = None
        elif self._paused is None:
            self._paused = now
        elif now - self._paused > MARGIN_S:
            return f"its speed has been scaled to 0 for {MARGIN_S:g} s (speed slider, or paused)"
        if self._spent <= SLACK * self._usual + MARGIN_S:
            return None
        off = np.abs(sample.q - self._goal)
        k = int(np.argmax(off))
        return (
            f"it did not arrive in time: joint {k + 1} stands {off[k]:.3g} rad off its goal "
            f"(arrival_rad is {self._arrival:g})"
        )
