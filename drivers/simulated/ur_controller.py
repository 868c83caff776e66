"""The state machine of a controller, and its servers: dashboard, Robot API, primary port.

The dashboard answers each line with a line. Source: Universal Robots, article "Dashboard Server
e-Series, port 29999"; the answer in local mode as reported in Universal_Robots_ROS_Driver issue
125.

The Robot API of PolyScope X offers the same over HTTP. Paths, bodies and their versions: Universal
Robots, "Robot API" (openapi.json of the controller), and `DashboardClientImplX` of the Universal
Robots Client Library. In local mode every order is refused with status 403.

A package of the primary port has a size (i32), a type (u8) and a body; the body of a robot state is
a sequence of parts, each with size (i32), type (u8) and body. All is big-endian. Part 5, the
kinematics, comes with the first state after a client has connected. Source: Universal Robots,
"Remote Control via TCP/IP", and the parsers of the Universal Robots Client Library.
"""

import asyncio
import contextlib
import http.client
import json
import struct
import time
from collections.abc import Callable
from enum import Enum
from functools import partial
from typing import Any

import numpy as np

from hilcal.drivers.simulated import ur_programs as programs
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.ur_state import ArmState, Goal, RobotMode, Runtime, SafetyMode
from hilcal.types import Floats

SAFETY_STOP = 15.0  # deceleration of protective and emergency stops, rad/s²
STOP_TIME = 0.25  # world time within which the arm stops at the end of a program, s
UNLOCK_AFTER = 5.0
"""Real time before a protective stop can be unlocked, s (from the dashboard's answer)."""
PATIENCE = 0.5
"""Additional delay of a connected client that the watchdog tolerates, real s: this controller,
unlike a real one, shares its computer with the client."""
_COMPILE = 0.05  # s of real time from the upload of a program to its start
_POWER_UP = 0.3  # s of real time per step of powering up; real arms take some seconds
_READ = 1 << 16  # bytes
_LEAST_INTERVAL = 0.004  # s of real time between writes to the blackboard


class OrderResult(Enum):
    """Result of an order."""

    DONE = "done"
    TOO_EARLY = "too early"
    REFUSED = "refused"


_PROGRAMS: dict[str, type[programs.ControlScript | programs.WaypointProgram]] = {
    "control script": programs.ControlScript,
    "program of waypoints": programs.WaypointProgram,
}


