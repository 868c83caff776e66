"""State of controller and arm: kinematics, and a trajectory of straight lines in joint space.

All times of a trajectory are world time, s, which the caller passes as `now`.
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
_NO_MOTION = 1e-9  # rad; a shorter motion is none
Goal = tuple[Floats, float, float]
"""Joint angles (n,), rad, speed and acceleration of the leading joint."""


class Kinematics:
    """Nominal kinematics and weight of the arm, as in its controller, by Pinocchio."""

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
        """Return the (6, n) Jacobian (v, omega) of a point (3,), base axes, for the joints."""
        by_angle = self._by_angle(q, point)
        return by_angle if self.arm.coupling is None else by_angle @ self.arm.coupling

    def weight_torque(self, q: Floats, mass: float, com: Floats) -> Floats:
        """Return the (n,) torques of arm and payload, at `com` (3,), at the drives, N·m."""
        gravity = pin.computeGeneralizedGravity(self._model, self._data, self.arm.chain_angles(q))
        flange = self.flange(q)
        jacobian = self._by_angle(q, flange[:3, :3] @ com + flange[:3, 3])[:3]
        return self.arm.drive_torques(mass * GRAVITY @ jacobian - gravity)

    def _by_angle(self, q: Floats, point: Floats) -> Floats:
        """(6, n) Jacobian (v, omega) of a point by the chain's angles."""
        angle, axes = self.arm.chain_angles(q), pin.LOCAL_WORLD_ALIGNED
        origin = self.flange(q)[:3, 3]
        jac = pin.computeFrameJacobian(self._model, self._data, angle, self._frame, axes)
        shift = np.cross(jac[3:], (point - origin)[:, None], axis=0)
        return np.concatenate([jac[:3] + shift, jac[3:]])


@dataclass(frozen=True, slots=True, eq=False)
class LinearMotion:
    """A motion q(s) = origin + direction * s with a piecewise linear speed of s."""

    origin: Floats  # (n,) rad
    direction: Floats  # (n,) -1 or +1 for the leading joint
    pieces: tuple[tuple[float, float, float], ...]
    """(duration in s, speed at its start in rad/s, acceleration in rad/s²) in order."""

    @property
    def duration(self) -> float:
        """Duration, s."""
        return sum(piece[0] for piece in self.pieces)

    def at(self, time: float) -> tuple[float, float]:
        """Return path (rad) and speed (rad/s) of the leading joint, `time` s after the start."""
        path = 0.0
        for duration, speed, acceleration in self.pieces:
            t = min(time, duration)
            path += speed * t + 0.5 * acceleration * t * t
            if time < duration:
                return path, speed + acceleration * t
            time -= duration
        return path, 0.0

    def point(self, path: float) -> Floats:
        """Return the joint angles (n,) at a path of the leading joint, rad."""
        return self.origin + self.direction * path

    @property
    def length(self) -> float:
        """Path of the leading joint, rad."""
        return self.at(self.duration)[0]


def line(origin: Floats, goal: Floats, speed: float, acceleration: float) -> LinearMotion | None:
    """Return the motion from rest to rest; None if the goal is reached already.

    v = min(speed, sqrt(a d)), ramps of v / a, and d / v - v / a in between.
    """
    shift = goal - origin
    length = float(np.max(np.abs(shift)))
    if length < _NO_MOTION:
        return None
    acceleration = max(acceleration, 1e-6)
    top = min(max(speed, 1e-6), float(np.sqrt(acceleration * length)))
    ramp = top / acceleration
    cruise = max(0.0, length / top - ramp)
    pieces = ((ramp, 0.0, acceleration), (cruise, top, 0.0), (ramp, top, -acceleration))
    return LinearMotion(origin, shift / length, pieces)


