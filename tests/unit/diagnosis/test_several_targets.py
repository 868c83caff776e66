"""Diagnosis of readings of several targets per arrival, the arm's scatter not stated."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.verdict import diagnose
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.refinement import refine
from tests.support.campaigns import Campaign
from tests.support.reflector_cases import reflectors

STD = 2.5e-5
KNOWN = (True, False, False)


def unstated(c: Campaign) -> Readings:
    """The readings with the instrument's covariance alone, as a table without the arm's has it."""
    common = c.readings.common
    assert common is not None
    instrument = c.readings.covariance - common @ np.swapaxes(common, 1, 2)
    return replace(c.readings, covariance=instrument, common=None, scatter_stated=False)


@pytest.mark.parametrize(("mode", "seed"), [("deflection", 0), ("absolute", 2)])
def test_an_unknown_scatter_is_found_and_not_taken_for_a_cause(mode: Mode, seed: int) -> None:
    """Taken for independent, these readings name a cause: transmission_error in the second."""
    c = reflectors(seed=seed, poses=20, known=KNOWN, joint_std=STD)
    readings = unstated(c)
    found = fit(baseline(c.cell, readings, mode), readings, mode)
    d = diagnose(found)
    assert found.variance_factor > 4
    assert (d.verdict, d.reason, d.significant) == ("adequate", "arm_scatter", ())
    assert d.scatter is not None
    assert d.scatter.kind == "joints"
    assert d.scatter.std[0] == pytest.approx(STD, abs=4 * d.scatter.std_error[0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("effect", "mode"), [("base_compliance", "deflection"), ("link_compliance", "absolute")]
)
def test_a_hidden_effect_is_found_beside_an_unknown_scatter(effect: str, mode: Mode) -> None:
    c = reflectors(effect, mode=mode, poses=20, known=KNOWN, joint_std=STD)
    readings = unstated(c)
    path = refine(baseline(c.cell, readings, mode), readings, mode)
    assert [s.added for s in path.steps] == [None, effect, None]
    assert path.steps[-1].diagnosis.verdict == "adequate"
    assert 0.8 < path.fit.variance_factor < 1.25
