"""What the driver needs of a UR controller, by TCP port."""

from hilcal.config import CellConfig
from hilcal.drivers.ur_link import dashboard, probe, script_port
from hilcal.drivers.ur_link.lines import LinkError
from hilcal.drivers.ur_link.options import UrOptions
from hilcal.drivers.ur_link.supervision import POLYSCOPE_X, PRIMARY_PORT
from hilcal.toml import check_section

RTDE = {probe.PORT: "real-time interface (RTDE)"}
SERVICES = {dashboard.PORT: "dashboard server", script_port.PORT: "script port", **RTDE}
_ASK_S = 2.0


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
