"""GeoCOM: numbers of requests and return codes, and what they mean for a measurement.

Source: Leica Geosystems, GeoCOM Reference Manual (return codes; TMC, AUT, BAP, CSV, COM); the
names of all codes are geocompy's.
"""

from geocompy.geo.gctypes import GeoComCode

from hilcal.errors import DeviceError
from hilcal.measuring.devices import TargetLostError

NULL = 0
GEOCOM_VERSION = 110
DO_MEASURE = 2008
FACE = 2026
GET_ATMOSPHERE = 2029
FULL_MEASUREMENT = 2167
SERIAL_NUMBER = 5003
NAME = 5004
FIRMWARE = 5034
POWER = 5039
LOCK_IN = 9013
TURN = 9027
LOCK_STATE = 9021
FINE_ADJUST = 9037
MEASURE_DISTANCE_ANGLE = 17017
SEARCH = 17020

OK = 0
UNKNOWN = frozenset({5, 27, 3081})
"""Not implemented, not available, no such request: this instrument does without it."""
BUSY = frozenset({13, 1293})
"""Another process inside the instrument is at work; ask again a little later."""
GARBLED = frozenset(
    {3073, 3074, 3076, 3078, 3080, 3082, 3085, 3087, 3093, 3094, 3101, 3102},
)
"""Request or reply were damaged or out of step on the line; ask again after draining it."""

WARNINGS = {
    1283: "not all corrections were applied (code 1283: level or compensator?)",
    1284: "the instrument does not guarantee its accuracy (code 1284)",
}
"""A full measurement that may be used, with a remark."""

LOST = {
    1285: "only angles were measured, no distance (beam broken?)",
    1288: "only angles were measured, without full correction",
    1289: "only angles were measured, without guarantee",
    1292: "the distance could not be measured (beam broken, or no reflector?)",
    1294: "no signal returns from the target",
    8704: "the target was not found in time",
    8706: "the target could not be aimed at",
    8708: "the target could not be aimed at exactly",
    8710: "no target in sight",
    8711: "more than one target in sight; cover the others",
    8712: "the target cannot be made out (stray light?)",
    8725: "the lock on the target was lost",
}
"""No reading, but another try after a search may give one."""

_ADVICE = {
    16: "charge or change its battery",
    18: "charge or change its battery",
    21: "it is too cold or too hot",
    22: "level it",
    25: "wake it up",
    1290: "level it and check its compensator",
    1291: "set its atmospheric correction and prism constant",
    8714: "switch on its automatic target recognition",
}
"""What a person can do about other codes."""


_MEANING = {
    13: "busy with something else",
    16: "its battery is empty",
    21: "its temperature is out of range",
    22: "its tilt is out of range",
    25: "asleep",
    1293: "still busy measuring",
}
"""What the commonest codes say, alone or after a colon."""


def words(code: int) -> str:
    """Return a return code for people: what it means, and the number."""
    try:
        name = GeoComCode(code).name.replace("_", " ").lower()
        known = _MEANING.get(code) or f'"{name}"'
        return f"{known} (code {code})"
    except ValueError:
        return f"code {code}"


def failure(doing: str, code: int) -> DeviceError:
    """Return the exception for a return code that gave no reading, e.g. of "measuring"."""
    if code in LOST:
        return TargetLostError(f"tracker: {doing}: {LOST[code]} (code {code})")
    advice = f"; {_ADVICE[code]}" if code in _ADVICE else ""
    return DeviceError(f"tracker: {doing}: the instrument reports: {words(code)}{advice}")
