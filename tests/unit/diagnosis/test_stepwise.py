"""Additions reconsidered: needless effects, exchanged ones, doubts; what could have been seen."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.evidence import (
    REDUNDANCY_LEVEL,
    StepwiseAlternatives,
    backward_elimination,
)
from hilcal.diagnosis.stepwise import add, exchange, remove, trial
from hilcal.drivers.simulated.injected_effects import hide_effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.linearisation import linearise
from hilcal.refinement import Path, refine
from tests.support.campaigns import NO_EFFECT, campaign, measured, plan, world_of
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.refusals import refusal


def work(c, *effects):
    """Revisions as refine would have made them, had it added these effects."""
    path = Path(fitted_baseline(c))
    for name in effects:
        path.append(add(path.steps[-1].fit, name), name)
    return path


def test_an_effect_that_the_readings_cannot_determine_is_rejected():
    """The refinement goes on; with so few poses all effects predict together."""
    c = campaign("link_geometry", "absolute", 1, poses=12, strength=3.0)
    few = c.readings[c.readings.unloaded][np.arange(8)]
    before = fitted_baseline(c, readings=few)
    assert trial(before, "link_geometry") is None
    with pytest.raises(CannotAnswerError, match="nothing is left to judge the model by"):
        add(before, "link_geometry")
    assert refine(before.model, few, "absolute", background=False).fit.theta.size


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "effects"),
    [
        ("deflection", ("backlash", "joint_tilt_compliance")),
        ("absolute", ("hysteresis", "encoder_offset")),
    ],
)
def test_what_is_not_there_is_needless_but_for_chance(mode, effects):
    """p-values are uniform, so that one in a hundred is kept: 60 of them."""
    p_values = []
    for seed in range(30):
        c = campaign(NO_EFFECT, mode, seed, poses=12, plan_seed=1, registration_known=True)
        found = fitted_baseline(c, *effects)
        judged = {n: score.p_value for n, score in backward_elimination(found).items()}
        p_values += [judged.get(name, 0.0) for name in effects]
    assert set(effects) >= set(judged)
    kept = sum(p < REDUNDANCY_LEVEL for p in p_values)
    assert kept <= 4  # a chance of 0.001 for more, at one in a hundred
    for share in (0.25, 0.5, 0.75):
        below = np.mean(np.array(p_values) < share)
        assert abs(below - share) < 3.3 * np.sqrt(share * (1 - share) / 60)


@pytest.mark.parametrize("effect", ["hysteresis", "backlash", "transmission_error"])
def test_what_is_there_is_not_backward_elimination(effect):
    mode = "absolute" if effect == "transmission_error" else "deflection"
    c = campaign(effect, mode, 3, poses=30, strength=1.0)
    assert effect not in backward_elimination(fitted_baseline(c, effect))


def test_an_early_addition_that_became_needless_is_removed():
    c = campaign("hysteresis", "absolute", 2, poses=20)
    w = work(c, "load_point", "hysteresis")
    assert w.steps[-1].diagnosis.redundant == ("load_point",)
    assert w.reconsider()
    last = w.steps[-1]
    assert (last.added, last.removed) == (None, "load_point")
    assert last.fit.model.names == (*w.steps[0].fit.model.names, "hysteresis")
    assert not w.reconsider()


def test_a_wrong_choice_is_exchanged_for_the_right_one():
    c = campaign("hysteresis", "absolute", 2, poses=20)
    w = work(c, "transmission_error")
    assert w.reconsider()
    last = w.steps[-1]
    assert (last.added, last.removed) == ("hysteresis", "transmission_error")
    assert last.diagnosis.verdict == "adequate"


def _two_in_the_guise_of_one():
    """Two hidden effects, and the large family that stands for both of them."""
    c = campaign("encoder_offset", "absolute", 2, poses=30)
    cell, p = c.cell, plan(30, 1002)
    rng = np.random.default_rng(2)
    world = world_of(cell, rng)
    for effect in ("encoder_offset", "tracker_drift"):
        world = hide_effect(effect, cell, p.states, 3.0, "absolute", rng, world=world)
    return work(replace(c, world=world, readings=measured(world, p, rng)), "link_geometry")


def test_a_large_family_that_took_the_part_of_two_effects_is_exchanged_for_them():
    w = _two_in_the_guise_of_one()
    w.extend()
    while w.reconsider():
        w.extend()
    names = w.steps[-1].fit.model.names
    assert {"encoder_offset", "tracker_drift"} <= set(names)
    assert "link_geometry" not in names


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_algebra_tells_what_a_refit_would_of_an_effect_and_of_others_in_its_place(mode):
    c = campaign("hysteresis", mode, 4, poses=20, registration_known=True)
    full = fitted_baseline(c, "hysteresis")
    without = remove(full, "hysteresis")
    p = linearise(without)
    scores = {s.effect: s.score for s in rank_suspects(p, candidates(without))}
    other = StepwiseAlternatives(full).of("hysteresis")
    own = scores.pop("hysteresis").log_evidence
    assert own > 30.0
    assert other.effect_log_evidence == pytest.approx(own, rel=0.03)
    assert own > max(found.log_evidence for found in scores.values()) + 30.0
    assert not other.better
    assert not other.as_good


def test_an_exchange_needs_an_effect_that_is_there_and_one_that_is_not():
    found = fitted_baseline(campaign(NO_EFFECT, "deflection", 1), "backlash")
    for changed in (
        lambda: remove(found, "hysteresis"),
        lambda: exchange(found, "hysteresis", "creep"),
    ):
        refusal("hysteresis is not in the model", changed)
    with pytest.raises(InputError, match="joint_compliance is in the model already"):
        exchange(found, "backlash", "joint_compliance")
