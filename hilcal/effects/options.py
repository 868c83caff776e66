"""Options of effects: small checked readers."""

from collections.abc import Mapping

import numpy as np

from hilcal.cell import Cell
from hilcal.errors import InputError
from hilcal.types import Floats

Options = Mapping[str, object]


def number(effect: str, options: Options, key: str) -> float:
    """Read an option that must be a finite number.

    Raises:
        InputError: where it is anything else.
    """
    value = options[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"effect {effect}: {key} = {value!r}; valid: a finite number")
    return float(value)


def rated_torques(cell: Cell) -> Floats:
    """(n,) rated torques, the measure of how stiff a joint is built; 150 N·m where unknown."""
    rated = cell.arm.torque_max
    return np.where(np.isfinite(rated) & (rated > 0), rated, 150.0)


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


def reading_options(effect: str, m: int) -> dict[str, object]:
    """Options of an effect that follow from the kind of reading: m = 3 positions, 6 poses."""
    return {"rotation": True} if effect == "target_offset" and m == 6 else {}
