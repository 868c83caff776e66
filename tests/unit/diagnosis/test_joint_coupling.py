"""A joint that is taken along by another one: named where readings show it, and only there."""

import pytest

from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from tests.support.campaigns import campaign


@pytest.mark.parametrize("seed", [1, 2])
def test_it_is_named_in_absolute_readings(seed: int) -> None:
    c = campaign("joint_coupling", "absolute", seed, poses=30, strength=2.0)
    d = diagnose(fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute"))
    assert d.verdict == "missing_effect"
    assert d.suspects[0].effect == "joint_coupling"
    assert d.suspects[0].same_as == ()


def test_deflections_do_not_show_it() -> None:
    """Ten times the noise in positions cancels: the same commanded angles stand on both sides."""
    c = campaign("joint_coupling", "absolute", 1, poses=20, strength=10.0)
    d = diagnose(fit(baseline(c.cell, c.readings, "deflection"), c.readings, "deflection"))
    assert "joint_coupling" not in d.significant
    assert d.verdict == "adequate"


@pytest.mark.parametrize("effect", ["encoder_offset", "transmission_error"])
def test_others_are_not_taken_for_it(effect: str) -> None:
    c = campaign(effect, "absolute", 1, poses=30, strength=2.0)
    d = diagnose(fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute"))
    assert d.suspects[0].effect == effect
