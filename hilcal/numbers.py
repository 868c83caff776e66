"""Numbers for people: rounded, in units that are easy to read."""

import math
from collections.abc import Iterable, Sequence

# SI unit: units for people with their factor, small values first, and the value from which
# the next one is better.
_UNITS: dict[str, tuple[tuple[str, float, float], ...]] = {
    "m": (("µm", 1e6, 1e-3), ("mm", 1e3, math.inf)),
    "rad": (("µrad", 1e6, 1e-3), ("mrad", 1e3, math.inf)),
    "rad/(N·m)": (("µrad/(N·m)", 1e6, math.inf),),
    "m/N": (("nm/N", 1e9, math.inf),),
    "m/N³": (("am/N³", 1e18, 1e-15), ("fm/N³", 1e15, math.inf)),
    "m/K": (("µm/K", 1e6, math.inf),),
    "rad/(N·m)³": (("prad/(N·m)³", 1e12, 1e-9), ("nrad/(N·m)³", 1e9, math.inf)),
    "m/s": (("µm/h", 3.6e9, math.inf),),
    "rad/s": (("µrad/h", 3.6e9, math.inf),),
    "rad/K": (("µrad/K", 1e6, math.inf),),
    "1/K": (("ppm/K", 1e6, math.inf),),
    "1/(N·m²)": (("1/(MN·m²)", 1e6, math.inf),),
    "1": (("ppm", 1e6, 1e-3), ("%", 1e2, math.inf)),
}

LEAST = {"m": 1e-9, "rad": 1e-9}
"""SI; smaller values are rounding errors, below any measurement."""


def unit_for(unit: str, values: Sequence[float]) -> tuple[str, float]:
    """Return the unit for people, and its factor, for the values of a column."""
    largest = max((abs(v) for v in values), default=0.0)
    for name, factor, limit in _UNITS.get(unit, ()):
        if largest < limit:
            return name, factor
    return unit, 1.0


def variable_unit(unit: str) -> tuple[str, float]:
    """Return unit and factor of a recorded variable: angles in degrees, others in SI."""
    return ("°", 180.0 / math.pi) if unit == "rad" else (unit, 1.0)


def joint_unit(unit: str) -> tuple[str, float]:
    """Return the unit for people, and its factor, of a joint value in rad, or m of a slide."""
    return ("mm", 1e3) if unit == "m" else variable_unit(unit)


def joint_value(value: float, unit: str, places: int = 1) -> str:
    """Write a joint value in rad, or m of a slide, for people."""
    name, factor = joint_unit(unit)
    return f"{factor * value:.{places}f}{name if name == '°' else ' ' + name}"


def time_unit(span_s: float) -> tuple[str, float]:
    """Return the unit for people, and its factor, of times that span so many seconds."""
    if span_s <= 120:
        return "s", 1.0
    return ("h", 1 / 3600) if span_s > 7200 else ("min", 1 / 60)


def sizes(items: Iterable[tuple[str, float]]) -> str:
    """Write (unit, value) pairs, SI, in units for people."""
    return ", ".join(
        f"{text} {name}" for text, _, name in (measured(u, v, count=2) for u, v in items)
    )


def measured(
    unit: str, value: float, std: float = math.nan, alike: Sequence[float] = (), count: int = 3
) -> tuple[str, str, str]:
    """Return a value, its standard uncertainty ("" without one) and their unit for people, from SI.

    A number below `LEAST` is written as "< " with that limit. `alike` are the values of a column
    with one unit; `count` is the number of digits of a value without an uncertainty.
    """
    name, factor = unit_for(unit, alike or [value])
    least = LEAST.get(unit, 0.0)
    less = "< " + f"{factor * least:.9f}".rstrip("0")
    if math.isfinite(std) and std > 0:
        text, spread = with_std(factor * value, factor * max(std, least))
        return text, less if std < least else spread, name
    return less if 0 < abs(value) < least else digits(factor * value, count), "", name


def length(metres: float) -> str:
    """Return a length: µm below 1 mm, then mm, then m; three digits, but no less than 1 nm."""
    if abs(metres) >= 1.0:
        return f"{digits(metres)} m"
    value, _, unit = measured("m", metres)
    return f"{value} {unit}"


def digits(value: float, count: int = 3) -> str:
    """Write a number with `count` significant digits, without an exponent where that is short."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    power = math.floor(math.log10(abs(value)))
    if -4 <= power < 7:
        return f"{value:.{max(count - 1 - power, 0)}f}"
    return f"{value:.{count - 1}e}"


def with_std(value: float, std: float, *more: float) -> tuple[str, ...]:
    """Write a value, its standard uncertainty with two significant digits, and values like it.

    All have the decimals of the uncertainty; it is empty if it is not a positive number.
    """
    if not (math.isfinite(std) and std > 0):
        return digits(value), "", *map(digits, more)
    places = 1 - math.floor(math.log10(std))
    if not -7 < places < 8:
        return digits(value), digits(std, 2), *map(digits, more)
    return tuple(f"{x:.{max(places, 0)}f}" for x in (value, std, *more))


def plus_minus(value: float, std: float) -> str:
    """Write a value with its standard uncertainty as "a ± b", or alone without one."""
    return " ± ".join(filter(None, with_std(value, std)))


def percent(share: float) -> str:
    """Write a share in percent."""
    return f"{100 * share:.0f} %"


def chance(p: float) -> str:
    """Write a p-value; small ones with an exponent."""
    if p < 1e-16:
        return "< 1e-16"
    return f"{p:.0e}" if p < 1e-3 else f"{p:.2g}"


def p_equals(p: float) -> str:
    """Write "p = " or "p < " with a p-value, in the digits of the tables."""
    text = chance(p)
    return f"p {text}" if text.startswith("<") else f"p = {text}"


def many_tests(count: int, level: float, tested: str = "effects") -> str:
    """Write the number of tests, and the level p at which one counts (Bonferroni)."""
    level_each = digits(level / max(count, 1), 1)
    return (
        f"{count} {tested} were tested: one counts from p < {level_each}, which is {level:g} / "
        f"{count}, so that chance alone names any of them once in {1 / level:.0f} diagnoses."
    )


def condition(value: float | None) -> str:
    """Write a condition number."""
    return "-" if value is None else digits(value, 2)


def sentence(message: str) -> str:
    """Write a message as a sentence."""
    head = message[:1].upper() + message[1:]
    return head if head.endswith(".") else f"{head}."


def few(items: Sequence[str], most: int = 2) -> str:
    """Write the first names of a list, and the number of the others."""
    if (remaining := len(items) - most) <= 0:
        return names(items)
    return f"{', '.join(items[:most])} and {remaining} more"


def names(items: Sequence[str], word: str = "and") -> str:
    """Write a list in words: a, b and c."""
    if len(items) < 2:
        return "".join(items)
    return f"{', '.join(items[:-1])} {word} {items[-1]}"
