"""Programs of the script port: ur_rtde's control script, and programs of waypoints.

The control script takes commands through registers. The client writes a command and its arguments
into input registers and waits for 2 (done) in an output register; then it clears the command and
waits for 1 (ready). Register numbers and commands: ur_rtde 1.6.5 (MIT), the script
that it uploads.

A program of waypoints moves to joint values, and waits:

    def name():
      movej([q1, ..., q6], a=1.4, v=1.05, t=0, r=0)
      movel([q1, ..., q6], a=1.2, v=0.25)
      sleep(0.5)
    end

`movel` and `movep` move in joint space, at a joint speed of v over 1 m: their goals are right,
their paths are not. Blends (r) are ignored: every waypoint is reached. Source: Universal Robots,
*The URScript Programming Language*.
"""

import re
import time
from collections.abc import Iterator, Sequence
from enum import IntEnum

import numpy as np

from hilcal.drivers.simulated.ur_state import ArmState, Goal
from hilcal.robot.se3 import of_six, six
from hilcal.types import Floats

PROGRAM_STOP = 4.0  # deceleration at the end of a program during a motion, rad/s²

_READY, _DONE = 1, 2
_STEADY = 0.5  # world time at rest after which the robot is steady, s
_JOINT_LIMIT = 2.0 * np.pi + 1e-6  # rad
_STEP = 0.002  # s, the controller's cycle


class ScriptCommand(IntEnum):
    """The emulated commands."""

    MOVE_J = 1
    MOVE_L_FK = 4
    SET_PAYLOAD = 17
    GET_STEPTIME = 26
    SET_TCP = 29
    PROTECTIVE_STOP = 31
    STOP_L = 33
    STOP_J = 34
    WATCHDOG = 35
    JOINTS_SAFE = 37
    JOINT_TORQUES = 38
    TCP_OFFSET = 40
    FK = 43
    FK_OF = 44
    MOVE_PATH = 45
    IS_STEADY = 47
    SET_TARGET_PAYLOAD = 65
    STOP_SCRIPT = 255


# Commands processed in every cycle, without the handshake.
REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})

_OFFSET = re.compile(r"global reg_offset_int =[^\n]*?\n?\s*(\d+)")
_PATH = re.compile(r"def exec_move_path\(\):(.*?)\n\s*end", re.DOTALL)
_MOVE = re.compile(r"movej\(\[([^\]]*)\],\s*a=([^,]*),\s*v=([^,]*),")


class ProtectiveStop(Exception):  # noqa: N818 - a request, not an error
    """The program requests a protective stop."""


