"""Lengths as people write them."""

import math
import re

from hilcal.errors import InputError

LENGTHS = {"m": 1.0, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6}
_SHAPE = re.compile(r"\s*(?P<number>[-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?P<unit>\S*)\s*")


def parse_length(text: str, what: str) -> float:
    """Return a length in m, e.g. of "0.1 mm".

    Args:
        text: a number over 0 and its unit.
        what: where it stands, for messages.

    Raises:
        InputError: anything else.
    """
    match = _SHAPE.fullmatch(text)
    valid = f'valid: a length over 0 in {", ".join(list(LENGTHS)[:3])}, e.g. "0.1 mm"'
    if match is None:
        raise InputError(f'{what} "{text}" is not understood; {valid}')
    if match["unit"] not in LENGTHS:
        wrong = f'has the unit "{match["unit"]}"' if match["unit"] else "has no unit"
        raise InputError(f'{what} "{text}" {wrong}; {valid}')
    try:
        number = float(match["number"]) * LENGTHS[match["unit"]]
    except ValueError:
        number = math.nan
    if not (math.isfinite(number) and number > 0):
        raise InputError(f'{what} "{text}" is no length over 0; {valid}')
    return number
