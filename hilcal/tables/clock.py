"""Times of a table as seconds."""

from datetime import UTC, datetime

import numpy as np

from hilcal.errors import InputError
from hilcal.tables.grid import Cell, Grid
from hilcal.tables.mapping_sections import Time
from hilcal.tables.units import SECONDS
from hilcal.types import Floats

EPOCH = 1e8
"""s; times beyond three years are counted from an epoch, not from the campaign's start."""
_DAY = 86400.0
_EXPECTED = {
    "iso": "a date and time like 2024-05-31T12:00:00",
    "excel": "days since 1899-12-30",
}


def seconds(grid: Grid, time: Time) -> Floats:
    """(N,) times in s; dates, and times since an epoch, are counted from the earliest row.

    Raises:
        InputError: a cell that is no time, or empty.
    """
    if time.unit in SECONDS:
        values = SECONDS[time.unit] * grid.numbers(time.column)
        _refuse_missing(grid, time, values, "a time")
        return values - values.min() if values.min() > EPOCH else values
    cells = grid.cells(time.column)
    values = np.array([_stamp(c, grid, time, k) for k, c in enumerate(cells)])
    expected = time.format or _EXPECTED.get(time.unit, "a date")
    _refuse_missing(grid, time, values, expected)
    return np.asarray(np.round(values - values.min(), 6))


def _stamp(cell: Cell, grid: Grid, time: Time, k: int) -> float:
    """Seconds since 1970 (any zone), NaN where the cell is no time."""
    if isinstance(cell, datetime):
        return _since(cell)
    try:
        if time.unit == "excel":
            return _DAY * float(str(cell).replace(",", "."))
        text = str(cell).strip()
        if time.format is not None:
            return _since(datetime.strptime(text, time.format))
        return _since(datetime.fromisoformat(text.replace(",", ".")))
    except ValueError:
        return float("nan")


def _since(when: datetime) -> float:
    return (when if when.tzinfo else when.replace(tzinfo=UTC)).timestamp()


def _refuse_missing(grid: Grid, time: Time, values: Floats, expected: str) -> None:
    bad = ~np.isfinite(values)
    if bad.any():
        k = int(np.argmax(bad))
        raise InputError(
            f"{grid.at(k, grid.name(time.column))}: '{grid.text(time.column)[k]}' is not "
            f"{expected}; see unit of the times in the mapping"
        )
