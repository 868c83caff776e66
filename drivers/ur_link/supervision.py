"""What answers about a controller's state and ends its program, beside RTDE.

PolyScope 3 and 5 have a dashboard server, PolyScope X (from 10.11 on) a Robot API; both are asked
the same. They differ, too, in where programs go and in the registers that a client may use.
"""

from dataclasses import dataclass

from hilcal.drivers.ur_link.dashboard import Dashboard
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.robot_api import RobotApi

POLYSCOPE_X = 10
"""Major version of the first controllers with a Robot API in place of the dashboard server."""
REALTIME_PORT, PRIMARY_PORT = 30003, 30001


Supervision = Dashboard | RobotApi


@dataclass(frozen=True, slots=True)
class Generation:
    """How a controller of one generation is supervised and commanded."""

    supervision: Supervision
    script_port: int  # takes programs: the real-time port, of PolyScope X the primary one
    upper: bool
    """Whether commands go by the upper half of the registers (24 to 47), which no fieldbus uses.
    ur_rtde 1.6.5 takes them up to PolyScope 5.22 only, and the lower half on any newer one, where
    the flag for the upper half would leave program and client apart."""

    @property
    def registers(self) -> tuple[str, str]:
        """Two of the registers that ur_rtde sends its commands through."""
        first = 24 if self.upper else 0
        return f"input_int_register_{first}", f"input_double_register_{first}"


def generation(host: str, version: tuple[int, ...], api_port: int) -> Generation:
    """Return how the controller of a version is supervised and commanded."""
    if version[0] >= POLYSCOPE_X:
        return Generation(RobotApi(host, api_port), PRIMARY_PORT, upper=False)
    return Generation(Dashboard(host), REALTIME_PORT, upper=version[:2] < (5, 23))


def why_silent(supervision: Supervision, seconds: float) -> str:
    """Return why it does not answer, which control needs; empty where it does."""
    try:
        supervision.check(seconds)
    except LinkError as error:
        return str(error)
    return ""
