"""The dashboard server: questions about the robot's state, and a second way to stop it.

One line per command, one line per answer. Source: Universal Robots, "Dashboard Server
e-Series", port 29999. PolyScope X has a Robot API in its place.
"""

from dataclasses import dataclass

from hilcal.drivers.ur_link.lines import Connection, LinkError

PORT = 29999
NOT_UNDERSTOOD = "could not understand"


@dataclass(frozen=True, slots=True)
class RobotFacts:
    """State of the robot by its dashboard server or Robot API; empty where it does not say."""

    model: str  # e.g. "UR10"
    serial: str  # serial number
    version: str  # of the software, as the robot writes it
    remote: bool | None  # whether it is in remote control; None where the robot has no such mode
    program: str  # "PLAYING", "PAUSED", "STOPPED" and the name of the loaded program


@dataclass(frozen=True, slots=True)
class Dashboard:
    """The dashboard server at an address; every call raises LinkError where it fails, in time."""

    host: str
    name = "dashboard server"

    def check(self, seconds: float) -> None:
        """Ask for a sign of life."""
        ask(self.host, ("robotmode",), seconds)

    def describe(self, seconds: float) -> RobotFacts:
        """Ask for everything worth knowing."""
        commands = (
            "get robot model",
            "get serial number",
            "PolyscopeVersion",
            "is in remote control",
            "programState",
        )
        model, serial, version, remote, program = map(_told, ask(self.host, commands, seconds))
        return RobotFacts(model, serial, version, _yes(remote), program)

    def in_remote_control(self, seconds: float) -> bool | None:
        """Whether programs may command the arm; None where the robot has no such mode (CB3)."""
        return _yes(_told(*ask(self.host, ("is in remote control",), seconds)))

    def stop(self, seconds: float) -> None:
        """Stop the robot's program, and with it the arm."""
        (answer,) = ask(self.host, ("stop",), seconds)
        if not answer.lower().startswith("stopped"):
            raise LinkError(f'the dashboard server answers "{answer}" to "stop"')


def ask(host: str, commands: tuple[str, ...], seconds: float) -> list[str]:
    """Return the answer to each command, all within one deadline."""
    with Connection(host, PORT, "dashboard server", seconds) as line:
        line.read_line()  # it greets first
        out = []
        for command in commands:
            line.send(command.encode() + b"\n")
            out.append(line.read_line())
        return out


def _told(answer: str) -> str:
    """Return an answer; nothing where the command is not known."""
    return "" if NOT_UNDERSTOOD in answer.lower() else answer


def _yes(answer: str) -> bool | None:
    return answer.lower() == "true" if answer else None
