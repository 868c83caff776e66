"""Numbers for people: digits and units."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal import numbers


@pytest.mark.parametrize(
    ("metres", "words"),
    [
        (0.0, "0 µm"),
        (28.13e-6, "28.1 µm"),
        (999e-6, "999 µm"),
        (1.04e-3, "1.04 mm"),
        (0.327, "327 mm"),
        (2.5, "2.50 m"),
        (4.59e-16, "< 0.001 µm"),
        (-4.59e-16, "< 0.001 µm"),
        (1.04e-9, "0.00104 µm"),
    ],
)
def test_lengths(metres: float, words: str) -> None:
    assert numbers.length(metres) == words


@given(st.floats(1e-3, 1e6), st.integers(1, 5))
def test_digits_keep_the_value(value: float, count: int) -> None:
    assert float(numbers.digits(value, count)) == pytest.approx(
        value, rel=0.5 * 10.0 ** (1 - count)
    )


@given(st.floats(-1e4, 1e4), st.floats(1e-4, 1e2))
def test_a_value_is_written_to_the_digits_of_its_uncertainty(value: float, std: float) -> None:
    written, spread = numbers.with_std(value, std)
    # from 9.95 on there are no decimals left to drop
    assert abs(float(written) - value) <= (0.5 if std >= 9.95 else 0.06 * std)
    assert float(spread) == pytest.approx(std, rel=0.06, abs=0.5 if std >= 9.95 else 0)
    assert len(written.partition(".")[2]) == len(spread.partition(".")[2])


def test_what_rounding_leaves_is_no_number() -> None:
    assert numbers.measured("m", 3e-4, 4.59e-16) == ("300.0000", "< 0.001", "µm")
    assert numbers.measured("m", 2e-2, 4.59e-16) == ("20.0000000", "< 0.000001", "mm")
    assert numbers.measured("rad", 4.59e-16) == ("< 0.001", "", "µrad")
    assert numbers.measured("m", 0.0, 0.0) == ("0", "", "µm")
    assert numbers.sizes([("m", 4.59e-16), ("rad/K", 4e-9)]) == "< 0.001 µm, 0.0040 µrad/K"


@given(st.sampled_from(["m", "rad"]), st.floats(-1, 1), st.floats(0, 1))
def test_no_length_nor_angle_has_an_exponent(unit: str, value: float, std: float) -> None:
    assert "e" not in "".join(numbers.measured(unit, value, std)[:2])


def test_an_uncertainty_that_is_unknown_is_not_shown() -> None:
    assert numbers.with_std(1.234, math.inf) == ("1.23", "")


def test_units_follow_the_largest_value() -> None:
    assert numbers.unit_for("m", [2e-6, -5e-4]) == ("µm", 1e6)
    assert numbers.unit_for("m", [2e-6, -5e-3]) == ("mm", 1e3)
    assert numbers.unit_for("rad/(N·m)", [1e-5])[0] == "µrad/(N·m)"
    assert numbers.unit_for("furlong", [1.0]) == ("furlong", 1.0)
    assert numbers.unit_for("m", []) == ("µm", 1e6)


def test_sentences_keep_the_spelling_of_effects() -> None:
    assert numbers.sentence("residuals are noise") == "Residuals are noise."
    assert (
        numbers.sentence("hysteresis is missing: it", {"hysteresis"})
        == "hysteresis is missing: it."
    )
    assert numbers.names(["a"]) == "a"
    assert numbers.names(["a", "b", "c"]) == "a, b and c"
    assert numbers.few(["a", "b", "c", "d"]) == "a, b and 2 more"
    assert numbers.chance(0.0) == "< 1e-16"
    assert numbers.chance(0.0123) == "0.012"