class ControlScript:
    """The uploaded control script while it plays."""

    def __init__(self, text: str, arm: ArmState) -> None:
        match = _OFFSET.search(text)
        if match is None:
            raise ValueError("not a control script")
        self._arm = arm
        self.register = int(match.group(1))  # the integer register of commands
        self._path = tuple(_moves(text))
        self._executing = False
        self._work: Iterator[None] | None = None
        self._async = False
        self._async_count = self._async_number = 0
        self.watchdog = 0.0  # least rate of input packages, Hz; 0: no watchdog
        self._signal(_READY)
        self._progress(None)

    @property
    def late(self) -> float:
        """Delay of the command register beyond the watchdog's limit, s; 0 if in time."""
        if not self.watchdog:
            return 0.0
        silence = (time.monotonic_ns() - self._arm.written_ns[self.register]) * 1e-9
        return max(0.0, silence - 1.0 / self.watchdog)

    def poll(self) -> bool:
        """Execute a cycle; return whether the program goes on."""
        if self._async and not self._arm.trajectory.moving:
            self._async = False
            self._progress(None)
        if self._work is not None:
            if next(self._work, self) is not self:
                return True
            self._work = None
            self._signal(_DONE)
        number = self._arm.in_int[self.register]
        if number == 0:
            self._executing = False
            self._signal(_READY)
        elif number in REALTIME:
            self._realtime(number)
            self._signal(_READY)
        elif not self._executing:
            if number == ScriptCommand.STOP_SCRIPT:
                self._signal(0)
                return False
            self._executing = True
            self._work = self._run(number)
            return self.poll()
        return True

    def _run(self, number: int) -> Iterator[None]:
        """Carry out a command; yields until it is done."""
        arm, motion, now = self._arm, self._arm.trajectory, self._arm.clock.now
        match number:
            case ScriptCommand.MOVE_J | ScriptCommand.MOVE_L_FK | ScriptCommand.MOVE_PATH:
                values = self._doubles(0, 8)
                goals = [(values[:6], float(values[6]), float(values[7]))]
                if number == ScriptCommand.MOVE_PATH:
                    goals = list(self._path)
                for goal, speed, acceleration in goals:
                    _begin(arm, goal, speed, acceleration)
                    if self._int(1) and number != ScriptCommand.MOVE_PATH:
                        self._async = True
                        self._progress(0)
                        return
                    while motion.moving:
                        yield
            case ScriptCommand.STOP_J | ScriptCommand.STOP_L:
                rate = float(self._doubles(0, 1)[0])
                # stopL's deceleration is of the tool, m/s²; the default of the joints is used
                motion.stop(
                    max(rate, 0.05) if number == ScriptCommand.STOP_J else PROGRAM_STOP, now
                )
                arm.note(f"stop command, {rate:g}")
                while motion.moving and not self._int(1):
                    yield
            case ScriptCommand.SET_PAYLOAD | ScriptCommand.SET_TARGET_PAYLOAD:
                values = self._doubles(0, 4)
                arm.payload = float(values[0])
                if number == ScriptCommand.SET_TARGET_PAYLOAD or np.any(values[1:]):
                    arm.payload_com = values[1:]
                arm.note(f"payload {arm.payload:g} kg at {arm.payload_com.tolist()}")
            case ScriptCommand.SET_TCP:
                arm.tcp = self._doubles(0, 6)
            case ScriptCommand.TCP_OFFSET:
                self._answer(arm.tcp)
            case ScriptCommand.FK:
                self._answer(six(arm.kinematics.flange(motion.q) @ of_six(arm.tcp.tolist())))
            case ScriptCommand.FK_OF:
                flange = arm.kinematics.flange(self._doubles(0, 6))
                self._answer(six(flange @ of_six(self._doubles(6, 6).tolist())))
            case ScriptCommand.IS_STEADY:
                steady = not motion.moving and now - motion.rest_time > _STEADY
                arm.out_int[self.register + 1] = int(steady)
            case ScriptCommand.JOINTS_SAFE:
                safe = np.all(np.abs(self._doubles(0, 6)) <= _JOINT_LIMIT)
                arm.out_int[self.register + 1] = int(safe)
            case ScriptCommand.WATCHDOG:
                self.watchdog = float(self._doubles(0, 1)[0])
                arm.note(f"watchdog {self.watchdog:g} Hz")
            case ScriptCommand.PROTECTIVE_STOP:
                raise ProtectiveStop
            case _:
                raise ValueError(f"command {number} is not emulated")

    def _realtime(self, number: int) -> None:
        arm = self._arm
        if number == ScriptCommand.JOINT_TORQUES:
            q = arm.trajectory.q
            self._answer(arm.kinematics.weight_torque(q, arm.payload, arm.payload_com))
        elif number == ScriptCommand.GET_STEPTIME:
            self._answer([_STEP])
        else:
            raise ValueError(f"command {number} is not emulated")

    def _progress(self, value: int | None) -> None:
        """Set the state of an asynchronous operation; None: finished, 0: started.

        Bits 0-14 progress, 15 running, 16-22 count of writes, 24-30 number of the operation.
        """
        self._async_count = (self._async_count + 1) % 128
        if value == 0:
            self._async_number = (self._async_number + 1) % 128
        word = self._async_count << 16 | self._async_number << 24
        if value is not None:
            word |= 1 << 15 | value
        self._arm.out_int[self.register + 2] = word

    def _signal(self, value: int) -> None:
        self._arm.out_int[self.register] = value

    def _answer(self, values: Sequence[float] | Floats) -> None:
        part = slice(self.register, self.register + len(values))
        self._arm.out_double[part] = [float(value) for value in values]

    def _int(self, k: int) -> int:
        return self._arm.in_int[self.register + k]

    def _doubles(self, k: int, count: int) -> Floats:
        start = self.register + k
        return np.array(self._arm.in_double[start : start + count])


def _moves(text: str) -> Iterator[Goal]:
    """Yield the joint moves of an uploaded path as (goal, speed, acceleration)."""
    body = _PATH.search(text)
    for q, acceleration, speed in _MOVE.findall(body.group(1)) if body else ():
        yield np.array([float(x) for x in q.split(",")]), float(speed), float(acceleration)


