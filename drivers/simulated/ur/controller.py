"""The state machine of the controller, and the dashboard that asks it and gives it orders.

Of the dashboard one line asks, one line answers. Source: Universal Robots, article "Dashboard
Server e-Series, port 29999"; the sentence of the local mode as reported in
Universal_Robots_ROS_Driver issue 125.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable
from enum import Enum

import numpy as np

from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.ur.programs import (
    PROGRAM_STOP,
    ControlScript,
    ProtectiveStop,
    ScriptStream,
    WaypointProgram,
)
from hilcal.drivers.simulated.ur.rtde import Faults
from hilcal.drivers.simulated.ur.state import ArmState, RobotMode, Runtime, SafetyMode
from hilcal.types import Floats

SAFETY_STOP = 15.0
"""Deceleration of protective and emergency stops, rad/s²."""
STOP_TIME = 0.25
"""World time in which any program's end brings the arm to rest, s."""
UNLOCK_AFTER = 5.0
"""Real time before a protective stop can be unlocked, s (the dashboard's own words)."""

PATIENCE = 0.5
"""How much later than the watchdog allows a client on this machine may be, real s. A controller has
a computer of its own; this one takes turns with its client, which would not have been late."""

_COMPILE = 0.05  # s of real time from the upload of a program to its start
_POWER_UP = 0.3  # s of real time for each step of powering up; real arms take some seconds
_READ = 1 << 16  # bytes
_MOST_OFTEN = 0.004  # s of real time between two writes to the blackboard


class OrderResult(Enum):
    """What became of an order."""

    DONE = "done"
    TOO_EARLY = "too early"
    REFUSED = "refused"


