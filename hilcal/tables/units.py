"""Units: their size in SI, and lengths and durations as people write them."""

import math
import re
from collections.abc import Mapping
from typing import Literal

from hilcal.errors import InputError

Length = Literal["m", "mm", "um", "in"]
Angle = Literal["rad", "mrad", "deg", "arcsec"]
Temperature = Literal["degC", "degF", "K"]
METRIC = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
LENGTHS = {**METRIC, "in": 0.0254}
"""Metres in a unit."""
ANGLES = {"rad": 1.0, "mrad": 1e-3, "deg": 0.017453292519943295, "arcsec": 4.84813681109536e-6}
"""Radians in a unit."""
FORCES = {"N": 1.0, "kN": 1e3, "kgf": 9.80665, "lbf": 4.4482216152605}
"""Newtons in a unit."""
MOMENTS = {"Nm": 1.0, "Nmm": 1e-3, "kNm": 1e3}
"""Newton metres in a unit."""
MASSES = {"kg": 1.0, "g": 1e-3, "lb": 0.45359237}
"""Kilograms in a unit."""
SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}
"""Seconds in a unit of time."""
_SHAPE = re.compile(r"\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\S*)\s*")


def parse_length(text: str, what: str) -> float:
    """Return a length in m, e.g. of "0.1 mm".

    Args:
        text: a number over 0 and its unit.

    Raises:
        InputError: anything else.
    """
    return _parse(text, what, METRIC, 'a length over 0 in m, mm, um, e.g. "0.1 mm"')


def parse_duration(text: str, what: str) -> float:
    """Return a duration in s, e.g. of "90 min".

    Args:
        text: a number over 0 and its unit.

    Raises:
        InputError: anything else.
    """
    return _parse(text, what, SECONDS, 'a duration over 0 in s, min, h, e.g. "90 min"')


def _parse(text: str, what: str, units: Mapping[str, float], valid: str) -> float:
    match = _SHAPE.fullmatch(text)
    try:
        number = math.nan if match is None else float(match["number"])
    except ValueError:
        number = math.nan
    if match is None or math.isnan(number):
        raise InputError(f'{what} "{text}" is not understood; valid: {valid}')
    if match["unit"] not in units:
        wrong = f'has the unit "{match["unit"]}"' if match["unit"] else "has no unit"
        raise InputError(f'{what} "{text}" {wrong}; valid: {valid}')
    number *= units[match["unit"]]
    if not (math.isfinite(number) and number > 0):
        raise InputError(f'{what} "{text}" is not over 0; valid: {valid}')
    return number
