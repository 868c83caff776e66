"""Durations as people write them."""

import math
import re

from hilcal.errors import InputError

DURATIONS = {"s": 1.0, "min": 60.0, "h": 3600.0}
_SHAPE = re.compile(r"\s*(?P<number>\d+(?:\.\d+)?)\s*(?P<unit>\S*)\s*")


def parse_duration(text: str, what: str) -> float:
    """Return a duration in s, e.g. of "90 min".

    Args:
        text: a number over 0 and its unit.
        what: where it stands, for messages.

    Raises:
        InputError: anything else.
    """
    match = _SHAPE.fullmatch(text)
    seconds = math.nan
    if match is not None and match["unit"] in DURATIONS:
        seconds = float(match["number"]) * DURATIONS[match["unit"]]
    if not (math.isfinite(seconds) and seconds > 0):
        units = ", ".join(DURATIONS)
        raise InputError(
            f'{what} "{text}" is no duration; valid: a number over 0 in {units}, e.g. "90 min"'
        )
    return seconds