class ScriptStream:
    """Splits the data of the script port into programs."""

    def __init__(self) -> None:
        self._lines: list[str] = []
        self._partial = ""

    def feed(self, data: bytes) -> Iterator[str]:
        """Yield every complete program: `def ...` to a bare `end`, or a line."""
        text = self._partial + data.decode("utf-8", "replace")
        *lines, self._partial = text.split("\n")
        for line in lines:
            if self._lines:
                self._lines.append(line)
                if line.rstrip() == "end":
                    yield "\n".join(self._lines)
                    self._lines = []
            elif re.match(r"(def|sec)\s", line):
                self._lines = [line]
            elif line.strip():
                yield line.strip()


SPEEDS = {"movej": (1.4, 1.05), "movel": (1.2, 0.25), "movep": (1.2, 0.25)}
"""Default acceleration and speed of the language."""
_LEVER = 1.0
"""Lever arm that converts tool speeds to joint speeds, m; a choice."""
_WAYPOINT = re.compile(r"(movej|movel|movep)\(\s*\[([^\]]*)\]\s*((?:,[^)]*)?)\)")
_SLEEP = re.compile(r"sleep\(\s*([0-9.eE+-]+)\s*\)")
_IGNORED = re.compile(
    r"(textmsg|set_tcp|set_payload|popup)\(.*\)|(?:global\s+)?\w+\s*=.*|end|def\s+\w+\(\s*\)\s*:|"
)


class WaypointProgram:
    """A program of waypoints while it plays."""

    watchdog = late = 0.0

    def __init__(self, text: str, arm: ArmState) -> None:
        """Read the program; raises ValueError for unknown statements, or without moves."""
        self._arm, self._steps = arm, list(_steps(text))
        if all(isinstance(step, float) for step in self._steps):
            raise ValueError("no waypoints")
        self._work = self._run()

    def poll(self) -> bool:
        """Execute a cycle; return whether the program goes on."""
        return next(self._work, False)

    def _run(self) -> Iterator[bool]:
        arm = self._arm
        for step in self._steps:
            if isinstance(step, float):
                end = arm.clock.now + step
                while arm.clock.now < end:
                    yield True
                continue
            _begin(arm, *step)
            while arm.trajectory.moving:
                yield True


def _begin(arm: ArmState, goal: Floats, speed: float, acceleration: float) -> None:
    """Start a motion of a program; raises ValueError, which ends the program, if refused."""
    if arm.refuses_motion:
        raise ValueError("the motion is refused")
    if not (0.0 < speed < np.inf and 0.0 < acceleration < np.inf):
        raise ValueError(f"move with speed {speed}, acceleration {acceleration}")
    if not np.all(np.abs(goal) <= _JOINT_LIMIT):
        arm.note(f"goal beyond the joint limits: {goal.tolist()}")
        raise ProtectiveStop
    arm.trajectory.start(goal, speed, acceleration, arm.clock.now)
    arm.note(f"move to {np.round(goal, 6).tolist()}")


def _steps(text: str) -> Iterator[Goal | float]:
    """Yield the moves, and the waits, s."""
    for line in text.splitlines():
        statement = line.split("#")[0].strip()
        move, sleep = _WAYPOINT.fullmatch(statement), _SLEEP.fullmatch(statement)
        if move:
            yield _move(move[1], move[2], move[3])
        elif sleep:
            yield float(sleep[1])
        elif not _IGNORED.fullmatch(statement):
            raise ValueError(f"not emulated: {statement}")


def _move(function: str, numbers: str, options: str) -> Goal:
    goal = np.array([float(x) for x in numbers.split(",")])
    if goal.shape != (6,) or not np.all(np.abs(goal) <= _JOINT_LIMIT):
        raise ValueError(f"no joint values: {numbers}")
    arguments = dict(re.findall(r"([avtr])\s*=\s*([0-9.eE+-]+)", options))
    lever = 1.0 if function == "movej" else _LEVER
    acceleration, speed = (
        float(arguments.get(key, default)) / lever
        for key, default in zip("av", SPEEDS[function], strict=True)
    )
    if not (0.0 < speed < np.inf and 0.0 < acceleration < np.inf):
        raise ValueError(f"move with speed {speed}, acceleration {acceleration}")
    return goal, speed, acceleration