class Trajectory:
    """The commanded joint angles; `side` (n,), -1 or +1: direction of each joint's last motion.

    `arrivals`: number of motions ended in any way; `rate`, 0 to 1: factor on the speed.
    """

    def __init__(self, q: Floats, side: Floats, arrivals: int, now: float) -> None:
        self.q = np.array(q, dtype=np.float64)
        self.qd = np.zeros_like(self.q)
        self.side = np.array(side, dtype=np.float64)
        self.arrivals, self.rest_time, self.rate = arrivals, now, 1.0
        self._now = now
        self._segment: LinearMotion | None = None
        self._time = 0.0  # along the segment
        self._rest_start: float | None = None  # start of a rest within the segment, at rate 0
        self._stopping = False
        self._next: Goal | None = None
        self._goal: Goal | None = None

    @property
    def goal(self) -> Goal | None:
        """The goal of the present motion, None if it is being stopped."""
        return None if self._segment is None or self._stopping else self._goal

    @property
    def moving(self) -> bool:
        """Whether the arm moves."""
        return self._segment is not None

    @property
    def remaining(self) -> float:
        """World time to the end of the motion at the present rate, s; infinite at rate 0."""
        if self._segment is None:
            return 0.0
        time, rate = self._segment.duration - self._time, 1.0 if self._stopping else self.rate
        return time / rate if rate > 0.0 else float("inf")

    def start(self, goal: Floats, speed: float, acceleration: float, now: float) -> None:
        """Move to `goal` (n,), rad; a moving arm stops first, with this acceleration."""
        self.advance(now)
        if self._segment is not None:
            self.stop(acceleration, now)
            self._next = goal, speed, acceleration
        else:
            self._begin(goal, speed, acceleration)

    def place(self, q: Floats) -> None:
        """Place the arm at joint angles (n,), rad, at once, as if moved by hand."""
        self._segment, self._next, self._stopping = None, None, False
        self.q, self.qd = np.array(q, dtype=np.float64), np.zeros_like(self.q)
        self.arrivals += 1

    def stop(self, deceleration: float, now: float) -> None:
        """Decelerate along the line, rad/s² of the leading joint, and drop the next goal."""
        self.advance(now)
        self._next = None
        if self._segment is None:
            return
        path, speed = self._segment.at(self._time)
        speed *= self.rate
        if speed <= 1e-9:
            self.q = self._segment.point(path)
            self._end(now if self._rest_start is None else self._rest_start)
            return
        if not self._stopping:
            distance = max(self._segment.length - path, 1e-9)
            deceleration = max(deceleration, 0.5 * speed**2 / distance)
        elif deceleration <= -self._segment.pieces[0][2]:
            return  # a stop is never slowed down
        pieces = ((speed / deceleration, speed, -deceleration),)
        self._segment = LinearMotion(self._segment.point(path), self._segment.direction, pieces)
        self._time, self._stopping = 0.0, True

    def advance(self, now: float) -> None:
        """Advance to a world time."""
        while self._segment is not None and now > self._now:
            rate = 1.0 if self._stopping else self.rate
            step, remaining = (now - self._now) * rate, self._segment.duration - self._time
            if rate > 0.0:
                self._rest_start = None
            elif self._rest_start is None:
                self._rest_start = self._now
            if step < remaining:
                self._time += step
                path, speed = self._segment.at(self._time)
                self.q, self.qd = self._segment.point(path), self._segment.direction * speed * rate
                break
            self.q = self._segment.point(self._segment.length)
            self._now += remaining / rate
            self._end(self._now)
        self._now = max(self._now, now)

    def publish(self, board: Blackboard, payload: float, com: Floats) -> None:
        """Write the state of the arm, and the payload (kg, m) as set."""
        state = {"q": self.q, "qd": self.qd, "side": self.side, "arrivals": self.arrivals}
        load = {"payload": payload, "payload_com": com}
        board.write("arm", alive=1.0, moving=float(self.moving), **state, **load)

    def _begin(self, goal: Floats, speed: float, acceleration: float) -> None:
        self._segment = line(self.q, goal, speed, acceleration)
        self._time, self._stopping, self._rest_start = 0.0, False, None
        self._goal = goal, speed, acceleration
        if self._segment is not None:
            moves = np.abs(goal - self.q) > _NO_MOTION
            self.side = np.where(moves, np.sign(goal - self.q), self.side)

    def _end(self, time: float) -> None:
        self._segment, self._stopping = None, False
        self.qd = np.zeros_like(self.q)
        self.arrivals += 1
        self.rest_time = time
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
    """RTDE `safety_mode` and `safety_status`, with the names of the dashboard."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


_BITS = {
    SafetyMode.NORMAL: 1 << 0,
    SafetyMode.REDUCED: 1 << 1,
    SafetyMode.PROTECTIVE_STOP: 1 << 2 | 1 << 10,  # of the cause, and "stopped due to safety"
    SafetyMode.SAFEGUARD_STOP: 1 << 4 | 1 << 10,
    SafetyMode.ROBOT_EMERGENCY_STOP: 1 << 6 | 1 << 7 | 1 << 10,
}
"""RTDE `safety_status_bits`."""


class WorldClock:
    """World time since power-on of this controller, and its conversion to real time."""

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
        """Return the real seconds of a number of world seconds."""
        return seconds / self._scale


@dataclass(slots=True, eq=False)
class ArmState:
    """State of controller and arm."""

    clock: WorldClock
    kinematics: Kinematics
    trajectory: Trajectory
    version: tuple[int, int, int, int]
    in_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    """General-purpose registers; `in_` are written by RTDE clients, `out_` by scripts."""
    in_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    out_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    out_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    written_ns: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    """Time of the last write to each of `in_int`, `time.monotonic_ns`."""
    payload: float = 0.0  # as set, kg
    payload_com: Floats = field(default_factory=lambda: np.zeros(3))  # (3,) flange axes, m
    tcp: Floats = field(default_factory=lambda: np.zeros(6))  # (6,) on the flange, m and rad
    robot_mode: RobotMode = RobotMode.RUNNING
    runtime: Runtime = Runtime.STOPPED
    safety_mode: SafetyMode = SafetyMode.NORMAL
    remote: bool = True  # whether it accepts orders from the network
    scaling: float = 1.0  # factor on the speed that the controller applies by itself
    slider: float = 1.0
    digital_outputs: int = 0  # RTDE `actual_digital_output_bits`
    rtde_mute: bool = False  # whether RTDE gives no answers
    rtde_stall: bool = False  # whether RTDE sends no data
    dashboard_mute: bool = False  # whether dashboard server or Robot API gives no answers
    refuses_motion: bool = False  # whether a commanded motion ends the program
    frozen_q: Floats | None = None  # (n,) reported in place of the true angles, rad
    fault_ns: int = 0  # time of the last fault switched on, `time.monotonic_ns`
    input_ns: int = 0  # time of the last input package, `time.monotonic_ns`
    log: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=2000))
    """(`time.monotonic_ns`, event)."""

    @property
    def safety_bits(self) -> int:
        """RTDE `safety_status_bits`."""
        return _BITS[self.safety_mode]

    @property
    def program_state(self) -> str:
        """State of the program as named by dashboard and Robot API."""
        names = {Runtime.PLAYING: "PLAYING", Runtime.PAUSED: "PAUSED", Runtime.PAUSING: "PAUSED"}
        return names.get(self.runtime, "STOPPED")

    @property
    def can_run(self) -> bool:
        """Whether power and safety allow a program to run."""
        moves = self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
        return self.robot_mode is RobotMode.RUNNING and moves

    def note(self, event: str) -> None:
        """Log an event."""
        self.log.append((time.monotonic_ns(), event))