class Controller:
    """Runs one program at a time, and stops it for every reason there is.

    Attributes:
        unlock_after: real time before a protective stop can be unlocked, s.
        hears: whether the client that writes an integer register has an open link.
    """

    def __init__(self, arm: ArmState, board: Blackboard) -> None:
        """Take over the state; publishes it."""
        self.arm = arm
        self.scripts = 0
        self.unlock_after = UNLOCK_AFTER
        self.hears: Callable[[int], bool] = lambda register: False
        self._board = board
        self._program: ControlScript | WaypointProgram | None = None
        self._compiling: tuple[float, str] | None = None
        self._powering: tuple[float, RobotMode] | None = None
        self._interrupted: tuple[Floats, float, float] | None = None
        self._stopped_at = 0.0  # real time of the last protective stop
        self._published: tuple[object, ...] = ()
        self._published_at = 0.0
        self.publish()

    @property
    def program_runs(self) -> bool:
        """Whether there is a program, also a paused one."""
        return self._program is not None or self._compiling is not None

    @property
    def watchdog(self) -> float:
        """The program's watchdog, Hz; 0 is none."""
        return self._program.watchdog if self._program is not None else 0.0

    def step(self) -> None:
        """Bring everything up to now."""
        arm, real = self.arm, time.monotonic()
        motion = arm.trajectory
        motion.advance(arm.clock.now)
        late = self._program.late if self._program and arm.runtime is Runtime.PLAYING else 0.0
        waits = 0.0 < late < PATIENCE and self._client_is_there
        if late and not waits:
            self.stop_program("watchdog: no input package in time")
        motion.rate = 0.0 if waits else arm.slider * arm.scaling
        if self._powering is not None and real >= self._powering[0]:
            arm.robot_mode, self._powering = self._powering[1], None
            arm.note(f"robot mode {arm.robot_mode.name}")
        if self._compiling is not None and real >= self._compiling[0] and not motion.moving:
            self._start_program(self._compiling[1])
        if arm.runtime is Runtime.PAUSING and not motion.moving:
            arm.runtime = Runtime.PAUSED
        if self._program is not None and not waits and arm.runtime is Runtime.PLAYING:
            self._poll()
        self.publish()

    def run(self, text: str) -> None:
        """Replace the running program by another one, where that is allowed."""
        arm = self.arm
        self.scripts += 1
        if not arm.remote or not arm.able:
            why = "local mode" if not arm.remote else "the robot is not ready"
            arm.note(f"script ignored: {why}")
            return
        if text.startswith("sec"):  # a secondary program moves nothing and stops nothing
            arm.note("secondary program")
            return
        self.stop_program("replaced by a new script")
        self._compiling = time.monotonic() + _COMPILE, text

    async def take_programs(self, reader: asyncio.StreamReader) -> None:
        """Run every program that a client sends, until it goes."""
        stream = ScriptStream()
        with contextlib.suppress(OSError):
            while data := await reader.read(_READ):
                for text in stream.feed(data):
                    self.run(text)
                self.step()

    def stop_program(self, why: str) -> None:
        """End the program; the arm decelerates by itself."""
        arm = self.arm
        was = arm.runtime
        if self.program_runs or arm.trajectory.moving:
            arm.note(f"program stopped: {why}")
        self._program = self._compiling = self._interrupted = None
        arm.runtime = Runtime.STOPPED
        speed = float(np.max(np.abs(arm.trajectory.qd)))
        arm.trajectory.stop(max(PROGRAM_STOP, speed / STOP_TIME), arm.clock.now)
        if was is not arm.runtime:
            self.publish()

    def play(self) -> OrderResult:
        """Go on with a paused program, and with the motion that was cut short."""
        arm = self.arm
        if arm.runtime is not Runtime.PAUSED or self._program is None or not arm.able:
            return OrderResult.REFUSED
        arm.runtime = Runtime.PLAYING
        arm.note("program resumed")
        if self._interrupted is not None:
            arm.trajectory.start(*self._interrupted, arm.clock.now)
            self._interrupted = None
        return OrderResult.DONE

    def protective_stop(self, why: str) -> None:
        """Stop at once and pause the program, until somebody unlocks it."""
        arm = self.arm
        if arm.safety_mode is not SafetyMode.NORMAL:
            return
        arm.note(f"protective stop: {why}")
        self._stopped_at = time.monotonic()
        arm.safety_mode = SafetyMode.PROTECTIVE_STOP
        self._compiling = None
        arm.runtime = Runtime.STOPPED if self._program is None else Runtime.PAUSING
        self._interrupted = arm.trajectory.told or self._interrupted
        arm.trajectory.stop(SAFETY_STOP, arm.clock.now)
        self.step()

    def unlock(self) -> OrderResult:
        """Release a protective stop; the program stays paused."""
        arm = self.arm
        if arm.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            return OrderResult.REFUSED
        if arm.safety_mode is SafetyMode.PROTECTIVE_STOP:
            if time.monotonic() - self._stopped_at < self.unlock_after:
                return OrderResult.TOO_EARLY
            arm.safety_mode = SafetyMode.NORMAL
            arm.note("protective stop unlocked")
        return OrderResult.DONE

    def emergency_stop(self) -> None:
        """Stop at once, end the program, cut the power."""
        arm = self.arm
        arm.note("emergency stop")
        arm.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
        arm.trajectory.stop(SAFETY_STOP, arm.clock.now)
        self.stop_program("emergency stop")
        arm.robot_mode, self._powering = RobotMode.POWER_OFF, None
        self.step()

    def release_emergency_stop(self) -> None:
        """Pull the button; the power stays off."""
        if self.arm.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.arm.safety_mode = SafetyMode.NORMAL
            self.arm.note("emergency stop released")

    def power(self, mode: RobotMode) -> OrderResult:
        """Go towards a power mode: on (idle), brakes released (running), or off."""
        arm = self.arm
        if mode is RobotMode.POWER_OFF:
            self.stop_program("power off")
            arm.robot_mode, self._powering = mode, None
            return OrderResult.DONE
        if arm.safety_mode is not SafetyMode.NORMAL:
            return OrderResult.REFUSED
        if arm.robot_mode < mode:
            if arm.robot_mode is RobotMode.POWER_OFF:
                arm.robot_mode = RobotMode.POWER_ON
            self._powering = time.monotonic() + _POWER_UP, mode
        return OrderResult.DONE

    def set_remote(self, remote: bool) -> None:
        """Turn remote control on or off; turning it off ends the network's program."""
        arm = self.arm
        if remote is arm.remote:
            return
        arm.remote = remote
        arm.note("remote mode" if remote else "local mode")
        if not remote:
            self.stop_program("local mode")
        self.step()

    def publish(self) -> None:
        """Write the state to the blackboard where it has changed."""
        arm, motion = self.arm, self.arm.trajectory
        state = (motion.arrivals, motion.moving, arm.payload, *arm.payload_com.tolist())
        same = state == self._published
        if same and (not motion.moving or time.monotonic() - self._published_at < _MOST_OFTEN):
            return
        self._published, self._published_at = state, time.monotonic()
        motion.publish(self._board, arm.payload, arm.payload_com)

    def _start_program(self, text: str) -> None:
        self._compiling = None
        program: ControlScript | WaypointProgram
        try:
            program, what = ControlScript(text, self.arm), "control script"
        except ValueError:
            try:
                program, what = WaypointProgram(text, self.arm), "program of waypoints"
            except ValueError:  # another one: it stops whatever moved, does its work and ends
                self.arm.note(f"foreign program: {text[:60]!r}")
                return
        self._program = program
        self.arm.runtime = Runtime.PLAYING
        self.arm.note(f"{what} plays")

    @property
    def _client_is_there(self) -> bool:
        """Whether the program's client has an open link: then it is late for want of a turn."""
        program = self._program
        return isinstance(program, ControlScript) and self.hears(program.register)

    def _poll(self) -> None:
        assert self._program is not None  # noqa: S101 - for the type checker
        try:
            if not self._program.poll():
                self.stop_program("it ended")
        except ProtectiveStop:
            self.protective_stop("asked for by the program")
        except ValueError as error:
            self.stop_program(str(error))


