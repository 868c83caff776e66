"""Refinement: effect by effect, until the held-out error lies on the noise floor."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from hilcal import refinement
from hilcal.diagnosis.background_evidence import background_is_better
from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.stepwise import add
from hilcal.drivers.simulated.injected_effects import (
    hide_effect,
)
from hilcal.drivers.simulated.world import place_tracker
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.model.model import Model
from hilcal.numbers import percent
from hilcal.present.story import prior_report
from hilcal.present.verdict import message
from hilcal.refinement import BACKGROUND, MOST_REVISIONS, PRIOR, Path, refine, refine_from
from hilcal.regression.leave_out import LEAST_GAIN
from studies.random_campaigns import rehearsal_states
from tests.support.campaigns import (
    CampaignPlan,
    campaign,
    cell_of,
    configuration,
    measured,
    plan,
    world_of,
    world_with_gears,
)
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.effect_cases import make
from tests.support.fit_cases import fitted_model, refined
from tests.support.reflector_cases import each_target, plate
from tests.support.refusals import refusal
from tests.support.rows import first


def check_steps(r):
    """What holds of every refinement; with a background, of the steps before it."""
    assert 1 <= len(r.steps) <= MOST_REVISIONS
    assert r.steps[0].added is None
    alone = [s for s in r.steps if not s.fit.model.background]
    for before, after in pairwise(alone):
        assert after.fit.model.names == (*before.fit.model.names, after.added)
        assert after.added in before.diagnosis.significant
        held = [s.fit.holdout.rms_sigma for s in (before, after)]
        assert held[1] < (1 - LEAST_GAIN) * held[0]
        assert after.fit.readings is before.fit.readings
    with_all = r.steps[len(alone) :]
    if with_all:
        assert with_all[0].added == BACKGROUND
        assert all(s.fit.model.background for s in with_all)
        assert background_is_better(alone[-1].fit, with_all[0].fit)
    assert set(r.rejected).isdisjoint(r.steps[-1].fit.model.named)


@pytest.mark.parametrize(
    ("effect", "mode"),
    first(1, [("encoder_offset", "absolute"), ("joint_stiffening", "deflection")]),
)
def test_a_hidden_effect_is_added_and_the_error_falls_to_the_noise(effect, mode):
    c = campaign(effect, mode, 1, poses=30)
    said = []
    r = refine(baseline(c.cell, c.readings, mode), c.readings, mode, said.append)
    check_steps(r)
    assert effect in r.steps[-1].fit.model.names
    assert r.verdict in ("adequate", "ambiguous"), message(r.diagnosis)
    first, last = r.steps[0].fit, r.steps[-1].fit
    assert last.holdout.rms_sigma < 0.6 * first.holdout.rms_sigma
    # On poses left out: the noise, and what the parameters cost.
    cost = np.sqrt(1 + 2 * last.rank / last.whitening.rank)
    assert last.holdout.rms_sigma < cost * (1 + 4 / np.sqrt(2 * last.dof))
    assert f"adding {effect}" in said


@pytest.mark.long
def test_two_hidden_effects_are_found_one_after_the_other():
    cell, p = cell_of(), plan(30, 5)
    rng = np.random.default_rng(5)
    world = world_of(cell, rng)
    for effect in ("hysteresis", "encoder_offset"):
        world = hide_effect(effect, cell, p.states, 3.0, "absolute", rng, world=world)
    readings = measured(world, p, rng)
    r = refined(cell, readings, "absolute")
    check_steps(r)
    assert {s.added for s in r.steps[1:]} == {"hysteresis", "encoder_offset"}
    assert r.verdict == "adequate", message(r.diagnosis)
    assert 0.7 < r.steps[-1].fit.variance_factor < 1.35


def test_a_suspect_that_passes_beside_shrunk_lines_is_added(monkeypatch):
    """Separate lines of a gear may hide it; it was named as missing, and never added."""
    cell, p, rng = cell_of(), plan(30, 5), np.random.default_rng(5)
    world = world_of(cell, rng)
    for effect in ("transmission_error", "encoder_offset"):
        world = hide_effect(effect, cell, p.states, 3.0, "absolute", rng, world=world)
    readings, complete, calls = measured(world, p, rng), Path.complete, []

    def with_lines_first(path):
        calls.append(path)
        if len(calls) > 1:
            complete(path)
        else:
            path.append(add(path.steps[-1].fit, "transmission_error"), "transmission_error")

    monkeypatch.setattr(Path, "complete", with_lines_first)
    r = refine_from(fit(baseline(cell, readings, "absolute"), readings, "absolute"))
    assert len(calls) == 2
    assert "transmission_error" in r.steps[1].fit.model.random
    assert "encoder_offset" in [s.added for s in r.steps]
    assert not any(s.passes for s in r.diagnosis.suspects)


@pytest.mark.long
def test_what_the_whole_catalogue_leaves_is_told_of_the_earlier_steps():
    c = campaign("encoder_offset", "absolute", 2, poses=15)
    states, value = c.readings.states, c.readings.value.copy()
    pull = np.linalg.norm(states.wrench[:, :3], axis=1)
    value[:, 1] += 2e-6 * pull * np.sin(2 * states.q[:, 1] + states.q[:, 2])  # outside all effects
    readings, judged = replace(c.readings, value=value), []
    r = refine(
        baseline(c.cell, readings, "absolute"), readings, "absolute",
        on_step=judged.append, background=False,
    )  # fmt: skip
    first, last = (s.diagnosis for s in (r.steps[0], r.steps[-1]))
    assert judged[0].diagnosis.verdict in ("missing_effect", "ambiguous")
    assert first.verdict == last.verdict == "unknown_effect"
    assert f"leave {percent(first.insufficiency.share)} of it" in message(first)
    assert first.insufficiency.effects == r.steps[-1].fit.model.named[-1:]
    left = last.fit.chi2 - last.fit.dof
    assert first.insufficiency.share == pytest.approx(left / (first.fit.chi2 - first.fit.dof))


def test_nothing_hidden_adds_nothing():
    c = campaign(seed=2, poses=15)
    r = refined(c.cell, c.readings, "absolute")
    assert len(r.steps) == 1
    assert r.verdict == "adequate"
    assert r.rejected == ()
    assert r.diagnosis is r.steps[0].diagnosis


def with_pose_errors(readings, seed):
    """Readings with an error per pose that follows nothing: no effect explains it elsewhere."""
    rng = np.random.default_rng(seed)
    off = 1e-4 * rng.normal(size=(len(readings.pose_names), 3))[readings.pose]
    return replace(readings, value=readings.value + off)


@pytest.mark.long
@pytest.mark.parametrize(
    ("poses", "seed"),
    [(15, 1), *(pytest.param(*other, marks=pytest.mark.slow) for other in ((15, 2), (30, 1)))],
)
def test_what_no_effect_predicts_is_never_called_adequate(poses, seed):
    """A large family can reproduce any error of few poses; poses left out tell."""
    c = campaign(seed=3, plan_seed=0, poses=poses)
    readings = with_pose_errors(c.readings, seed)
    r = refined(c.cell, readings, "absolute")
    check_steps(r)
    assert r.steps[-1].fit.holdout.rms_sigma > 3
    # Few poses cannot tell an error of each pose from a family with many parameters.
    assert r.verdict in ("unknown_effect", "noise_misjudged", "ambiguous"), message(r.diagnosis)


def test_shares_on_poses_left_out_are_what_a_refit_reaches_there():
    """Random errors of each pose: a family of many columns explains them, but nowhere else."""
    c = campaign(seed=3, plan_seed=0, poses=15)
    readings = with_pose_errors(c.readings, 1)
    before = fitted_model(c.cell, readings, "absolute")
    p = linearise(before)
    some = ("transmission_error", "link_geometry", "encoder_offset")
    suspects = [s for s in rank_suspects(p, candidates(p.fit)) if s.effect in some]
    assert len(suspects) == len(some)
    for s in suspects:
        after = add(before, s.effect)
        squares = [np.sum(f.whitening.whiten(f.left_out) ** 2) for f in (before, after)]
        reached = (squares[0] - squares[1]) / squares[0]
        assert s.holdout_share < max(reached, 0) + 0.3, (s.effect, s.holdout_share, reached)


def test_adding_starts_where_the_fit_stands():
    c = campaign("hysteresis", seed=0, plan_seed=0)
    before = fitted_baseline(c)
    after = add(before, "hysteresis")
    again = fit(after.model, c.readings, "absolute")
    assert np.abs((after.theta - again.theta) / after.uncertainty.formal).max() < 1e-4
    assert after.chi2 == pytest.approx(again.chi2, rel=1e-7)
    assert after.chi2 < before.chi2


def test_an_effect_cannot_be_added_twice_nor_without_its_columns_nor_unknown():
    c = campaign(plan_seed=0)
    readings = replace(c.readings, states=replace(c.readings.states, approach=None))
    fitted = fitted_model(c.cell, readings, "absolute")
    refusal("joint_compliance is in the model already", add, fitted, "joint_compliance")
    refusal("unknown effect 'gear_wear'", add, fitted, "gear_wear")
    refusal("hysteresis needs approach", add, fitted, "hysteresis")


def test_it_starts_from_any_model():
    """Also from frames alone: joint compliance is then an effect like others."""
    c = campaign(seed=6, poses=20)
    start = baseline(c.cell, c.readings, "absolute")
    frames = Model(start.cell, (make("base_frame", start.cell, c.readings.states),))
    r = refine(frames, c.readings, "absolute")
    check_steps(r)
    assert r.steps[1].added == "joint_compliance"
    assert r.verdict == "adequate", message(r.diagnosis)


def test_a_prior_of_another_arm_is_left_out():
    old = campaign("transmission_error", "absolute", 2, poses=15, strength=20.0)
    new = campaign("encoder_offset", "absolute", 3, poses=12, strength=20.0)
    names = ("joint_compliance", "transmission_error")
    prior = carried_prior(Posterior.of(fitted_model(old.cell, old.readings, "absolute", names)))
    model = baseline(new.cell, new.readings, "absolute", prior=prior)
    r = refine(model, new.readings, "absolute", background=False)
    last_with = r.steps[[s.removed for s in r.steps].index(PRIOR) - 1].fit
    assert last_with.contradictions
    assert r.fit.model.prior is None
    assert r.names == ("base_frame", *names, "encoder_offset")
    assert r.fit.holdout.rms_m < 0.1 * last_with.holdout.rms_m
    assert "The prior was left out" in prior_report(r)[-1]


@pytest.mark.long
def test_a_background_that_cannot_be_tested_leaves_the_revisions(monkeypatch):
    """The whole refinement ended with "the mixed model's equations have no solution"."""

    def unsolved(fitted):
        raise CannotAnswerError("the mixed model's equations have no solution")

    c = campaign("transmission_error", seed=1)
    said = []
    path = Path(fitted_model(c.cell, c.readings, c.mode), say=said.append)
    monkeypatch.setattr(refinement, "background_is_better", lambda before, after: True)
    monkeypatch.setattr(refinement, "allows_background", lambda fitted: True)
    monkeypatch.setattr(refinement, "background_evidence", unsolved)
    assert not path.add_background()
    assert len(path.steps) == 1
    assert "the background is left out" in said[-1]


@pytest.mark.long
def test_a_fit_that_has_used_up_its_readings_proves_no_unknown_effect():
    """A coupling of joints fits 15 poses of three targets in place of the waves of gears."""
    cell, rng = plate(), np.random.default_rng([2, 911])
    world = world_with_gears(cell, rng)
    registration, station = place_tracker(cell, rng)
    world = replace(world, registration=registration, station=station)
    rng.standard_normal(9)  # so that the campaign is the one in which it was seen
    loads = [(load.name, load.wrench(cell.gravity)) for load in configuration().loads[:1]]
    p = CampaignPlan(*rehearsal_states(cell, 15, loads, rng), ("none", loads[0][0]))
    some = measured(world, each_target(p), rng, 6)
    last = refine(baseline(cell, some, "absolute"), some, "absolute")
    before = next(
        s for s in last.steps if s.fit.is_saturated and s.diagnosis.reason == "no_suspect"
    )
    assert last.fit.model.background
    assert last.fit.holdout.rms_m < before.fit.holdout.rms_m
