"""Services beside RTDE that report a controller's state and end its program.

PolyScope 3 and 5 have a dashboard server (port 29999: one line per command, one per answer),
PolyScope X from 10.11 on a Robot API (HTTP with JSON bodies); both have one interface here. The API
reports modes from 10.12 on (API 3.1.4), model, serial number and version from 10.14 on (API
5.0.107); it refuses orders in local mode with status 403. The two generations also differ in the
port for programs and in the registers that a client may use.

Sources: Universal Robots, "Dashboard Server e-Series" and "Robot API"
(/universal-robots/robot-api/docs on a controller), and `DashboardClientImplX` of the Universal
Robots Client Library for paths and versions.
"""

import http.client
import json
import time
from dataclasses import dataclass
from typing import Annotated, Any, Self
from urllib.parse import urlsplit

from pydantic import Field, Strict

from hilcal.config import CellConfig
from hilcal.drivers.ur_link import probe
from hilcal.drivers.ur_link.probe import Connection, LinkError
from hilcal.toml import Section, check_section

DASHBOARD_PORT = 29999
NOT_UNDERSTOOD = "could not understand"


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """State of the robot from its dashboard server or Robot API; empty if not reported."""

    model: str  # e.g. "UR10"
    serial: str  # serial number
    version: str  # of the software, in the robot's spelling
    remote: bool | None  # whether it is in remote control; None where the robot has no such mode
    program: str  # "PLAYING", "PAUSED", "STOPPED" and the name of the loaded program


@dataclass(frozen=True, slots=True)
class Dashboard:
    """The dashboard server at an address; a call that fails or is late raises LinkError."""

    host: str
    name = "dashboard server"

    def check(self, seconds: float) -> None:
        """Ask for a sign of life."""
        ask(self.host, ("robotmode",), seconds)

    def describe(self, seconds: float) -> RobotFacts:
        """Ask for model, serial number, version and states."""
        commands = (
            "get robot model",
            "get serial number",
            "PolyscopeVersion",
            "is in remote control",
            "programState",
        )
        model, serial, version, remote, program = map(_known, ask(self.host, commands, seconds))
        return RobotFacts(model, serial, version, _yes(remote), program)

    def in_remote_control(self, seconds: float) -> bool | None:
        """Whether programs may command the arm; None where the robot has no such mode (CB3)."""
        return _yes(_known(*ask(self.host, ("is in remote control",), seconds)))

    def stop(self, seconds: float) -> None:
        """Stop the robot's program, and with it the arm."""
        (answer,) = ask(self.host, ("stop",), seconds)
        if not answer.lower().startswith("stopped"):
            raise LinkError(f'the dashboard server answers "{answer}" to "stop"')


def ask(host: str, commands: tuple[str, ...], seconds: float) -> list[str]:
    """Return the answer to each command, all within one deadline."""
    with Connection(host, DASHBOARD_PORT, "dashboard server", seconds) as line:
        line.read_line()  # the greeting
        out = []
        for command in commands:
            line.send(command.encode() + b"\n")
            out.append(line.read_line())
        return out


def _known(answer: str) -> str:
    """Return an answer; empty if the server does not know the command."""
    return "" if NOT_UNDERSTOOD in answer.lower() else answer


def _yes(answer: str) -> bool | None:
    return answer.lower() == "true" if answer else None


BASE = "/universal-robots/robot-api"
_LONGEST = 1 << 20  # bytes read of an answer, at most; openapi.json has some 100,000
_REDIRECTS = 3
_ABSENT = 404


