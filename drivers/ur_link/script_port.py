"""The port that takes URScript programs: a third way to stop the arm.

A program that arrives there replaces the one that runs. Source: Universal Robots, "Remote
Control via TCP/IP", port 30003; the primary port, 30001, takes the same and is the one that
PolyScope X opens.
"""

import time

from hilcal.drivers.ur_link.lines import Connection

PORT = 30003
_TAKEN_S = 0.05
"""Time before the connection is closed: a program is lost where its sender has gone before it was
taken; a choice."""


def stop(host: str, deceleration: float, seconds: float, port: int = PORT) -> None:
    """Send a program that brakes the arm along its path, rad/s² of the leading joint.

    Raises:
        LinkError: the port does not take it in time.
    """
    program = f"def stop_arm():\n  stopj({deceleration:.3f})\nend\n"
    with Connection(host, port, "script port", seconds) as line:
        line.send(program.encode())
        time.sleep(_TAKEN_S)
