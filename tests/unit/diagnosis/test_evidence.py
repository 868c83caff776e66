"""Whether the catalogue suffices, what speaks against effects; additions reconsidered."""

from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hilcal.diagnosis.effect_ranking import candidates
from hilcal.diagnosis.evidence import (
    REDUNDANCY_LEVEL,
    backward_elimination,
    model_columns,
    significant,
)
from hilcal.diagnosis.stepwise import add, exchange, remove, trial
from hilcal.diagnosis.verdict import IMITATION, diagnose
from hilcal.drivers.simulated.injected_effects import hide_effect
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification import linearisation as columns_module
from hilcal.identification.baseline import baseline
from hilcal.identification.carried.carried_prior import carried_prior, names_of
from hilcal.identification.carried.drift import carried_effects, evidence_of_carried
from hilcal.identification.carried.posterior import Posterior
from hilcal.identification.fit import fit
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.linearisation import columns_of_each, eliminate_effect
from hilcal.present.verdict import message
from hilcal.refinement import Path, refine
from hilcal.regression.evidence import NO_EVIDENCE
from hilcal.regression.forward_selection import CandidateFamilies
from hilcal.robot.chain import evaluate
from tests.support.campaigns import NO_EFFECT, campaign, measured, plan, world_of
from tests.support.diagnosis_cases import fitted_baseline, studied
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal


