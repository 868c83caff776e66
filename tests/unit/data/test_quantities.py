"""Lengths and durations as people write them."""

import math

import pytest

from hilcal.errors import InputError
from hilcal.tables.units import parse_duration, parse_length


@pytest.mark.parametrize(
    ("text", "metres"), [("0.1 mm", 1e-4), ("100um", 1e-4), ("100 µm", 1e-4), (" 2e-3 m ", 2e-3)]
)
def test_a_length(text, metres):
    assert math.isclose(parse_length(text, "--limit"), metres)


@pytest.mark.parametrize(("text", "seconds"), [("90 min", 5400), ("1.5h", 5400), ("20 s", 20)])
def test_a_duration(text, seconds):
    assert math.isclose(parse_duration(text, "--max-time"), seconds)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("0.1", 'has no unit; valid: a length over 0 in m, mm, um, e.g. "0.1 mm"'),
        ("2 inch", 'has the unit "inch"'),
        ("short", "is not understood"),
        ("-1 mm", "is not over 0"),
        ("0 mm", "is not over 0"),
        ("1.2.3 mm", "is not understood"),
        ("1e999 mm", "is not over 0"),  # infinite
    ],
)
def test_anything_else_is_refused_with_its_reason(text, why):
    with pytest.raises(InputError, match="--limit") as refused:
        parse_length(text, "--limit")
    assert why in str(refused.value)