class Controller:
    """Runs one program at a time, and stops it for any of the controller's reasons."""

    def __init__(self, arm: ArmState, board: Blackboard) -> None:
        self.arm, self._board = arm, board
        self.scripts, self.unlock_after = 0, UNLOCK_AFTER
        self.has_client: Callable[[int], bool] = lambda register: False
        """Whether a client that writes an integer register is connected."""
        self._program: programs.ControlScript | programs.WaypointProgram | None = None
        self._compiling: tuple[float, str] | None = None
        self._powering: tuple[float, RobotMode] | None = None
        self._interrupted: Goal | None = None
        self._stopped_at = 0.0  # real time of the last protective stop
        self._published: tuple[object, ...] = ()
        self._published_at = 0.0
        self.publish()

    @property
    def program_runs(self) -> bool:
        """Whether there is a program, running or paused."""
        return self._program is not None or self._compiling is not None

    @property
    def watchdog(self) -> float:
        """The program's watchdog, Hz; 0: none."""
        return self._program.watchdog if self._program is not None else 0.0

    def step(self) -> None:
        """Advance to the present time."""
        arm, real, motion = self.arm, time.monotonic(), self.arm.trajectory
        motion.advance(arm.clock.now)
        program, waits = self._program, False
        if program is not None and program.late and arm.runtime is Runtime.PLAYING:
            # a connected client is late because the computer is busy
            connected = isinstance(program, programs.ControlScript) and self.has_client(
                program.register
            )
            waits = program.late < PATIENCE and connected
            if not waits:
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
            try:
                if not self._program.poll():
                    self.stop_program("it ended")
            except programs.ProtectiveStop:
                self.protective_stop("asked for by the program")
            except ValueError as error:
                self.stop_program(str(error))
        self.publish()

    def run(self, text: str) -> None:
        """Replace the running program, if allowed."""
        self.scripts += 1
        if not self.arm.remote or not self.arm.can_run:
            why = "the robot is not ready" if self.arm.remote else "local mode"
            self.arm.note(f"script ignored: {why}")
        elif text.startswith("sec"):  # a secondary program moves nothing and stops nothing
            self.arm.note("secondary program")
        else:
            self.stop_program("replaced by a new script")
            self._compiling = time.monotonic() + _COMPILE, text

    async def take_programs(self, reader: asyncio.StreamReader) -> None:
        """Run every program that a client sends, until it disconnects."""
        stream = programs.ScriptStream()
        with contextlib.suppress(OSError):
            while data := await reader.read(_READ):
                for text in stream.feed(data):
                    self.run(text)
                self.step()

    def stop_program(self, why: str) -> None:
        """End the program; the arm decelerates by itself."""
        arm, motion, runtime = self.arm, self.arm.trajectory, self.arm.runtime
        if self.program_runs or motion.moving:
            arm.note(f"program stopped: {why}")
        self._program = self._compiling = self._interrupted = None
        arm.runtime = Runtime.STOPPED
        speed = float(np.max(np.abs(motion.qd)))
        motion.stop(max(programs.PROGRAM_STOP, speed / STOP_TIME), arm.clock.now)
        if runtime is not arm.runtime:
            self.publish()

    def play(self) -> OrderResult:
        """Resume a paused program and its interrupted motion."""
        arm = self.arm
        if arm.runtime is not Runtime.PAUSED or self._program is None or not arm.can_run:
            return OrderResult.REFUSED
        arm.runtime = Runtime.PLAYING
        arm.note("program resumed")
        interrupted, self._interrupted = self._interrupted, None
        if interrupted is not None:
            arm.trajectory.start(*interrupted, arm.clock.now)
        return OrderResult.DONE

    def protective_stop(self, why: str) -> None:
        """Stop at once and pause the program until `unlock`."""
        self._stopped_at = time.monotonic()
        self._safety_stop(SafetyMode.PROTECTIVE_STOP, f"protective stop: {why}")

    def safeguard_stop(self) -> None:
        """Stop at once and pause the program: somebody is in the guarded area."""
        self._safety_stop(SafetyMode.SAFEGUARD_STOP, "safeguard stop")

    def release_safeguard(self) -> None:
        """End a safeguard stop; a paused program goes on by itself, as on a real controller."""
        if self.arm.safety_mode is SafetyMode.SAFEGUARD_STOP:
            self.arm.safety_mode = SafetyMode.NORMAL
            self.arm.note("safeguard reset")
            self.play()

    def reduce(self, on: bool = True) -> None:
        """Begin or end the reduced mode, in which a program runs on."""
        if self.arm.can_run:
            self.arm.safety_mode = SafetyMode.REDUCED if on else SafetyMode.NORMAL

    def _safety_stop(self, mode: SafetyMode, why: str) -> None:
        arm = self.arm
        if not arm.can_run:
            return
        arm.note(why)
        arm.safety_mode = mode
        self._compiling = None
        arm.runtime = Runtime.STOPPED if self._program is None else Runtime.PAUSING
        self._interrupted = arm.trajectory.goal or self._interrupted
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
        """Release the button; the power stays off."""
        if self.arm.safety_mode is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.arm.safety_mode = SafetyMode.NORMAL
            self.arm.note("emergency stop released")

    def power(self, mode: RobotMode) -> OrderResult:
        """Change to a power mode: on (idle), brakes released (running), or off."""
        arm = self.arm
        if mode is RobotMode.POWER_OFF:
            self.stop_program("power off")
            arm.robot_mode, self._powering = mode, None
        elif arm.safety_mode is not SafetyMode.NORMAL:
            return OrderResult.REFUSED
        elif arm.robot_mode < mode:
            if arm.robot_mode is RobotMode.POWER_OFF:
                arm.robot_mode = RobotMode.POWER_ON
            self._powering = time.monotonic() + _POWER_UP, mode
        return OrderResult.DONE

    def set_remote(self, remote: bool) -> None:
        """Turn remote control on or off; turning it off ends the network's program."""
        if remote is self.arm.remote:
            return
        self.arm.remote = remote
        self.arm.note("remote mode" if remote else "local mode")
        if not remote:
            self.stop_program("local mode")
        self.step()

    def publish(self) -> None:
        """Write the state to the blackboard if it has changed."""
        arm, motion = self.arm, self.arm.trajectory
        state = (motion.arrivals, motion.moving, arm.payload, *arm.payload_com.tolist())
        recent = time.monotonic() - self._published_at < _LEAST_INTERVAL
        if state != self._published or (motion.moving and not recent):
            self._published, self._published_at = state, time.monotonic()
            motion.publish(self._board, arm.payload, arm.payload_com)

    def _start_program(self, text: str) -> None:
        self._compiling = None
        for name, kind in _PROGRAMS.items():
            try:
                self._program = kind(text, self.arm)
            except ValueError:
                continue
            self.arm.runtime = Runtime.PLAYING
            self.arm.note(f"{name} plays")
            return
        # any other program stops the arm and ends
        self.arm.note(f"foreign program: {text[:60]!r}")


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
    """Serves the clients of a controller, each until it disconnects."""

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._model = controller.arm.kinematics.arm.name.upper().replace("E", "e")
        self._writers: set[asyncio.StreamWriter] = set()

    @property
    def clients(self) -> int:
        """Number of open connections."""
        return len(self._writers)

    def drop(self) -> None:
        """Cut every connection."""
        for writer in list(self._writers):
            writer.transport.abort()

    async def run(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it disconnects."""
        self._writers.add(writer)
        errors = (OSError, ValueError, IndexError, asyncio.IncompleteReadError)
        try:
            with contextlib.suppress(*errors):
                await self.serve(reader, writer)
        finally:
            self._writers.discard(writer)
            writer.close()

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer the requests of a client."""
        raise NotImplementedError


class DashboardServer(ClientServer):
    """Answers the lines of every client."""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer line by line; a connection made in local mode never accepts orders."""
        local = not self._controller.arm.remote
        if not self._controller.arm.dashboard_mute:
            writer.write(f"{GREETING}\n".encode())
        while line := await reader.readline():
            text = line.decode("utf-8", "replace").strip()
            if not self._controller.arm.dashboard_mute:
                writer.write(f"{self.answer(text, local)}\n".encode())
                if text.lower() == "quit":
                    return

    def answer(self, line: str, local: bool) -> str:
        """Return the answer to a line."""
        command, arm = line.lower(), self._controller.arm
        answer = self._questions().get(command)
        if answer is not None:
            return answer
        order, success = self._orders().get(command, (None, ""))
        if order is None:
            return f"could not understand: '{line}'"
        if local or not arm.remote:
            arm.note(f"dashboard refused in local mode: {command}")
            return LOCAL
        arm.note(f"dashboard: {command}")
        result = order()
        failed = EARLY if result is OrderResult.TOO_EARLY else f"Failed to execute: {command}"
        return success if result in (OrderResult.DONE, None) else failed

    def _questions(self) -> dict[str, str]:
        arm = self._controller.arm
        plays = str(arm.runtime is Runtime.PLAYING).lower()
        return {
            "polyscopeversion": "URSoftware {}.{}.{}.{} (Jan 01 2023)".format(*arm.version),
            "get serial number": SERIAL_NUMBER,
            "get robot model": self._model,
            "is in remote control": str(arm.remote).lower(),
            "robotmode": f"Robotmode: {arm.robot_mode.name}",
            "safetystatus": f"Safetystatus: {arm.safety_mode.name}",
            "safetymode": f"Safetymode: {arm.safety_mode.name}",
            "running": f"Program running: {plays}",
            "programstate": f"{arm.program_state} <unnamed>",
            "get loaded program": "No program loaded",
            "get operational mode": "NONE",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "quit": "Disconnected",
        }

    def _orders(self) -> dict[str, tuple[Callable[[], OrderResult | None], str]]:
        c = self._controller
        return {
            "play": (c.play, "Starting program"),
            "stop": (partial(c.stop_program, "dashboard"), "Stopped"),
            "unlock protective stop": (c.unlock, "Protective stop releasing"),
            "power on": (partial(c.power, RobotMode.IDLE), "Powering on"),
            "brake release": (partial(c.power, RobotMode.RUNNING), "Brake releasing"),
            "power off": (partial(c.power, RobotMode.POWER_OFF), "Powering off"),
        }


BASE = "/universal-robots/robot-api"
_API_VERSIONS = (((10, 14), "5.0.107"), ((10, 12), "3.1.4"), ((10, 11), "2.0.0"))
_BODY = 1 << 16  # bytes; longest body read
Answer = tuple[int, dict[str, Any]]


class RobotApiServer(ClientServer):
    """Answers the requests of every client."""

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request after the other."""
        while line := (await reader.readline()).decode("latin-1").split():
            head: dict[str, str] = {}
            while name := (await reader.readline()).decode("latin-1").strip():
                key, _, value = name.partition(":")
                head[key.lower()] = value.strip()
            body = await reader.readexactly(min(int(head.get("content-length", 0)), _BODY))
            if self._controller.arm.dashboard_mute:
                continue
            status, content = self.answer(line[0], line[1], body)
            text = json.dumps(content).encode()
            lines = f"HTTP/1.1 {status} {http.client.responses[status]}\r\n"
            lines += f"Content-Type: application/json\r\nContent-Length: {len(text)}\r\n\r\n"
            writer.write(lines.encode() + text)

    def answer(self, method: str, path: str, body: bytes) -> Answer:
        """Return status and body of the answer to a request."""
        answers, orders = self._questions(), self._orders()
        name = path.removeprefix(BASE).rstrip("/")
        if not path.startswith(BASE) or name not in {**answers, **(orders if answers else {})}:
            return 404, {"message": "Not Found"}
        if method == "GET" and name in answers:
            return 200, answers[name]
        if method != "PUT" or name not in orders:
            return 405, {"message": "Method Not Allowed"}
        arm = self._controller.arm
        try:
            action = json.loads(body)["action"]
        except (ValueError, KeyError, TypeError):
            return 422, {"message": "no action"}
        if not arm.remote:
            arm.note(f"Robot API refused in local mode: {action}")
            return 403, {"message": "The robot must be in remote mode"}
        arm.note(f"Robot API: {action}")
        order = orders[name].get(action) if isinstance(action, str) else None
        if order is None:
            return 422, {"message": f"no action {action}"}
        result = order()
        if result is None:
            return 200, {"state": "STOPPED", "message": "Program stopped"}
        if result is OrderResult.DONE:
            return 200, {"message": f"{action} done"}
        return 409, {"message": f"{action} is not possible now: {result.value}"}

    def _questions(self) -> dict[str, dict[str, Any]]:
        """Answers to queries by path, for the version; empty for versions without the API."""
        arm, version = self._controller.arm, self._controller.arm.version[:2]
        api = next((api for since, api in _API_VERSIONS if version >= since), None)
        if api is None:
            return {}
        out: dict[str, dict[str, Any]] = {
            "/openapi.json": {"info": {"title": "Robot API", "version": api}},
            "/program/v1/state": {"state": arm.program_state},
        }
        if version >= (10, 12):
            out |= {
                "/robotstate/v1/robotmode": {"mode": arm.robot_mode.name},
                "/robotstate/v1/safetymode": {"mode": arm.safety_mode.name.replace("ROBOT_", "")},
                "/system/v1/controlmode": {"mode": "REMOTE" if arm.remote else "LOCAL"},
                "/system/v1/operationalmode": {"mode": "AUTOMATIC"},
            }
        if version >= (10, 14):
            name = self._model.replace("UR8LONG", "UR8L")
            out["/system/v1/information"] = {"robotType": name, "serialNumber": SERIAL_NUMBER}
            out["/versions/v1"] = {"marketingVersion": ".".join(map(str, arm.version[:3]))}
        return out

    def _orders(self) -> dict[str, dict[str, Callable[[], OrderResult | None]]]:
        c = self._controller
        return {
            "/program/v1/state": {
                "stop": partial(c.stop_program, "Robot API"),
                "play": c.play,
                "resume": c.play,
            },
            "/robotstate/v1/state": {
                "POWER_ON": partial(c.power, RobotMode.IDLE),
                "BRAKE_RELEASE": partial(c.power, RobotMode.RUNNING),
                "POWER_OFF": partial(c.power, RobotMode.POWER_OFF),
                "UNLOCK_PROTECTIVE_STOP": c.unlock,
            },
        }


STATE, MESSAGE = 16, 20
MODE, KINEMATICS = 0, 5
LINEARISED, NOT_INITIALISED = 2, 0
_VERSION_MESSAGE = 3
_PERIOD = 0.1  # s between states


class PrimaryPort(ClientServer):
    """Sends states to every client, and takes programs from them."""

    def __init__(self, controller: Controller, rows: Floats, status: int) -> None:
        """Serve a controller whose kinematics are `rows` (4, 6): theta, a, d, alpha, rad and m."""
        super().__init__(controller)
        self._rows, self._status = rows, status

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send states, and run the programs that come."""
        sending = asyncio.create_task(self._send_states(writer))
        try:
            await self._controller.take_programs(reader)
        finally:
            sending.cancel()

    async def _send_states(self, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError):
            writer.write(self._version())
            parts = self._kinematics()
            while not writer.is_closing():
                writer.write(_package(STATE, self._mode() + parts))
                await writer.drain()
                parts = b""
                await asyncio.sleep(_PERIOD)

    def _version(self) -> bytes:
        major, minor, bugfix, build = self._controller.arm.version
        name = b"URControl"
        body = struct.pack(">QbBB", time.monotonic_ns() // 1000, -2, _VERSION_MESSAGE, len(name))
        body += name + struct.pack(">BBii", major, minor, bugfix, build) + b"01-01-2025, 00:00:00"
        return _package(MESSAGE, body)

    def _mode(self) -> bytes:
        arm = self._controller.arm
        program = arm.runtime in (Runtime.PLAYING, Runtime.PAUSED, Runtime.PAUSING)
        flags = (
            *(True, True, arm.robot_mode.value >= 4, arm.safety_bits & 0b11000000 > 0),
            *(arm.safety_bits & 4 > 0, program, arm.runtime is Runtime.PAUSED),
        )
        values = (*flags, arm.robot_mode.value, 0, arm.slider, arm.scaling, 1.0, 0)
        return _package(MODE, struct.pack(">Q7?BBdddB", time.monotonic_ns() // 1000, *values))

    def _kinematics(self) -> bytes:
        valid = 0 if self._status == LINEARISED else 0xFFFFFFFF
        body = struct.pack(">6I24dI", *[valid] * 6, *self._rows.ravel(), self._status)
        return _package(KINEMATICS, body)


def _package(kind: int, body: bytes) -> bytes:
    return struct.pack(">iB", 5 + len(body), kind) + body
