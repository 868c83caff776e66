"""Options of effects: small checked readers."""

from collections.abc import Mapping

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.types import Floats

Options = Mapping[str, object]


UNKNOWN_RATING = 150.0
"""Rated torque where the arm's description has none, N·m: a middle-sized joint; a guess."""
TYPICAL_TWIST = 2e-3
"""Twist of a joint at its rated torque where its compliance is unknown, rad. A guess within the
0.3 to 5 mrad of most arms."""

PRIOR_HELP = dict.fromkeys(
    ("prior_m", "prior_rad"), "standard deviation of what is known of it already."
)


def number(effect: str, options: Options, key: str) -> float:
    """Read an option that must be a finite number.

    Raises:
        InputError: where it is anything else.
    """
    value = options[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"effect {effect}: {key} = {value!r}; valid: a finite number")
    return float(value)


def positive(effect: str, options: Options, key: str) -> float:
    """Read an option that must be a number above zero.

    Raises:
        InputError: where it is anything else.
    """
    value = number(effect, options, key)
    if value <= 0:
        raise InputError(f"effect {effect}: {key} = {value:g}; valid: more than 0")
    return value


def numbers(effect: str, options: Options, key: str, count: int) -> Floats:
    """Read an option that must be a finite number for all, or a list of `count` of them.

    Raises:
        InputError: where it is anything else.
    """
    value = options[key]
    if not isinstance(value, list | tuple):
        return np.full(count, number(effect, options, key))
    if len(value) != count:
        raise InputError(f"effect {effect}: {key} has {len(value)} values; valid: 1 or {count}")
    return np.array([number(effect, {key: v}, key) for v in value])


def choice(effect: str, options: Options, key: str, valid: tuple[str, ...]) -> str:
    """Read an option that must be one of a few words.

    Raises:
        InputError: where it is anything else.
    """
    value = options[key]
    if not isinstance(value, str) or value not in valid:
        raise InputError(f"effect {effect}: {key} = {value!r}; valid: {', '.join(valid)}")
    return value


def rated_torques(cell: Cell) -> Floats:
    """(n,) rated torques, the measure of how stiff a joint is built; 150 N·m where unknown."""
    rated = cell.arm.torque_max
    return np.where(np.isfinite(rated) & (rated > 0), rated, UNKNOWN_RATING)


def typical_compliances(cell: Cell) -> Floats:
    """(n,) joint compliances where nothing is known of them, rad/(N·m)."""
    return TYPICAL_TWIST / rated_torques(cell)


def prior_of_lengths_and_turns(effect: str, options: Options, size: int) -> Floats | None:
    """Prior (size,) from `prior_m` for the first three and `prior_rad` for the others.

    Raises:
        InputError: where only one of the two is given, or one is not positive.
    """
    keys = ("prior_m", "prior_rad")
    given = [k for k in keys if k in options]
    if not given:
        return None
    if len(given) == 1:
        raise InputError(
            f"effect {effect}: {given[0]} alone; valid: prior_m and prior_rad, or none"
        )
    values = [number(effect, options, k) for k in keys]
    if min(values) <= 0:
        raise InputError(f"effect {effect}: prior_m and prior_rad must be positive")
    return np.repeat(values, 3)[:size]
