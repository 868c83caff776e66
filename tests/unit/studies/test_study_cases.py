"""Campaigns of the study of the diagnosis: what is hidden in them, and a further round."""

import numpy as np
import pytest

from hilcal.cell import cell_from_config
from hilcal.diagnosis.verdict import diagnose
from hilcal.errors import InputError
from studies.diagnosis import intervals
from studies.study_cases import study_case, with_study_loads
from studies.study_more import measure_more, suspects
from studies.unmodelled_laws import LAWS, law_named, shift
from tests.support.campaigns import configuration
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal
from tests.support.rehearsed import dead_weights


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


@pytest.mark.parametrize("robot", ["ur3e", "ur5e", "ur10e"])
def test_loads_are_what_the_arm_can_carry(robot):
    own, loads = with_study_loads(configuration(), robot)
    arm = cell_from_config(own).arm
    assert len(loads) == 5
    carried = [float(np.linalg.norm(w[:3])) / 9.81 + own.tool.mass_kg for _, w in loads]
    assert max(carried) <= arm.payload
    assert max(carried) > 0.7 * arm.payload
    c = study_case(configuration(), robot, "deflection", (), 0.0, 0)
    assert len(c.readings) == 180
    assert set(c.readings.load_names) == {"none", *(name for name, _ in loads)}
    pulls = np.array([w for _, w in loads])
    assert np.linalg.matrix_rank(pulls) >= 4
    assert pulls[0] == pytest.approx(dead_weights([-pulls[0, 2] / 9.81], [0, 0, -9.81])[0][1])


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


def test_intervals_hold_true_parameters_and_no_others():
    c = study_case(configuration(), "ur10e", "absolute", (), 0.0, 1)
    f = fitted_model(c.cell, c.readings, "absolute")
    (told,) = intervals(f, c.world.truth)
    assert (told.effect, told.parameters) == ("joint_compliance", 6)
    assert told.inside >= 4
    doubled = {name: 2 * value for name, value in c.world.truth.items()}
    assert intervals(f, doubled)[0].inside < told.inside
    assert intervals(f, {}) == ()


def diagnosed(c):
    return diagnose(fitted_model(c.cell, c.readings, "deflection"))


def test_nothing_is_measured_where_one_effect_leads_alone():
    c = case("hysteresis", mode="deflection", strength=3.0, poses=20)
    d = diagnosed(c)
    assert suspects(d) == ("hysteresis",)
    assert measure_more(configuration(), "ur10e", c, d, seed=1) is None
