"""The Robot API of PolyScope X: questions about the robot's state, and a second way to stop it.

HTTP with JSON bodies. PolyScope X 10.11 takes orders; modes are told from 10.12 on (API 3.1.4),
model, serial number and version from 10.14 on (API 5.0.107). An order in local mode is answered by
403. Source: Universal Robots, "Robot API", the controller's own page /universal-robots/robot-api/
docs, and `DashboardClientImplX` of the Universal Robots Client Library for paths and versions.
"""

import http.client
import json
import time
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from hilcal.drivers.ur_link.dashboard import RobotFacts
from hilcal.drivers.ur_link.lines import LinkError

BASE = "/universal-robots/robot-api"
_LONGEST = 1 << 20
"""Bytes of an answer that are read, at most; openapi.json has some 100,000."""
_REDIRECTS = 3
_ABSENT = 404


@dataclass(frozen=True, slots=True)
class RobotApi:
    """The Robot API at an address; every call raises LinkError where it fails, in time."""

    host: str
    port: int
    """Of the controller's web server, 80 on a real one."""

    @property
    def name(self) -> str:
        """What it is, for people."""
        return f"Robot API (port {self.port})"

    def check(self, seconds: float) -> None:
        """Ask whether it is there."""
        status, _ = self._ask("GET", "/openapi.json", time.monotonic() + seconds)
        if status == _ABSENT:
            raise LinkError(f"the {self.name} is not there; it needs PolyScope X 10.11 or newer")
        self._done(status, {}, "openapi.json")

    def describe(self, seconds: float) -> RobotFacts:
        """Ask for everything worth knowing; what the version does not tell is empty."""
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
        """Whether programs may command the arm; None where the version does not tell (10.11)."""
        return self._remote(time.monotonic() + seconds)

    def stop(self, seconds: float) -> None:
        """Stop the robot's program, and with it the arm."""
        self.order("/program/v1/state", "stop", seconds)

    def order(self, path: str, action: str, seconds: float) -> None:
        """Give an order, e.g. `/robotstate/v1/state` the action `POWER_ON`."""
        status, told = self._ask("PUT", path, time.monotonic() + seconds, {"action": action})
        self._done(status, told, action)

    def _remote(self, end: float) -> bool | None:
        mode = self._get("/system/v1/controlmode", end).get("mode")
        return None if mode is None else bool(mode == "REMOTE")

    def _get(self, path: str, end: float) -> dict[str, Any]:
        """Return an answer; nothing where the version does not have the path."""
        status, told = self._ask("GET", path, end)
        if status == _ABSENT:
            return {}
        self._done(status, told, path)
        return told

    def _done(self, status: int, told: dict[str, Any], what: str) -> None:
        if not 200 <= status < 300:
            why = _text(told, "message") or http.client.responses.get(status, "")
            raise LinkError(f'the {self.name} answers {status} "{why}" to {what}')

    def _ask(
        self, method: str, path: str, end: float, body: dict[str, str] | None = None
    ) -> tuple[int, dict[str, Any]]:
        """Return status and answer; follows a path that a version has moved elsewhere."""
        path = BASE + path
        for _ in range(_REDIRECTS + 1):
            status, place, data = self._once(method, path, end, body)
            if status not in (301, 302, 307, 308) or not place:
                break
            path = urlsplit(place).path
        try:
            told = json.loads(data) if data else {}
        except (ValueError, RecursionError):
            if 200 <= status < 300:
                raise LinkError(f"the {self.name} does not answer in JSON") from None
            told = {}
        return status, told if isinstance(told, dict) else {}

    def _once(
        self, method: str, path: str, end: float, body: dict[str, str] | None
    ) -> tuple[int, str, bytes]:
        text = None if body is None else json.dumps(body)
        head = {"Accept": "application/json"}
        head |= {} if text is None else {"Content-Type": "application/json"}
        left = max(end - time.monotonic(), 0.01)
        line = http.client.HTTPConnection(self.host, self.port, timeout=left)
        try:
            line.request(method, path, text, head)
            answer = line.getresponse()
            data = answer.read(_LONGEST)
        except TimeoutError:
            raise LinkError(f"the {self.name} does not answer in time") from None
        except ConnectionRefusedError:
            raise LinkError(f"the {self.name} refuses the connection", refused=True) from None
        except (OSError, http.client.HTTPException, ValueError) as error:
            words = getattr(error, "strerror", None) or type(error).__name__
            raise LinkError(f"the {self.name}: {words}") from None
        finally:
            line.close()
        return answer.status, answer.headers.get("Location") or "", data


def _text(told: dict[str, Any], key: str) -> str:
    value = told.get(key)
    return value if isinstance(value, str) else ""
