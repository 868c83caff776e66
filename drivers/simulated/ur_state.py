"""State of controller and arm: its kinematics, and the trajectory, lines in joint space.

All times of a trajectory are world time in s; the caller says what time it is.
"""

import time
from collections import deque
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
import pinocchio as pin

from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.robot.arm import Arm
from hilcal.robot.scene import FLANGE, pinocchio_model
from hilcal.types import Floats

REGISTERS = 48  # of each kind and direction
GRAVITY = np.array([0.0, 0.0, -9.80665])
_NOTHING = 1e-9  # rad: no motion
Goal = tuple[Floats, float, float]
"""Joint angles (n,), rad, speed and acceleration of the leading joint."""


class Kinematics:
    """Nominal kinematics and weight of the arm, as its controller knows them, by Pinocchio."""

    def __init__(self, arm: Arm) -> None:
        self.arm = arm
        self._model = pinocchio_model(arm)
        self._model.gravity.linear = GRAVITY
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(FLANGE)

    def flange(self, q: Floats) -> Floats:
        """Return T_base_flange (4, 4)."""
        pin.framesForwardKinematics(self._model, self._data, self.arm.chain_angles(q))
        return np.array(self._data.oMf[self._frame].homogeneous)

    def jacobian(self, q: Floats, point: Floats) -> Floats:
        """Return (6, n): velocity of a point (3,), base axes, and turn, per joint speed."""
        by_angle = self._by_angle(q, point)
        return by_angle if self.arm.coupling is None else by_angle @ self.arm.coupling

    def weight_torque(self, q: Floats, mass: float, com: Floats) -> Floats:
        """Return the (n,) torque that arm and payload at `com` (3,) exert at its drives, N·m."""
        held = pin.computeGeneralizedGravity(self._model, self._data, self.arm.chain_angles(q))
        place = self.flange(q)
        lifted = self._by_angle(q, place[:3, :3] @ com + place[:3, 3])[:3]
        return self.arm.drive_torques(mass * GRAVITY @ lifted - held)

    def _by_angle(self, q: Floats, point: Floats) -> Floats:
        """(6, n) velocity of a point and turn per speed of the chain's angles."""
        angle, axes = self.arm.chain_angles(q), pin.LOCAL_WORLD_ALIGNED
        origin = self.flange(q)[:3, 3]
        at = pin.computeFrameJacobian(self._model, self._data, angle, self._frame, axes)
        return np.concatenate(
            [at[:3] + np.cross(at[3:], (point - origin)[:, None], axis=0), at[3:]]
        )


