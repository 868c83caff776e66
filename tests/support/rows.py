"""Rows of a parametrization, of which only the first are quick."""

import pytest


def first(count, rows):
    """The rows, of which all but the first few are marked long; a tuple has a value per name."""
    return [*rows[:count], *(_long(row) for row in rows[count:])]


def _long(row):
    if hasattr(row, "marks"):
        return pytest.param(*row.values, id=row.id, marks=(*row.marks, pytest.mark.long))
    values = row if isinstance(row, tuple) else (row,)
    return pytest.param(*values, marks=pytest.mark.long)
