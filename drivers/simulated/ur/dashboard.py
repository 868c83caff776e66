"""The dashboard: one line asks, one line answers.

Source: Universal Robots, article "Dashboard Server e-Series, port 29999"; the sentence of the
local mode as reported in Universal_Robots_ROS_Driver issue 125.
"""

import asyncio
from collections.abc import Callable

from drivers.simulated.ur.controller import Controller, OrderResult
from drivers.simulated.ur.rtde_link import Faults
from drivers.simulated.ur.state import RobotMode, Runtime

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


class Dashboard:
    """Answers the lines of every client."""

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

        Args:
            words: the line.
            local: the connection was made in local mode; it never gets more rights.
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
        state = {Runtime.PLAYING: "PLAYING", Runtime.PAUSED: "PAUSED", Runtime.PAUSING: "PAUSED"}
        return {
            "polyscopeversion": "URSoftware {}.{}.{}.{} (Jan 01 2023)".format(*arm.version),
            "get serial number": SERIAL_NUMBER,
            "get robot model": self._model.upper().replace("E", "e"),
            "is in remote control": str(arm.remote).lower(),
            "robotmode": f"Robotmode: {arm.robot_mode.name}",
            "safetystatus": f"Safetystatus: {arm.safety_mode.name}",
            "safetymode": f"Safetymode: {arm.safety_mode.name}",
            "running": f"Program running: {str(plays).lower()}",
            "programstate": f"{state.get(arm.runtime, 'STOPPED')} <unnamed>",
            "get loaded program": "No program loaded",
            "get operational mode": "NONE",
            "close popup": "closing popup",
            "close safety popup": "closing safety popup",
            "quit": "Disconnected",
        }

    def _orders(self) -> dict[str, Callable[[], str]]:
        controller = self._controller
        return {
            "play": lambda: _said(controller.play(), "Starting program", "play"),
            "stop": self._stop,
            "unlock protective stop": self._unlock,
            "power on": lambda: self._power(RobotMode.IDLE, "Powering on", "power on"),
            "brake release": lambda: self._power(
                RobotMode.RUNNING, "Brake releasing", "brake release"
            ),
            "power off": lambda: self._power(RobotMode.POWER_OFF, "Powering off", "power off"),
        }

    def _stop(self) -> str:
        self._controller.stop_program("dashboard")
        return "Stopped"

    def _unlock(self) -> str:
        answer = self._controller.unlock()
        if answer is OrderResult.TOO_EARLY:
            return EARLY
        return _said(answer, "Protective stop releasing", "unlock protective stop")

    def _power(self, mode: RobotMode, done: str, command: str) -> str:
        return _said(self._controller.power(mode), done, command)


def _said(answer: OrderResult, done: str, command: str) -> str:
    return done if answer is OrderResult.DONE else f"Failed to execute: {command}"
