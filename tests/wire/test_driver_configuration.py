"""What a configuration cannot ask of a driver is refused before the device is opened."""

import json

from hilcal.config import CellConfig
from hilcal.drivers import bota, emscon, ft300, geocom, natnet, netft, onrobot_hex, ur
from hilcal.drivers import terminal_operator as terminal
from hilcal.drivers.simulated import arm, operator
from tests.support.refusals import refusals, refuses

OPEN = {
    **{"geocom": geocom.open_tracker, "emscon": emscon.open_tracker, "natnet": natnet.open_tracker},
    **{"ft300": ft300.open_force_sensor, "bota": bota.open_force_sensor},
    **{"hex": onrobot_hex.open_force_sensor, "netft": netft.open_force_sensor},
    **{"ur": ur.open_arm, "simulated arm": arm.open_arm},
    **{"terminal": terminal.open_operator, "simulated operator": operator.open_operator},
}


@refusals("drivers")
def test_a_configuration_that_cannot_be_is_refused(case, given):
    """A driver, and sections of the cell."""
    driver, _, sections = given.partition("\n")
    config = CellConfig.model_validate({"robot": {"model": "ur10e"}, **json.loads(sections)})
    refuses(case, lambda: OPEN[driver](config))