@pytest.mark.long
@pytest.mark.parametrize("seeds", [(0,), pytest.param((1, 2, 3), marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("mode", "law", "variable"),
    [
        ("deflection", "relaxing bench", "time under load"),
        ("absolute", "swaying bench", "air temperature"),
        ("absolute", "coupled joint", "joint 2 torque"),
    ],
)
def test_a_law_that_only_resembles_an_effect_is_unknown(mode, law, variable, seeds):
    """Few readings name a suspect only where it explains most; then the catalogue is tried."""
    led = 0
    for seed, poses in product(seeds, (30, 110)):
        d = diagnose(studied(mode, law, seed=seed, n_poses=poses))
        assert d.verdict == "unknown_effect", (seed, message(d))
        assert variable in [c.variable for c in d.dependences[:2]]
        led += d.lead is not None
        resembles = d.lead is not None or d.suspects[0].refuted
        assert ("may only resemble the missing effect" in message(d)) == resembles
        if d.lead is not None:
            assert poses == 110 or d.lead.holdout_share > IMITATION
            check_insufficiency(d)
    assert led > 0


def check_insufficiency(d):
    i = d.insufficiency
    assert d.reason == "insufficient_catalogue"
    assert d.suspects[0].effect in message(d)
    assert 0.02 < i.share < 1.0
    assert i.variance_factor > 1.0
    assert 0 <= i.refitted <= len(i.effects)
    assert d.separability == ()
    assert d.to_dict()["beyond"] == {
        "effects": list(i.effects),
        "refitted": i.refitted,
        "share": i.share,
        "variance_factor": i.variance_factor,
    }


@pytest.mark.parametrize(
    ("mode", "effects"),
    [
        # turns a lever: far from linear
        pytest.param("deflection", ("creep", "load_point"), marks=pytest.mark.long),
        ("absolute", ("link_geometry",)),
        ("absolute", ("encoder_offset", "load_point")),
        pytest.param("deflection", ("link_compliance",), marks=pytest.mark.slow),
        pytest.param(
            *("deflection", ("sensor_misalignment", "joint_tilt_compliance")),
            marks=pytest.mark.slow,
        ),
        pytest.param("absolute", ("hysteresis", "link_mass"), marks=pytest.mark.slow),
    ],
)
def test_effects_of_the_catalogue_explain_all(mode, effects):
    d = diagnose(studied(mode, *effects))
    assert d.verdict in ("missing_effect", "ambiguous")
    assert d.insufficiency is None


@pytest.fixture(scope="module")
def shared():
    c = campaign("hysteresis", "deflection", poses=12)
    return add(fitted_baseline(c), "encoder_offset")


@pytest.mark.parametrize("together", [0, 20_000, 8_000_000])
def test_columns_of_several_effects_are_those_of_each(shared, together, monkeypatch):
    monkeypatch.setattr(columns_module, "MOST_AT_ONCE", together)
    effects = candidates(shared)
    s, w = shared.solution, shared.whitening
    for effect, of in zip(effects, columns_of_each(shared, effects), strict=True):
        assert of.effect is effect
        jacobian = shared.model.jacobian_of((effect,), s.prediction, s.theta, w.m) * of.scale
        unloaded = jacobian[shared.readings.unloaded, :3]
        np.testing.assert_allclose(of.unloaded_motion, unloaded, rtol=1e-11, atol=1e-15)
        motion = w.raw(jacobian)[:, :3]
        np.testing.assert_allclose(of.motion, motion, rtol=1e-11, atol=1e-15)
        white = w.whiten_readings(jacobian)
        atol = 1e-12 * np.abs(white).max(initial=0.0)
        np.testing.assert_allclose(of.white, white, rtol=1e-9, atol=atol)


HIDDEN = "joint_tilt_compliance"
NAMES = ("joint_compliance", HIDDEN)


@cache
def before():
    """A campaign of an arm whose joints tilt, and what it taught."""
    c = campaign(HIDDEN, "absolute", 1, poses=20, registration_known=True)
    fitted = fitted_model(c.cell, c.readings, "absolute", NAMES)
    return c, carried_prior(Posterior.of(fitted))


@cache
def later(*, repaired, poses):
    c, _ = before()
    physics = c.world.physics
    if repaired:
        stiff = np.zeros_like(getattr(physics, HIDDEN))
        physics = physics.with_effect(HIDDEN, stiff)
    world = replace(c.world, physics=physics)
    return measured(world, plan(poses, 91), np.random.default_rng(7))


def with_prior(*, repaired, poses=10):
    c, prior = before()
    r = later(repaired=repaired, poses=poses)
    return fit(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")


def test_the_evidence_is_the_ratio_of_normal_densities_of_the_readings():
    """Against the densities written out, flat parameters with a wide prior instead."""
    fitted = with_prior(repaired=True, poses=3)
    model, s, p = fitted.model, fitted.solution, before()[1].posterior
    assert carried_effects(model) == (HIDDEN,)
    a = whitened_jacobian(model, s.prediction, s.theta, fitted.whitening, np.arange(model.size))
    y = s.white + a @ s.theta
    drift = model.prior.drift if model.prior is not None else np.zeros(0)
    c = (1 + drift[0] ** 2) * np.linalg.inv(p.information)
    of = carried_prior(p)
    c += np.diag((drift[1:][of.group] * of.unit) ** 2)

    def density(names):
        mean, cov = np.zeros(len(y)), s.beta * np.eye(len(y))
        kept = [k for k, name in enumerate(p.names) if name.split(".")[0] in names]
        columns = [list(names_of(model)).index(p.names[k]) for k in kept]
        mean = a[:, columns] @ p.mean[kept]
        cov += a[:, columns] @ c[np.ix_(kept, kept)] @ a[:, columns].T
        flat = np.delete(a, [list(names_of(model)).index(n) for n in p.names], axis=1)
        cov += 1e4**2 * flat @ flat.T
        return float(multivariate_normal(mean, cov).logpdf(y))

    expected = density(("joint_compliance", HIDDEN)) - density(("joint_compliance",))
    evidence = evidence_of_carried(model, s, fitted.whitening, (HIDDEN,))[HIDDEN]
    assert evidence == pytest.approx(expected, rel=1e-3)
    assert abs(expected) > 1


def test_refine_takes_a_repaired_effect_out_and_leaves_one_that_is_there():
    for repaired in (True, False):
        c, prior = before()
        r = later(repaired=repaired, poses=10)
        path = refine(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")
        assert (HIDDEN in path.fit.model.names) is not repaired
        assert [s.removed for s in path.steps if s.removed] == ([HIDDEN] if repaired else [])
        assert path.verdict == "adequate"


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
        fitted = fitted_baseline(c, *effects)
        judged = {n: score.p_value for n, score in backward_elimination(fitted).items()}
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


def test_an_effect_of_as_many_columns_as_readings_is_not_called_needless():
    c = campaign(NO_EFFECT, "absolute", 10, poses=26)
    r = c.readings[np.unique(c.readings.pose, return_index=True)[1]]
    q, cell = r.states.q, c.cell
    gears = evaluate(cell.arm, q + 2e-4 * np.sin(q + np.arange(6)))
    moved = gears.point(cell.target[:3, 3]) - evaluate(cell.arm, q).point(cell.target[:3, 3])
    r = replace(r, value=r.value + moved @ cell.registration[:3, :3].T)
    fitted = fitted_baseline(c, "link_geometry", "transmission_error", readings=r)
    score = eliminate_effect(fitted, model_columns(fitted), "transmission_error").score()
    assert score.p_value > REDUNDANCY_LEVEL  # 51 columns of 78 numbers
    assert backward_elimination(fitted) == {}


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


def test_an_exchange_needs_an_effect_that_is_there_and_one_that_is_not():
    fitted = fitted_baseline(campaign(NO_EFFECT, "deflection", 1), "backlash")
    for changed in (
        lambda: remove(fitted, "hysteresis"),
        lambda: exchange(fitted, "hysteresis", "creep"),
    ):
        refusal("hysteresis is not in the model", changed)
    with pytest.raises(InputError, match="joint_compliance is in the model already"):
        exchange(fitted, "backlash", "joint_compliance")


def test_a_family_that_fails_its_test_hides_no_other(monkeypatch):
    """A large one may have the most evidence, and a p-value that is not significant."""
    tests = {"large": (26.5, 0.0026), "small": (13.5, 1e-6), "none": (-1.0, 0.5)}
    score = {
        name: replace(NO_EVIDENCE, log_evidence=evidence, p_value=p, ridge=1.0)
        for name, (evidence, p) in tests.items()
    }
    monkeypatch.setattr(CandidateFamilies, "scores", lambda f: {n: score[n] for n in f.columns})
    columns = {name: slice(k, k + 1) for k, name in enumerate(tests)}
    families = CandidateFamilies(np.eye(3), np.ones(3), 100.0, 50.0, columns)
    assert [step.name for step in significant(families)] == ["small"]
