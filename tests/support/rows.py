"""Rows of a parametrization, of which only the first are quick."""

from collections.abc import Sequence
from typing import Any

import pytest


def first(count: int, rows: Sequence[Any]) -> list[Any]:
    """The rows, of which all but the first few are marked long; a tuple has a value per name."""
    return [*rows[:count], *(_long(row) for row in rows[count:])]


def _long(row: Any) -> Any:
    if hasattr(row, "marks"):
        return pytest.param(*row.values, id=row.id, marks=(*row.marks, pytest.mark.long))
    values = row if isinstance(row, tuple) else (row,)
    return pytest.param(*values, marks=pytest.mark.long)
