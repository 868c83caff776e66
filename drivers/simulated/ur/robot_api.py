"""The Robot API of a simulated PolyScope X: the dashboard's questions and orders over HTTP.

Paths, bodies and the versions that have them: Universal Robots, "Robot API" (openapi.json of the
controller), and `DashboardClientImplX` of the Universal Robots Client Library. Every order is
refused by 403 in local mode.
"""

import asyncio
import http.client
import json
from collections.abc import Callable
from typing import Any

from hilcal.drivers.simulated.ur.controller import SERIAL_NUMBER, ClientServer, OrderResult
from hilcal.drivers.simulated.ur.state import RobotMode

BASE = "/universal-robots/robot-api"
_API_VERSIONS = (((10, 14), "5.0.107"), ((10, 12), "3.1.4"), ((10, 11), "2.0.0"))
_BODY = 1 << 16  # bytes of the longest body that is read
Answer = tuple[int, dict[str, Any]]


class RobotApiServer(ClientServer):
    """Answers the requests of every client."""

    async def run(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve a client until it goes, one request after the other."""
        self._writers.add(writer)
        try:
            while line := (await reader.readline()).decode("latin-1").split():
                head: dict[str, str] = {}
                while name := (await reader.readline()).decode("latin-1").strip():
                    key, _, value = name.partition(":")
                    head[key.lower()] = value.strip()
                body = await reader.readexactly(min(int(head.get("content-length", 0)), _BODY))
                if self._faults.dashboard_mute:
                    continue
                status, told = self.answer(line[0], line[1], body)
                text = json.dumps(told).encode()
                words = f"HTTP/1.1 {status} {http.client.responses[status]}\r\n"
                words += f"Content-Type: application/json\r\nContent-Length: {len(text)}\r\n\r\n"
                writer.write(words.encode() + text)
        except (OSError, ValueError, IndexError, asyncio.IncompleteReadError):
            pass  # gone, or no HTTP
        finally:
            self._writers.discard(writer)
            writer.close()

    def answer(self, method: str, path: str, body: bytes) -> Answer:
        """Return status and body of the answer to a request."""
        paths = self._paths()
        at = path.removeprefix(BASE).rstrip("/")
        if not path.startswith(BASE) or at not in paths:
            return 404, {"message": "Not Found"}
        ask, order = paths[at]
        if method == "GET" and ask is not None:
            return 200, ask()
        if method != "PUT" or order is None:
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
        return order(action)

    def _paths(
        self,
    ) -> dict[str, tuple[Callable[[], dict[str, Any]] | None, Callable[[str], Answer] | None]]:
        """Questions and orders by path, as the version has them."""
        arm, version = self._controller.arm, self._controller.arm.version[:2]
        api = next((api for since, api in _API_VERSIONS if version >= since), None)
        if api is None:
            return {}
        mode, safety = arm.robot_mode.name, arm.safety_mode.name.replace("ROBOT_", "")
        control = "REMOTE" if arm.remote else "LOCAL"
        runs = arm.program_state
        paths: dict[str, Any] = {
            "/openapi.json": (lambda: {"info": {"title": "Robot API", "version": api}}, None),
            "/robotstate/v1/state": (None, self._state),
            "/program/v1/state": (lambda: {"state": runs}, self._program),
        }
        if version >= (10, 12):
            paths["/robotstate/v1/robotmode"] = (lambda: {"mode": mode}, None)
            paths["/robotstate/v1/safetymode"] = (lambda: {"mode": safety}, None)
            paths["/system/v1/controlmode"] = (lambda: {"mode": control}, None)
            paths["/system/v1/operationalmode"] = (lambda: {"mode": "AUTOMATIC"}, None)
        if version >= (10, 14):
            name = self._model.upper().replace("E", "e").replace("UR8LONG", "UR8L")
            about = {"robotType": name, "serialNumber": SERIAL_NUMBER}
            paths["/system/v1/information"] = (lambda: about, None)
            whole = ".".join(map(str, arm.version[:3]))
            paths["/versions/v1"] = (lambda: {"marketingVersion": whole}, None)
        return paths

    def _program(self, action: str) -> Answer:
        match action:
            case "stop":
                self._controller.stop_program("Robot API")
                return 200, {"state": "STOPPED", "message": "Program stopped"}
            case "play" | "resume":
                return _said(self._controller.play(), action)
        return 422, {"message": f"no action {action}"}

    def _state(self, action: str) -> Answer:
        powers = {
            "POWER_ON": RobotMode.IDLE,
            "BRAKE_RELEASE": RobotMode.RUNNING,
            "POWER_OFF": RobotMode.POWER_OFF,
        }
        if action in powers:
            return _said(self._controller.power(powers[action]), action)
        if action == "UNLOCK_PROTECTIVE_STOP":
            return _said(self._controller.unlock(), action)
        return 422, {"message": f"no action {action}"}


def _said(result: OrderResult, action: str) -> Answer:
    if result is OrderResult.DONE:
        return 200, {"message": f"{action} done"}
    return 409, {"message": f"{action} is not possible now: {result.value}"}
