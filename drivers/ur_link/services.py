"""What the driver `ur` needs: keys of [robot.options], and services of the controller."""

from typing import Annotated

from pydantic import Field, Strict

from hilcal.config import CellConfig
from hilcal.drivers.ur_link import dashboard, probe
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.supervision import POLYSCOPE_X, PRIMARY_PORT, REALTIME_PORT
from hilcal.toml import Section, check_section

RTDE = {probe.PORT: "real-time interface (RTDE)"}
SERVICES = {dashboard.PORT: "dashboard server", REALTIME_PORT: "script port", **RTDE}
_ASK_S = 2.0


class UrOptions(Section):
    """[robot.options]: keys of the driver "ur"."""

    receive_hz: Annotated[float, Strict(), Field(ge=10, le=500)] = Field(
        125.0, description="packets of state per second, 10 to 500"
    )
    robot_api_port: Annotated[int, Strict(), Field(ge=1, le=65535)] = Field(
        80, description="number of the TCP port of PolyScope X's Robot API, 1 to 65535"
    )


def services(config: CellConfig) -> dict[int, str]:
    """Return what the controller of a cell has to offer, by port; it is asked for its version.

    Raises:
        InputError: [robot.options] is wrong.
    """
    options = check_section(dict(config.robot.options), UrOptions, "[robot.options]")
    try:
        version = probe.controller(config.robot.host or "", ("timestamp",), _ASK_S).version
    except LinkError:
        return SERVICES
    if version[0] < POLYSCOPE_X:
        return SERVICES
    return {options.robot_api_port: "Robot API", PRIMARY_PORT: "primary port", **RTDE}
