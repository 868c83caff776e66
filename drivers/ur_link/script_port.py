"""The port that takes URScript programs: a third way to stop the arm.

A program that arrives there replaces the one that runs. Source: Universal Robots, "Remote
Control via TCP/IP", port 30003.
"""

from drivers.ur_link.lines import Connection

PORT = 30003


def stop(host: str, deceleration: float, seconds: float) -> None:
    """Send a program that brakes the arm along its path, rad/s² of the leading joint.

    Raises:
        LinkError: the port does not take it in time.
    """
    program = f"def stop_arm():\n  stopj({deceleration:.3f})\nend\n"
    with Connection(host, PORT, "script port", seconds) as line:
        line.send(program.encode())
