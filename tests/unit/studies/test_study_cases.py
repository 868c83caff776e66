"""Campaigns of the study of the diagnosis: what is hidden in them, and a further round."""

import numpy as np
import pytest

from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from studies.study_cases import study_case
from studies.study_more import measure_more, suspects
from studies.unmodelled_laws import LAWS, law_named, shift
from tests.support.campaigns import configuration
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal


def case(*hidden, mode="absolute", strength=2.0, **given):
    return study_case(
        configuration(), "ur10e", mode, hidden, strength, int(given.get("seed", 3)),
        cycles=int(given.get("cycles", 1)),
        stated=given.get("stated", 1.0),
        n_poses=int(given.get("poses", 8)),
    )  # fmt: skip


def seen(c):
    """What would be read without noise."""
    return c.readings.value - c.noise


def test_the_noise_is_as_large_as_stated_or_as_misjudged():
    for stated in (0.5, 1.0, 2.0):
        many = [case(mode="deflection", seed=s, stated=stated, cycles=2) for s in range(4)]
        white = [
            np.linalg.solve(np.linalg.cholesky(c.readings.covariance), c.noise[:, :, None])
            for c in many
        ]
        # 4 · 96 readings of three elements: 2 % of a standard deviation
        assert np.std(np.concatenate(white)) == pytest.approx(1 / stated, rel=0.08)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_law_outside_of_the_catalogue_acts_at_the_strength_asked(law):
    for mode in law.readings:
        c = case(law.name, mode=mode, strength=3.0)
        assert c.variables == law.variables
        clean = c.world.ideal_readings(c.readings.states)
        change = seen(c) - clean.position
        covariance = c.world.covariance(clean)
        if mode == "deflection":
            first = np.repeat(np.arange(0, 48, 6), 6)
            change = change - change[first]
            covariance = covariance + covariance[first]
            loaded = c.readings.load > 0
            change, covariance = change[loaded], covariance[loaded]
        white = np.linalg.solve(np.linalg.cholesky(covariance), change[:, :, None])
        assert np.sqrt(np.mean(white**2)) == pytest.approx(3.0, rel=1e-6)


def test_laws_and_effects_that_do_not_fit_are_refused():
    refusal("crossed gear", law_named, "crossed gears")
    refusal("absolute", case, "crossed gear", mode="deflection")
    refusal("cancels in deflections", case, "encoder_offset", mode="deflection")
    c = case()
    still = c.readings.states
    law, none = law_named("base that turns"), np.zeros(3, dtype=np.int64)
    refusal("no loaded reading", shift, law, c.world, still[none], 3.0, "deflection", none, none)
    with pytest.raises(InputError, match="no unloaded reading"):
        shift(law, c.world, still[none + 1], 3.0, "deflection", none, none)
    with pytest.raises(InputError, match="changes nothing"):
        shift(law_named("swaying bench"), c.world, still[none], 3.0, "absolute", none, none)


def diagnosed(c):
    return diagnose(fitted_model(c.cell, c.readings, "deflection"))


def test_nothing_is_measured_where_one_effect_leads_alone():
    c = case("hysteresis", mode="deflection", strength=3.0, poses=20)
    d = diagnosed(c)
    assert suspects(d) == ("hysteresis",)
    assert measure_more(configuration(), "ur10e", c, d, seed=1) is None
