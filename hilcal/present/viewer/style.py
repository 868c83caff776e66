"""Colours, scales and words shared by the views; all pure functions of a story."""

import math
import re

import numpy as np
from scipy import stats

from hilcal import numbers
from hilcal.types import Floats, Ints

Color = tuple[int, int, int]

GREY: Color = (150, 152, 160)
AMBER: Color = (255, 176, 0)
RED: Color = (220, 38, 80)
MEASURED: Color = (86, 180, 233)
PREDICTED: Color = (240, 240, 240)
NOISE: Color = (0, 158, 115)
HOLDOUT: Color = (204, 121, 167)
LEVEL_COLORS = np.array([GREY, AMBER, RED], dtype=np.uint8)
# Words in a picture stand in a box that the viewer makes: almost black in its dark theme, a middle
# grey in its light one. Only white is legible in both, so colours are told by marks beside words.
LABEL: Color = (255, 255, 255)
LEADER: Color = (165, 168, 176)
LEVEL_NAMES = ("inside", "doubtful", "outside")

INSIDE_P = 0.99  # grey up to here: the noise ball drawn
OUTSIDE_P = 0.9999  # red beyond: noise does this once in 10,000 readings
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0)
_LIMITS = stats.chi2.ppf([INSIDE_P, OUTSIDE_P], 3)
BALL_SIGMAS = float(np.sqrt(stats.chi2.ppf(INSIDE_P, 3)))

# Greek letters and these signs are in the viewer's fonts; a missing glyph ends the viewer.
_SIGNS = "■●▲→µ²³±×√Δ✓✗⚠°"
_UNSAFE = re.compile(rf"[^\n\x20-\x7e\u00a1-\u00ac\u00ae-\u00ff\u0391-\u03a9\u03b1-\u03c9{_SIGNS}]")
_MARKDOWN = re.compile(r"([\\`*_\[\]<>|#~$])")


def safe(text: str) -> str:
    """Text in which every character without a sure glyph is a question mark."""
    return _UNSAFE.sub("?", text)


def escaped(text: str) -> str:
    """Text made safe, on one line, and without any meaning in markdown."""
    return _MARKDOWN.sub(r"\\\1", safe(" ".join(text.split())))


def levels(norm2: Floats) -> Ints:
    """Level of squared Mahalanobis distances, 3 dof: 0 noise, 1 doubtful, 2 outside.

    Args:
        norm2: (N,) squared distances.

    Returns:
        (N,) levels; the limits are the quantiles `INSIDE_P` and `OUTSIDE_P` of chi2(3).
    """
    return np.digitize(norm2, _LIMITS).astype(np.int64)


def nice(value: float) -> float:
    """Largest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten that is at most `value`."""
    if not (math.isfinite(value) and value > 0):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(max(f for f in _NICE if f * power <= value * (1 + 1e-9)) * power)


def number(value: float, digits: int = 3) -> str:
    """Return a number with so many significant digits, without an exponent where readable."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    size = math.floor(math.log10(abs(value)))
    if -4 <= size < 6:
        return f"{value:.{max(0, digits - 1 - size)}f}"
    return f"{value:.{digits - 1}e}"


def micrometres(length: float) -> str:
    """Return a length in m as the terminal writes it."""
    return numbers.length(length)


def quantity(value: float, std: float | None, unit: str) -> tuple[str, str, str]:
    """Return a value and its standard uncertainty in a unit for people, and that unit."""
    if std is None:
        name, factor = numbers.unit_for(unit, [value])
        return number(factor * value), "", name
    return numbers.measured(unit, value, std)


def bars(share: float, width: int = 10) -> str:
    """Return a share 0..1 as up to `width` squares; one square for anything above 2 %."""
    count = round(width * min(max(share, 0.0), 1.0))
    return "■" * max(count, 1 if share > 0.02 else 0)


def percent(share: float) -> str:
    """Return a share as a whole percentage."""
    return f"{100 * share:.0f} %"
