"""Lengths and durations as people write them: a number and its unit."""

import math
import re
from collections.abc import Mapping

from hilcal.errors import InputError

LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
DURATIONS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_SHAPE = re.compile(r"\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\S*)\s*")


def parse_length(text: str, what: str) -> float:
    """Return a length in m, e.g. of "0.1 mm".

    Args:
        text: a number over 0 and its unit.
        what: where it stands, for messages.

    Raises:
        InputError: anything else.
    """
    return _parse(text, what, LENGTHS, 'a length over 0 in m, mm, um, e.g. "0.1 mm"')


def parse_duration(text: str, what: str) -> float:
    """Return a duration in s, e.g. of "90 min".

    Args:
        text: a number over 0 and its unit.
        what: where it stands, for messages.

    Raises:
        InputError: anything else.
    """
    return _parse(text, what, DURATIONS, 'a duration over 0 in s, min, h, e.g. "90 min"')


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
