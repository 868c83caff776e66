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
    """State of the robot by its dashboard server or Robot API; empty where it does not say.

    Attributes:
        model: e.g. "UR10"; empty where unknown.
        serial: serial number; empty where unknown.
        version: of the software, as the robot writes it.
        mode: e.g. "RUNNING".
        safety: e.g. "NORMAL".
        remote: whether it is in remote control; None where the robot has no such mode.
        program: "PLAYING", "PAUSED", "STOPPED" and the name of the loaded program.
    """

    model: str
    serial: str
    version: str
    mode: str
    safety: str
    remote: bool | None
    program: str


@dataclass(frozen=True, slots=True)
class Dashboard:
    """The dashboard server at an address; see `supervision.Supervision`."""

    host: str

    @property
    def name(self) -> str:
        """What it is, for people."""
        return "dashboard server"

    def check(self, seconds: float) -> None:
        """Ask for a sign of life."""
        ask(self.host, ("robotmode",), seconds)

    def describe(self, seconds: float) -> RobotFacts:
        """Ask for everything worth knowing."""
        return describe(self.host, seconds)

    def in_remote_control(self, seconds: float) -> bool | None:
        """Whether programs may command the arm; None where the robot has no such mode (CB3)."""
        return in_remote_control(self.host, seconds)

    def stop(self, seconds: float) -> None:
        """Stop the robot's program, and with it the arm."""
        stop(self.host, seconds)


def ask(host: str, commands: tuple[str, ...], seconds: float) -> list[str]:
    """Return the answer to each command, all within one deadline.

    Raises:
        LinkError: no dashboard, or it does not answer in time.
    """
    with Connection(host, PORT, "dashboard server", seconds) as line:
        line.read_line()  # it greets first
        out = []
        for command in commands:
            line.send(command.encode() + b"\n")
            out.append(line.read_line())
        return out


def describe(host: str, seconds: float) -> RobotFacts:
    """Ask for everything worth knowing.

    Raises:
        LinkError: no dashboard, or it does not answer in time.
    """
    commands = (
        "get robot model",
        "get serial number",
        "PolyscopeVersion",
        "robotmode",
        "safetystatus",
        "is in remote control",
        "programState",
    )
    answers = ["" if NOT_UNDERSTOOD in a.lower() else a for a in ask(host, commands, seconds)]
    model, serial, version, mode, safety, remote, program = answers
    return RobotFacts(
        model=model,
        serial=serial,
        version=version,
        mode=mode.partition(":")[2].strip() or mode,
        safety=safety.partition(":")[2].strip() or safety,
        remote=remote.strip().lower() == "true" if remote else None,
        program=program,
    )


def in_remote_control(host: str, seconds: float) -> bool | None:
    """Whether programs may command the arm; None where the robot has no such mode (CB3).

    Raises:
        LinkError: no dashboard, or it does not answer in time.
    """
    (answer,) = ask(host, ("is in remote control",), seconds)
    return None if NOT_UNDERSTOOD in answer.lower() else answer.strip().lower() == "true"


def stop(host: str, seconds: float) -> None:
    """Stop the robot's program, and with it the arm.

    Raises:
        LinkError: no dashboard, it does not answer in time, or it refuses.
    """
    (answer,) = ask(host, ("stop",), seconds)
    if not answer.lower().startswith("stopped"):
        raise LinkError(f'the dashboard server answers "{answer}" to "stop"')
