"""The commanded trajectory: straight lines in joint space with trapezoidal speed.

All times are world time in s; the caller says what time it is.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats

_NOTHING = 1e-9  # rad: no motion


@dataclass(frozen=True, slots=True, eq=False)
class LinearMotion:
    """A motion along a line; s is the way of the leading joint.

    q(s) = origin + direction * s, s' piecewise linear.

    Attributes:
        origin: (n,) rad.
        direction: (n,) the leading joint's element is -1 or +1.
        pieces: (duration in s, speed at its start in rad/s, acceleration in rad/s²) in order.
    """

    origin: Floats
    direction: Floats
    pieces: tuple[tuple[float, float, float], ...]

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return sum(piece[0] for piece in self.pieces)

    def at(self, time: float) -> tuple[float, float]:
        """Return way and speed of the leading joint at a time since the start."""
        way, speed = 0.0, 0.0
        for duration, speed0, acceleration in self.pieces:
            t = min(time, duration)
            way += speed0 * t + 0.5 * acceleration * t * t
            speed = speed0 + acceleration * t
            if time < duration:
                return way, speed
            time -= duration
        return way, 0.0

    @property
    def length(self) -> float:
        """Way of the leading joint, rad."""
        return self.at(self.duration)[0]


def line(origin: Floats, goal: Floats, speed: float, acceleration: float) -> LinearMotion | None:
    """Return the motion from rest to rest; None where there is none to make.

    v = min(speed, sqrt(a d)), ramps of v / a, and d / v - v / a in between.
    """
    way = goal - origin
    length = float(np.max(np.abs(way)))
    if length < _NOTHING:
        return None
    acceleration = max(acceleration, 1e-6)
    top = min(max(speed, 1e-6), float(np.sqrt(acceleration * length)))
    ramp = top / acceleration
    cruise = max(0.0, length / top - ramp)
    pieces = ((ramp, 0.0, acceleration), (cruise, top, 0.0), (ramp, top, -acceleration))
    return LinearMotion(origin, way / length, pieces)


class Trajectory:
    """Where the commanded arm is, and what has been told to it.

    Attributes:
        q: (n,) rad.
        qd: (n,) rad/s.
        side: (n,) direction of each joint's last motion, -1 or +1.
        arrivals: motions that have ended, in whatever way.
        rest_time: world time at which the arm last came to rest.
        rate: speed slider, 0 to 1; time along the path runs so much slower.
    """

    def __init__(self, q: Floats, side: Floats, arrivals: int, now: float) -> None:
        """Start at rest."""
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros_like(self.q)
        self.side = np.array(side, dtype=np.float64)
        self.arrivals = arrivals
        self.rest_time = now
        self.rate = 1.0
        self._now = now
        self._segment: LinearMotion | None = None
        self._time = 0.0  # along the segment
        self._stands: float | None = None  # since when it stands within the segment, at rate 0
        self._stopping = False
        self._next: tuple[Floats, float, float] | None = None
        self._told: tuple[Floats, float, float] | None = None

    @property
    def told(self) -> tuple[Floats, float, float] | None:
        """Goal, speed and acceleration of the motion that goes on and is not being stopped."""
        return None if self._segment is None or self._stopping else self._told

    @property
    def moving(self) -> bool:
        """Whether the arm moves."""
        return self._segment is not None

    @property
    def left(self) -> float:
        """World time until the motion ends at the present rate, s; infinite at rate 0."""
        if self._segment is None:
            return 0.0
        left = self._segment.duration - self._time
        rate = 1.0 if self._stopping else self.rate
        return left / rate if rate > 0.0 else float("inf")

    def start(self, goal: Floats, speed: float, acceleration: float, now: float) -> None:
        """Go to `goal` (n,), rad; an arm that moves stops first, with this acceleration."""
        self.advance(now)
        if self._segment is not None:
            self.stop(acceleration, now)
            self._next = (goal, speed, acceleration)
            return
        self._begin(goal, speed, acceleration)

    def place(self, q: Floats) -> None:
        """Stand at joint angles (n,), rad, at once: the arm was moved by hand."""
        self._segment = self._next = None
        self._stopping = False
        self.q, self.qd = np.array(q, dtype=np.float64), np.zeros_like(self.q)
        self.arrivals += 1

    def stop(self, deceleration: float, now: float) -> None:
        """Decelerate along the line, rad/s² of the leading joint, and forget what was next.

        A motion that would have ended sooner by itself ends sooner.
        """
        self.advance(now)
        self._next = None
        if self._segment is None:
            return
        way, speed = self._segment.at(self._time)
        speed *= self.rate
        if speed <= 1e-9:
            self.q = self._segment.origin + self._segment.direction * way
            self._end(now if self._stands is None else self._stands)
            return
        if not self._stopping:
            rest = max(self._segment.length - way, 1e-9)
            deceleration = max(deceleration, 0.5 * speed**2 / rest)
        elif deceleration <= -self._segment.pieces[0][2]:
            return  # a stop is never made slower
        origin = self._segment.origin + self._segment.direction * way
        pieces = ((speed / deceleration, speed, -deceleration),)
        self._segment = LinearMotion(origin, self._segment.direction, pieces)
        self._time, self._stopping = 0.0, True

    def advance(self, now: float) -> None:
        """Go on to a world time."""
        while self._segment is not None and now > self._now:
            rate = 1.0 if self._stopping else self.rate
            step = (now - self._now) * rate
            left = self._segment.duration - self._time
            if rate > 0.0:
                self._stands = None
            elif self._stands is None:
                self._stands = self._now
            if step < left:
                self._time += step
                way, speed = self._segment.at(self._time)
                self.q = self._segment.origin + self._segment.direction * way
                self.qd = self._segment.direction * speed * rate
                break
            self.q = self._segment.origin + self._segment.direction * self._segment.length
            self._now += left / rate
            self._end(self._now)
        self._now = max(self._now, now)

    def _begin(self, goal: Floats, speed: float, acceleration: float) -> None:
        self._segment = line(self.q, goal, speed, acceleration)
        self._time, self._stopping, self._stands = 0.0, False, None
        self._told = goal, speed, acceleration
        if self._segment is not None:
            moved = np.abs(goal - self.q) > _NOTHING
            self.side = np.where(moved, np.sign(goal - self.q), self.side)

    def _end(self, when: float) -> None:
        self._segment, self._stopping = None, False
        self.qd = np.zeros_like(self.q)
        self.arrivals += 1
        self.rest_time = when
        if self._next is not None:
            goal, speed, acceleration = self._next
            self._next = None
            self._begin(goal, speed, acceleration)
