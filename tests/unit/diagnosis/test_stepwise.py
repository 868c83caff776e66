"""Additions reconsidered: needless effects, exchanged ones, doubts; what could have been seen."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.evidence import (
    PRICE_OF_EFFECT,
    REDUNDANCY_LEVEL,
    StepwiseAlternatives,
    backward_elimination,
)
from hilcal.diagnosis.minimum_detectable_effect import least_strength
from hilcal.diagnosis.stepwise import add, exchange, remove, trial
from hilcal.drivers.simulated.injected_effects import hide_effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.linearisation import effect_columns, linearise
from hilcal.refinement import Path, refine
from hilcal.regression.evidence import spectrum
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


def test_effects_added_by_algebra_explain_what_they_do_in_a_fit():
    """Evidence of a chain against that of adding its effects one by one, each refitted."""
    full = _two_in_the_guise_of_one().steps[-1].fit
    other = StepwiseAlternatives(full).of("link_geometry")
    assert {*other.replacements} == {"encoder_offset", "tracker_drift"}
    assert other.better
    current, total = remove(full, "link_geometry"), 0.0
    for name in other.replacements:
        p = linearise(current)
        (found,) = (s for s in rank_suspects(p, candidates(current)) if s.effect == name)
        total += found.score.log_evidence
        current = add(current, name)
    total -= PRICE_OF_EFFECT * (len(other.replacements) - 1)
    assert other.log_evidence == pytest.approx(total, rel=0.05)


def test_an_exchange_needs_an_effect_that_is_there_and_one_that_is_not():
    found = fitted_baseline(campaign(NO_EFFECT, "deflection", 1), "backlash")
    for changed in (
        lambda: remove(found, "hysteresis"),
        lambda: exchange(found, "hysteresis", "creep"),
    ):
        refusal("hysteresis is not in the model", changed)
    with pytest.raises(InputError, match="joint_compliance is in the model already"):
        exchange(found, "backlash", "joint_compliance")


@pytest.mark.parametrize("effect", ["backlash", "wrench_bias"])
def test_at_its_least_strength_an_effect_is_found_as_often_as_said(effect):
    """In the linearised campaign, with random parameters of that strength."""
    c = campaign(NO_EFFECT, "deflection", 5, poses=20)
    found = fitted_baseline(c)
    p = linearise(found)
    (e,) = (e for e in candidates(p.fit) if e.name == effect)
    of = effect_columns(p.fit, e)
    s = of.white.T @ p.project_out(of.white)
    units = tuple(q.unit for q in e.parameters)
    level = 1e-3
    least = least_strength(s, of.motion, of.scale, units, found.dof, 1.0, level, spectrum(s).rank)
    rng = np.random.default_rng(2)
    hits = []
    for _ in range(300):
        beta = rng.standard_normal(len(s))
        flat = of.motion.reshape(-1, len(s)) @ beta
        moved = np.sqrt(np.sum(flat**2) / len(of.motion))
        noise = p.project_out(rng.standard_normal((len(of.white), 1)))[:, 0]
        y = p.project_out((of.white @ beta * least.displacement_m / moved)[:, None])[:, 0] + noise
        b = np.linalg.lstsq(p.project_out(of.white), y, rcond=1e-5)[0]
        gain = float(y @ (p.project_out(of.white) @ b))
        rank = int(np.linalg.matrix_rank(s, tol=1e-4))
        ratio = (gain / rank) / ((float(y @ y) - gain) / (found.dof - rank))
        hits.append(f_distribution.sf(ratio, rank, found.dof - rank) < level)
    # Of equal rms displacement some directions are seen better than others: about 90 %.
    assert 0.75 < np.mean(hits) < 0.99