@dataclass(frozen=True, slots=True, eq=False)
class LinearMotion:
    """A motion q(s) = origin + direction * s with a piecewise linear speed of s."""

    origin: Floats  # (n,) rad
    direction: Floats  # (n,) the leading joint's element is -1 or +1
    pieces: tuple[tuple[float, float, float], ...]
    """(duration in s, speed at its start in rad/s, acceleration in rad/s²) in order."""

    @property
    def duration(self) -> float:
        """How long it takes, s."""
        return sum(piece[0] for piece in self.pieces)

    def at(self, time: float) -> tuple[float, float]:
        """Return way and speed of the leading joint at a time since the start."""
        way = 0.0
        for duration, speed, acceleration in self.pieces:
            t = min(time, duration)
            way += speed * t + 0.5 * acceleration * t * t
            if time < duration:
                return way, speed + acceleration * t
            time -= duration
        return way, 0.0

    def point(self, way: float) -> Floats:
        """Return the joint angles (n,) there, rad."""
        return self.origin + self.direction * way

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
    """Where the commanded arm is, and from which `side` (n,), -1 or +1, each joint came there.

    `arrivals` are motions that have ended, in whatever way; at `rate`, 0 to 1, the arm goes slower.
    """

    def __init__(self, q: Floats, side: Floats, arrivals: int, now: float) -> None:
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros_like(self.q)
        self.side = np.array(side, dtype=np.float64)
        self.arrivals, self.rest_time, self.rate = arrivals, now, 1.0
        self._now = now
        self._segment: LinearMotion | None = None
        self._time = 0.0  # along the segment
        self._stands: float | None = None  # since when it stands within the segment, at rate 0
        self._stopping = False
        self._next: Goal | None = None
        self._goal: Goal | None = None

    @property
    def goal(self) -> Goal | None:
        """That of the motion that goes on and is not being stopped."""
        return None if self._segment is None or self._stopping else self._goal

    @property
    def moving(self) -> bool:
        """Whether the arm moves."""
        return self._segment is not None

    @property
    def left(self) -> float:
        """World time until the motion ends at the present rate, s; infinite at rate 0."""
        if self._segment is None:
            return 0.0
        left, rate = self._segment.duration - self._time, 1.0 if self._stopping else self.rate
        return left / rate if rate > 0.0 else float("inf")

    def start(self, goal: Floats, speed: float, acceleration: float, now: float) -> None:
        """Go to `goal` (n,), rad; an arm that moves stops first, with this acceleration."""
        self.advance(now)
        if self._segment is not None:
            self.stop(acceleration, now)
            self._next = goal, speed, acceleration
        else:
            self._begin(goal, speed, acceleration)

    def place(self, q: Floats) -> None:
        """Stand at joint angles (n,), rad, at once: the arm was moved by hand."""
        self._segment, self._next, self._stopping = None, None, False
        self.q, self.qd = np.array(q, dtype=np.float64), np.zeros_like(self.q)
        self.arrivals += 1

    def stop(self, deceleration: float, now: float) -> None:
        """Decelerate along the line, rad/s² of the leading joint; forget what was next."""
        self.advance(now)
        self._next = None
        if self._segment is None:
            return
        way, speed = self._segment.at(self._time)
        speed *= self.rate
        if speed <= 1e-9:
            self.q = self._segment.point(way)
            self._end(now if self._stands is None else self._stands)
            return
        if not self._stopping:
            rest = max(self._segment.length - way, 1e-9)
            deceleration = max(deceleration, 0.5 * speed**2 / rest)
        elif deceleration <= -self._segment.pieces[0][2]:
            return  # a stop is never made slower
        pieces = ((speed / deceleration, speed, -deceleration),)
        self._segment = LinearMotion(self._segment.point(way), self._segment.direction, pieces)
        self._time, self._stopping = 0.0, True

    def advance(self, now: float) -> None:
        """Go on to a world time."""
        while self._segment is not None and now > self._now:
            rate = 1.0 if self._stopping else self.rate
            step, left = (now - self._now) * rate, self._segment.duration - self._time
            if rate > 0.0:
                self._stands = None
            elif self._stands is None:
                self._stands = self._now
            if step < left:
                self._time += step
                way, speed = self._segment.at(self._time)
                self.q, self.qd = self._segment.point(way), self._segment.direction * speed * rate
                break
            self.q = self._segment.point(self._segment.length)
            self._now += left / rate
            self._end(self._now)
        self._now = max(self._now, now)

    def publish(self, board: Blackboard, payload: float, com: Floats) -> None:
        """Write what the arm does, and the payload (kg, m) that its controller was told."""
        state = {"q": self.q, "qd": self.qd, "side": self.side, "arrivals": self.arrivals}
        carried = {"payload": payload, "payload_com": com}
        board.write("arm", alive=1.0, moving=float(self.moving), **state, **carried)

    def _begin(self, goal: Floats, speed: float, acceleration: float) -> None:
        self._segment = line(self.q, goal, speed, acceleration)
        self._time, self._stopping, self._stands = 0.0, False, None
        self._goal = goal, speed, acceleration
        if self._segment is not None:
            moved = np.abs(goal - self.q) > _NOTHING
            self.side = np.where(moved, np.sign(goal - self.q), self.side)

    def _end(self, when: float) -> None:
        self._segment, self._stopping = None, False
        self.qd = np.zeros_like(self.q)
        self.arrivals += 1
        self.rest_time = when
        following, self._next = self._next, None
        if following is not None:
            self._begin(*following)


