"""An arm that is described without masses, under its weight and loads."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.identification.baseline import baseline, loads_differ, masses_note, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import notes
from hilcal.readings.readings import Readings
from tests.support.campaigns import campaign

C = campaign("none", "absolute", 0, poses=12)
TRUE = C.world.physics.joint_compliance
BARE = replace(C.cell, arm=replace(C.cell.arm, masses=np.zeros(6), coms=np.zeros((6, 3))))


def ratios(f: Fit) -> np.ndarray:
    """Compliances by the true ones, of joints 2 and 3, which carry the weight."""
    by_name = {p.name: p.value for p in f.parameters}
    return np.array([by_name[f"joint_compliance.j{j}"] / TRUE[j - 1] for j in (2, 3)])


def under(readings: Readings, *loads: str) -> Readings:
    return readings[np.isin(np.array(readings.load_names)[readings.load], loads)]


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_where_loads_differ_the_compliances_are_right(mode: str) -> None:
    f = fit(baseline(BARE, C.readings, mode), C.readings, mode)
    assert ("link_mass" in f.model.names) == (mode == "absolute")
    assert ratios(f) == pytest.approx(1.0, abs=0.03)
    assert f.variance_factor == pytest.approx(1.0, abs=0.3)
    note = masses_note(f)
    if mode == "deflection":
        assert note is None
    else:
        assert "link_mass estimates what its weight does" in note
        assert sum("masses" in n for n in notes(f)) == 1


def test_without_the_weight_they_are_too_soft_and_that_is_said() -> None:
    f = fit(with_effects(BARE, C.readings, "absolute", ("joint_compliance",)), C.readings,
            "absolute")  # fmt: skip
    assert ratios(f).max() > 1.3
    assert "hilcal add RUN link_mass" in masses_note(f)
    told = fit(with_effects(C.cell, C.readings, "absolute", ("joint_compliance",)), C.readings,
               "absolute")  # fmt: skip
    assert ratios(told) == pytest.approx(1.0, abs=0.03)
    assert masses_note(told) is None


def test_under_one_load_nothing_tells_them_apart_and_that_is_said() -> None:
    light = under(C.readings, "5kg")
    assert not loads_differ(light)
    f = fit(baseline(BARE, light, "absolute"), light, "absolute")
    assert "link_mass" not in f.model.names
    assert ratios(f)[0] > 2.0
    assert "no pose was read under two loads" in masses_note(f)
    assert loads_differ(under(C.readings, "none", "5kg"))
