"""Options of effects: small checked readers."""

from collections.abc import Mapping, Sequence

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.types import Floats

Options = Mapping[str, object]
TYPICAL_TWIST, TYPICAL_SHIFT = 2e-3, 7e-5
"""Twist of a joint at its rated torque where its compliance is unknown, rad, and shift of a slide
at its rated force, m. Guesses within the 0.3 to 5 mrad of most arms, and for racks and screws of
10 to 100 N/µm."""
ORDINARY_TWIST, ORDINARY_SHIFT = 3e-3, 1e-4  # the ordinary ones, rad and m
LEVER = 0.5  # Moment on a carriage per rated force of its drive, m: a choice
PRIOR_HELP = dict.fromkeys(
    ("prior_m", "prior_rad"), "standard deviation of what is known of it already."
)


def number(effect: str, options: Options, key: str) -> float:
    """Read an option that must be a finite number."""
    value = options[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"effect {effect}: {key} = {value!r}; valid: a finite number")
    return float(value)


def positive(effect: str, options: Options, key: str) -> float:
    """Read an option that must be a number above zero."""
    value = number(effect, options, key)
    if value <= 0:
        raise InputError(f"effect {effect}: {key} = {value:g}; valid: more than 0")
    return value


def numbers(effect: str, options: Options, key: str, count: int) -> Floats:
    """Read an option that must be a finite number for all, or a list of `count` of them."""
    value = options[key]
    if not isinstance(value, list | tuple):
        return np.full(count, number(effect, options, key))
    if len(value) != count:
        raise InputError(f"effect {effect}: {key} has {len(value)} values; valid: 1 or {count}")
    return np.array([number(effect, {key: v}, key) for v in value])


def choice(effect: str, options: Options, key: str, valid: tuple[str, ...]) -> str:
    """Read an option that must be one of a few words."""
    value = options[key]
    if not isinstance(value, str) or value not in valid:
        raise InputError(f"effect {effect}: {key} = {value!r}; valid: {', '.join(valid)}")
    return value


def rated_moments(cell: Cell) -> Floats:
    """(n,) moments that joints are built for; of a slide its rated force at half a metre, N·m."""
    return np.asarray(cell.arm.ratings * np.where(cell.arm.slides, LEVER, 1.0))


def ordinary_joint_motions(cell: Cell) -> Floats:
    """(n,) how far a joint ordinarily gives at its rated torque or force, rad or m."""
    return np.where(cell.arm.slides, ORDINARY_SHIFT, ORDINARY_TWIST)


def typical_compliances(cell: Cell) -> Floats:
    """(n,) typical joint compliances, rad/(N·m); of slides m/N."""
    return np.where(cell.arm.slides, TYPICAL_SHIFT, TYPICAL_TWIST) / cell.arm.ratings


def prior_of_units(effect: str, options: Options, units: Sequence[str]) -> Floats | None:
    """(P,) `prior_m` of parameters in m, `prior_rad` of those in rad; None where not given."""
    keys = ("prior_m", "prior_rad")
    stated = [k for k in keys if k in options]
    if not stated:
        return None
    if len(stated) == 1:
        raise InputError(
            f"effect {effect}: {stated[0]} alone; valid: prior_m and prior_rad, or none"
        )
    values = [number(effect, options, k) for k in keys]
    if min(values) <= 0:
        raise InputError(f"effect {effect}: prior_m and prior_rad must be positive")
    return np.array([values[unit == "rad"] for unit in units])
