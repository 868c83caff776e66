"""Laws of the force sensor's own errors."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, variables
from hilcal.discovery.curve import curves
from hilcal.discovery.discovery import Discovery, discover
from hilcal.discovery.law import Form, LawPart, effect_class
from hilcal.discovery.sites import sites
from hilcal.effects.check import check_effect
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import Fit, fit
from hilcal.robot import se3
from tests.unit.discovery.test_discover import campaign

SHARE = 0.3
"""Share of what the sensor reads along +z that is not there; it reads the other way rightly."""


@pytest.fixture(autouse=True, scope="module")
def short_products() -> None:
    """All products, other than in the other files of this folder: the law is one of the longer."""


@cache
def misread() -> Fit:
    """The same arm with nothing hidden, read by a force sensor that is wrong on one side."""
    of = campaign()
    assert not of.outlier.any()
    states = of.readings.states
    turn = of.solution.prediction.situation.chain.rotation[-1]
    along = se3.apply(np.swapaxes(turn, 1, 2), states.wrench[:, :3])
    more = np.zeros_like(along)
    more[:, 2] = SHARE / (1 - SHARE) * np.maximum(along[:, 2], 0.0)
    wrench = states.wrench.copy()
    wrench[:, :3] += se3.apply(turn, more)
    readings = replace(of.readings, states=replace(states, wrench=wrench))
    return fit(baseline(of.model.cell, readings, of.mode), readings, of.mode)


@cache
def found() -> Discovery:
    return discover(misread())


@pytest.mark.long
def test_a_one_sided_force_sensor_is_found_with_its_size() -> None:
    d = found()
    law = d.laws[0]
    assert law.acts_on == ("force sensor, force along z",)
    assert law.variables == ("force sensor force z",)
    (a,) = law.parameters
    assert a.unit == "1"
    assert abs(a.value - SHARE) < 4 * a.std < 0.5 * SHARE
    assert d.after is not None
    assert d.after.chi2 < 0.5 * misread().chi2


@pytest.mark.long
def test_what_is_written_is_an_effect_of_the_setup_with_its_derivative() -> None:
    d = found()
    kind = effect_class(d.source, d.laws[0].name)
    assert kind.of_setup
    check_effect(kind)


@pytest.mark.long
def test_the_curve_of_the_law_is_drawn_beside_the_readings() -> None:
    d = found()
    assert d.after is not None
    curve = curves(d.after, d.laws[0].form)[0]
    assert (curve.of, curve.unit, curve.quantity) == ("sensor_fz", "N", "fS_z")
    away = (curve.y - SHARE * np.maximum(curve.x, 0.0)) / curve.std
    assert abs(float(np.mean(away[curve.x > 0]))) < 0.5


@pytest.mark.parametrize(
    ("quantities", "unit"),
    [(("S_z",), "1"), (("S_z", "S_z"), "1/N"), (("S_x", "t"), "1/s"), (("t",), "N/s")],
)
def test_units_of_the_sensors_own_quantities_cancel(quantities: tuple[str, ...], unit: str) -> None:
    known = variables(misread().solution.prediction.situation)
    named = {v.symbol.removeprefix("f").partition(" ")[0].strip("("): v for v in known}
    factors = tuple(Factor(named[q], shapes.LINEAR) for q in quantities)
    site = next(s for s in sites(6) if s.symbol == "sensor_fz")
    assert Form((LawPart(site, Amplitude(factors), 0),)).unit(0) == unit