GREETING = "Connected: Universal Robots Dashboard Server"
LOCAL = (
    "Command is not allowed due to safety reasons, please switch robot to Remote Control mode "
    "and reconnect to port 29999"
)
EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. "
    "Always inspect cause of protective stop before unlocking"
)
SERIAL_NUMBER = "20235500001"


class ClientServer:
    """What the servers of a controller share: their open connections."""

    def __init__(self, controller: Controller, faults: Faults, model: str) -> None:
        """Serve a controller; `model` is the arm's name in the catalogue."""
        self._controller, self._faults, self._model = controller, faults, model
        self._writers: set[asyncio.StreamWriter] = set()

    @property
    def clients(self) -> int:
        """Number of open connections."""
        return len(self._writers)

    def drop(self) -> None:
        """Cut every connection."""
        for writer in list(self._writers):
            writer.transport.abort()


class DashboardServer(ClientServer):
    """Answers the lines of every client."""

    async def run(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it goes."""
        self._writers.add(writer)
        local = not self._controller.arm.remote
        try:
            if not self._faults.dashboard_mute:
                writer.write(f"{GREETING}\n".encode())
            while line := await reader.readline():
                words = line.decode("utf-8", "replace").strip()
                if self._faults.dashboard_mute:
                    continue
                answer = self.answer(words, local)
                writer.write(f"{answer}\n".encode())
                if words.lower() == "quit":
                    break
        except (OSError, ValueError):  # gone, or a line without an end
            pass
        finally:
            self._writers.discard(writer)
            writer.close()

    def answer(self, words: str, local: bool) -> str:
        """Return the answer to a line.

        A connection that was made in `local` mode never gets more rights.
        """
        command = words.lower()
        asked = self._questions().get(command)
        if asked is not None:
            return asked
        order = self._orders().get(command)
        if order is None:
            return f"could not understand: '{words}'"
        arm = self._controller.arm
        if local or not arm.remote:
            arm.note(f"dashboard refused in local mode: {command}")
            return LOCAL
        arm.note(f"dashboard: {command}")
        return order()

    def _questions(self) -> dict[str, str]:
        arm = self._controller.arm
        plays = arm.runtime is Runtime.PLAYING
        return {
            "polyscopeversion": "URSoftware {}.{}.{}.{} (Jan 01 2023)".format(*arm.version),
            "get serial number": SERIAL_NUMBER,
            "get robot model": self._model.upper().replace("E", "e"),
            "is in remote control": str(arm.remote).lower(),
            "robotmode": f"Robotmode: {arm.robot_mode.name}",
            "safetystatus": f"Safetystatus: {arm.safety_mode.name}",
            "safetymode": f"Safetymode: {arm.safety_mode.name}",
            "running": f"Program running: {str(plays).lower()}",
            "programstate": f"{arm.program_state} <unnamed>",
            "get loaded program": "No program loaded",
            "get operational mode": "NONE",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "quit": "Disconnected",
        }

    def _orders(self) -> dict[str, Callable[[], str]]:
        controller = self._controller

        def power(mode: RobotMode, done: str, command: str) -> str:
            return _said(controller.power(mode), done, command)

        return {
            "play": lambda: _said(controller.play(), "Starting program", "play"),
            "stop": self._stop,
            "unlock protective stop": self._unlock,
            "power on": lambda: power(RobotMode.IDLE, "Powering on", "power on"),
            "brake release": lambda: power(RobotMode.RUNNING, "Brake releasing", "brake release"),
            "power off": lambda: power(RobotMode.POWER_OFF, "Powering off", "power off"),
        }

    def _stop(self) -> str:
        self._controller.stop_program("dashboard")
        return "Stopped"

    def _unlock(self) -> str:
        answer = self._controller.unlock()
        if answer is OrderResult.TOO_EARLY:
            return EARLY
        return _said(answer, "Protective stop releasing", "unlock protective stop")


def _said(answer: OrderResult, done: str, command: str) -> str:
    return done if answer is OrderResult.DONE else f"Failed to execute: {command}"