class RobotMode(IntEnum):
    """RTDE `robot_mode`."""

    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    RUNNING = 7


class Runtime(IntEnum):
    """RTDE `runtime_state`."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class SafetyMode(IntEnum):
    """RTDE `safety_mode` and `safety_status`, and the dashboard's words for them."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7


_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,  # of the cause, and "stopped due to safety"
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
"""RTDE `safety_status_bits`."""


class WorldClock:
    """World time since this controller was switched on, and back to real time."""

    def __init__(self, board: Blackboard) -> None:
        self._start_ns, self._scale = time.monotonic_ns(), board.scale

    @property
    def now(self) -> float:
        """World time, s."""
        return (time.monotonic_ns() - self._start_ns) * 1e-9 * self._scale

    def real_ns(self, now: float) -> int:
        """Return `time.monotonic_ns` at a world time."""
        return self._start_ns + round(self.real(now) * 1e9)

    def real(self, seconds: float) -> float:
        """Return how many real seconds so many world seconds take."""
        return seconds / self._scale


@dataclass(slots=True)
class Registers:
    """General-purpose registers; `in_` are written by RTDE clients, `out_` by scripts."""

    in_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    in_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    out_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    out_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    written_ns: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    """When each of `in_int` last came, `time.monotonic_ns`."""


@dataclass(slots=True, eq=False)
class ArmState:
    """State of controller and arm."""

    clock: WorldClock
    kinematics: Kinematics
    trajectory: Trajectory
    version: tuple[int, int, int, int]
    registers: Registers = field(default_factory=Registers)
    payload: float = 0.0  # what the controller has been told, kg
    payload_com: Floats = field(default_factory=lambda: np.zeros(3))  # (3,) flange axes, m
    tcp: Floats = field(default_factory=lambda: np.zeros(6))  # (6,) on the flange, m and rad
    robot_mode: RobotMode = RobotMode.RUNNING
    runtime: Runtime = Runtime.STOPPED
    safety_mode: SafetyMode = SafetyMode.NORMAL
    remote: bool = True  # whether it takes orders from the network
    scaling: float = 1.0  # further factor on the speed, as the controller applies it by itself
    slider: float = 1.0
    digital_outputs: int = 0  # RTDE `actual_digital_output_bits`
    rtde_mute: bool = False  # whether RTDE answers nothing
    rtde_stall: bool = False  # whether it sends no data
    dashboard_mute: bool = False  # whether dashboard server or Robot API answer nothing
    refuses_motion: bool = False  # whether a motion that is commanded ends the program instead
    frozen_q: Floats | None = None  # (n,) told in spite of any motion, rad; None is the truth
    fault_ns: int = 0  # `time.monotonic_ns` of the last fault that was switched on
    input_ns: int = 0  # the same of the last input package
    log: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=2000))
    """(monotonic_ns, what happened)."""

    @property
    def safety_bits(self) -> int:
        """RTDE `safety_status_bits`."""
        return _BITS[self.safety_mode]

    @property
    def program_state(self) -> str:
        """State of the program in the words of dashboard and Robot API."""
        known = {Runtime.PLAYING: "PLAYING", Runtime.PAUSED: "PAUSED", Runtime.PAUSING: "PAUSED"}
        return known.get(self.runtime, "STOPPED")

    @property
    def able(self) -> bool:
        """Whether power and safety allow a program to run."""
        return self.robot_mode is RobotMode.RUNNING and self.safety_mode is SafetyMode.NORMAL

    def note(self, what: str) -> None:
        """Remember what happened."""
        self.log.append((time.monotonic_ns(), what))