@dataclass(frozen=True, slots=True)
class RobotApi:
    """The Robot API at an address; a call that fails or is late raises LinkError."""

    host: str
    port: int  # of the controller's web server, 80 on a real one

    @property
    def name(self) -> str:
        """Its name, for people."""
        return f"Robot API (port {self.port})"

    def check(self, seconds: float) -> None:
        """Raise LinkError if the API does not answer."""
        status, _ = self._ask("GET", "/openapi.json", time.monotonic() + seconds)
        if status == _ABSENT:
            raise LinkError(f"the {self.name} is not there; it needs PolyScope X 10.11 or newer")
        self._done(status, {}, "openapi.json")

    def describe(self, seconds: float) -> RobotFacts:
        """Ask for model, serial number, version and states; empty if the version lacks them."""
        end = time.monotonic() + seconds
        about = self._get("/system/v1/information", end)
        return RobotFacts(
            model=_text(about, "robotType"),
            serial=_text(about, "serialNumber"),
            version=_text(self._get("/versions/v1", end), "marketingVersion"),
            remote=self._remote(end),
            program=_text(self._get("/program/v1/state", end), "state"),
        )

    def in_remote_control(self, seconds: float) -> bool | None:
        """Whether programs may command the arm; None if the version does not report it (10.11)."""
        return self._remote(time.monotonic() + seconds)

    def stop(self, seconds: float) -> None:
        """Stop the robot's program, and with it the arm."""
        self.order("/program/v1/state", "stop", seconds)

    def order(self, path: str, action: str, seconds: float) -> None:
        """Give an order, e.g. `/robotstate/v1/state` the action `POWER_ON`."""
        status, answer = self._ask("PUT", path, time.monotonic() + seconds, {"action": action})
        self._done(status, answer, action)

    def _remote(self, end: float) -> bool | None:
        mode = self._get("/system/v1/controlmode", end).get("mode")
        return None if mode is None else bool(mode == "REMOTE")

    def _get(self, path: str, end: float) -> dict[str, Any]:
        """Return an answer; empty if the version lacks the path."""
        status, answer = self._ask("GET", path, end)
        if status == _ABSENT:
            return {}
        self._done(status, answer, path)
        return answer

    def _done(self, status: int, answer: dict[str, Any], request: str) -> None:
        """Raise LinkError if the status is no success."""
        if not 200 <= status < 300:
            reason = _text(answer, "message") or http.client.responses.get(status, "")
            raise LinkError(f'the {self.name} answers {status} "{reason}" to {request}')

    def _ask(
        self, method: str, path: str, end: float, body: dict[str, str] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Return status and answer; follows redirects."""
        path = BASE + path
        for _ in range(_REDIRECTS + 1):
            status, place, data = self._once(method, path, end, body)
            if status not in (301, 302, 307, 308) or not place:
                break
            path = urlsplit(place).path
        try:
            answer = json.loads(data) if data else {}
        except (ValueError, RecursionError):
            if 200 <= status < 300:
                raise LinkError(f"the {self.name} does not answer in JSON") from None
            answer = {}
        return status, answer if isinstance(answer, dict) else {}

    def _once(
        self, method: str, path: str, end: float, body: dict[str, str] | None
    ) -> tuple[int, str, bytes]:
        text = None if body is None else json.dumps(body)
        head = {"Accept": "application/json"}
        head |= {} if text is None else {"Content-Type": "application/json"}
        timeout = max(end - time.monotonic(), 0.01)
        line = http.client.HTTPConnection(self.host, self.port, timeout=timeout)
        try:
            line.request(method, path, text, head)
            answer = line.getresponse()
            data = answer.read(_LONGEST)
        except TimeoutError:
            raise LinkError(f"the {self.name} does not answer in time") from None
        except ConnectionRefusedError:
            raise LinkError(f"the {self.name} refuses the connection") from None
        except (OSError, http.client.HTTPException, ValueError) as error:
            reason = getattr(error, "strerror", None) or type(error).__name__
            raise LinkError(f"the {self.name}: {reason}") from None
        finally:
            line.close()
        return answer.status, answer.headers.get("Location") or "", data


def _text(answer: dict[str, Any], key: str) -> str:
    value = answer.get(key)
    return value if isinstance(value, str) else ""


POLYSCOPE_X = 10
"""Major version of the first controllers with a Robot API in place of the dashboard server."""
REALTIME_PORT, PRIMARY_PORT = 30003, 30001


@dataclass(frozen=True, slots=True)
class UrController:
    """A controller, and how one of its version is supervised and commanded."""

    host: str
    version: tuple[int, ...]  # major, minor, bugfix, build
    supervision: Dashboard | RobotApi
    script_port: int  # for programs: the real-time port; of PolyScope X the primary port
    upper_registers: bool
    """Whether commands use the upper half of the registers (24 to 47), which no fieldbus uses.
    ur_rtde 1.6.5 supports them up to PolyScope 5.22; on newer versions its program uses the lower
    half, so the flag for the upper half would separate program and client."""

    @classmethod
    def of(cls, host: str, version: tuple[int, ...], api_port: int) -> Self:
        """Return the controller of this version."""
        if version[0] >= POLYSCOPE_X:
            return cls(host, version, RobotApi(host, api_port), PRIMARY_PORT, upper_registers=False)
        return cls(
            host, version, Dashboard(host), REALTIME_PORT, upper_registers=version[:2] < (5, 23)
        )

    @property
    def registers(self) -> tuple[str, str]:
        """Two of the registers through which ur_rtde sends commands."""
        first = 24 if self.upper_registers else 0
        return f"input_int_register_{first}", f"input_double_register_{first}"

    def why_silent(self, seconds: float) -> str:
        """Return why the supervision, which control needs, does not answer; empty if it does."""
        try:
            self.supervision.check(seconds)
        except LinkError as error:
            return str(error)
        return ""


RTDE = {probe.PORT: "real-time interface (RTDE)"}
SERVICES = {DASHBOARD_PORT: "dashboard server", REALTIME_PORT: "script port", **RTDE}
_ASK_S = 2.0


class UrOptions(Section):
    """[robot.options]: keys of the driver "ur"."""

    receive_hz: Annotated[float, Strict(), Field(ge=10, le=500)] = Field(
        125.0, description="packets of state per second, 10 to 500"
    )
    robot_api_port: Annotated[int, Strict(), Field(ge=1, le=65535)] = Field(
        80, description="number of the TCP port of PolyScope X's Robot API, 1 to 65535"
    )
    reduced_mode: bool = Field(
        False,
        description="true where the arm always works in its safety system's reduced mode",
        examples=[True],
    )


def services(config: CellConfig) -> dict[int, str]:
    """Return the services that a cell's controller must offer, by port; asks for its version."""
    options = check_section(dict(config.robot.options), UrOptions, "[robot.options]")
    try:
        version = probe.controller(config.robot.host or "", ("timestamp",), _ASK_S)[0]
    except LinkError:
        return SERVICES
    if version[0] < POLYSCOPE_X:
        return SERVICES
    return {options.robot_api_port: "Robot API", PRIMARY_PORT: "primary port", **RTDE}
