"""What a campaign taught of an arm: as a posterior, beside another one, and as prior."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import hilcal as hc
from hilcal.campaign.revisions import restore, to_record
from hilcal.drivers.simulated.world import place_tracker
from hilcal.errors import CannotAnswerError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried.carried_prior import carried_prior
from hilcal.identification.carried.posterior import (
    Posterior,
    Source,
    parameter_differences,
    read_posterior,
)
from hilcal.identification.fit import fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.parameters_document import covariance_of
from hilcal.identification.prediction.predictive import predictive, predictive_of
from hilcal.present.fit import prior_lines
from hilcal.robot.catalogue import load_arm
from hilcal.store.codec import write_document
from hilcal.store.revision import from_text, to_text
from hilcal.store.rows import content_hash
from studies.change import measured as measured_again
from studies.change import remeasured, studied_arm
from tests.support.campaigns import campaign, configuration, measured, noiseless, plan, with_noise
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal


def of_links(seed=2):
    return campaign("link_geometry", "absolute", seed, poses=30, strength=2.0, target_known=False)


@cache
def fitted(*names):
    c = of_links()
    return fitted_model(c.cell, c.readings, "absolute", names)


def places(result, p):
    """Where the parameters of a posterior are in a fit."""
    names = [f"{e.name}.{q.name}" for e in result.model.effects for q in e.parameters]
    return [names.index(n) for n in p.names]


def test_the_setup_is_marginalised_out_and_a_misfit_widens_what_is_stated():
    """The geometry is missing in this model."""
    result = fitted("joint_compliance", "encoder_offset")
    assert {"base_frame", "target_offset"} < set(result.model.names)
    p = Posterior.of(result, Source("a.hilcal", 3))
    assert [e.name for e in p.effects] == ["joint_compliance", "encoder_offset"]
    # The whole covariance's part is the inverse of the Schur complement of the whole information:
    # that of a fit to readings whose noise has the misfit.
    used, s, rows = result.readings, result.solution, places(result, p)
    left_out = result.holdout.rms_sigma
    more = predictive(result.model, s.theta, s.prior, used, "absolute", left_out).excess
    assert more.position > 0
    wide = fit(result.model, more.of_readings(used, "absolute"), "absolute", start=s.theta)
    known = np.isfinite(p.std)
    ratio = p.std[known] / wide.uncertainty.formal[rows][known]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert ratio[0] > 1.0
    # A joint's zero that a turn of the base or the target hides is not known.
    assert not known[p.index("encoder_offset")].all()
    assert known[p.index("joint_compliance")].all()
    assert p.source.n_readings == len(result.readings)
    assert result.variance_factor > 1.2**2
    plain = np.sqrt(result.variance_factor) * result.uncertainty.formal[rows]
    assert (p.std[known] > plain[known]).all()


def test_it_comes_back_exactly(tmp_path):
    p = Posterior.of(fitted("joint_compliance", "transmission_error", "link_geometry"))
    again = Posterior.from_json(json.loads(json.dumps(p.to_json())))
    for name in ("mean", "information", "own_precision", "scale", "links", "prints"):
        np.testing.assert_array_equal(getattr(again, name), getattr(p, name))
    for name in ("arm", "mode", "effects", "names", "units", "scatter", "ranges", "source"):
        assert getattr(again, name) == getattr(p, name)
    write_document(tmp_path / "a.json", p.to_json())
    np.testing.assert_array_equal(read_posterior(tmp_path / "a.json").information, p.information)


def test_what_was_not_determined_has_no_information():
    p = Posterior.of(fitted("joint_compliance", "link_geometry"))
    geometry, frames = p.index("link_geometry"), [0, 1, 2]
    values, vectors = np.linalg.eigh(p.marginal(geometry) * 1e-6)
    assert abs(values[0]) < 1e-12 * values[-1]
    null = vectors[:, values < 1e-12 * values[-1]]
    # A shift of the first link is one of the base.
    np.testing.assert_allclose(np.linalg.norm(null[frames], axis=1), 1.0, atol=1e-3)
    assert np.isinf(p.std[geometry[frames]]).all()
    assert np.isfinite(p.std[p.index("joint_compliance")]).all()


def test_a_harmonic_that_was_dropped_is_not_known_to_be_zero():
    result = fitted("joint_compliance", "transmission_error")
    family = result.model.slices()[result.model.names.index("transmission_error")]
    dropped = np.flatnonzero(result.solution.prior[family] == 0)
    p = Posterior.of(result)
    std = p.std[p.index("transmission_error")][dropped]
    assert len(std)
    assert ((std > 0) & np.isfinite(std)).all()


def test_the_sizes_of_what_a_prior_knows_are_not_estimated_again():
    """As if they were, the band of 20 poses held all other poses, not 97.6 %."""
    c = of_links(seed=3)
    some = c.readings[c.readings.pose < 12]
    prior = carried_prior(Posterior.of(fitted("transmission_error")))
    of_prior = fit(baseline(c.cell, some, "absolute", prior=prior), some, "absolute")
    assert not predictive_of(of_prior).by_variances.size
    assert predictive_of(fitted("transmission_error")).by_variances.size


def test_what_is_no_posterior_is_refused():
    c = of_links()
    with pytest.raises(CannotAnswerError, match="no effect of the arm"):
        Posterior.of(fitted_model(c.cell, c.readings, "absolute", ()))
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance",))
    refusal("scaling gc", Posterior.of, fit(model, c.readings, "absolute", "none"))
    p = Posterior.of(fitted("joint_compliance")).to_json()
    damaged = {"version 9": {**p, "version": 9}, "damaged": {**p, "mean": [1.0]}, "format": {}}
    for words, content in damaged.items():
        refusal(words, Posterior.from_json, content)


@pytest.fixture(scope="module")
def arm():
    """An arm without errors of its links, so that two small models hold all there is."""
    config = configuration()
    arm = studied_arm(config, "ur10e", 3, poses=10)
    physics = arm.world.physics
    for name in ("link_geometry", "transmission_error"):
        physics = physics.with_effect(name, 0.0 * getattr(physics, name))
    return replace(arm, world=replace(arm.world, physics=physics))


def posterior(arm, seed, zero3=0.0):
    """Measure the arm by a tracker that stands anywhere, and fit it."""
    rng, physics = np.random.default_rng(seed), arm.world.physics
    registration, station = place_tracker(arm.cell, rng)
    physics = physics.with_effect("encoder_offset", physics.encoder_offset + zero3 * np.eye(6)[2])
    world = replace(arm.world, physics=physics, registration=registration, station=station)
    readings = measured_again(world, arm.loads[:1], 12, rng)
    model = hc.baseline(arm.cell, readings, readings="absolute") + hc.effect("encoder_offset")
    return Posterior.of(hc.fit(model, readings, readings="absolute"))


def test_two_campaigns_of_an_unchanged_arm_differ_by_their_uncertainty(arm):
    p = [posterior(arm, k) for k in range(8)]
    differences = [parameter_differences(*pair) for pair in zip(p[::2], p[1::2], strict=True)]
    z = np.array([r.z for d in differences for r in d.rows if r.z is not None])
    assert len(z) >= 40
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert min(e.p_value for d in differences for e in d.effects) > 1e-3
    # A zero that the tracker's place absorbs is not compared.
    of = {r.name: r.z for r in differences[0].rows}
    assert of["encoder_offset.j1"] is None
    assert of["encoder_offset.j3"] is not None


def test_a_change_is_seen_with_its_size_in_its_effect_alone(arm):
    d = parameter_differences(posterior(arm, 0), posterior(arm, 1, zero3=1e-3))
    (row,) = [r for r in d.rows if r.name == "encoder_offset.j3"]
    assert abs(row.difference - 1e-3) < 4 * row.std
    p = {e.effect: e.p_value for e in d.effects}
    assert p["encoder_offset"] < 1e-10
    assert p["joint_compliance"] > 1e-3


NAMES = ("joint_compliance", "encoder_offset", "joint_tilt_compliance")


@cache
def both():
    return campaign("joint_tilt_compliance", "absolute", 1, poses=40, registration_known=True)


def of_poses(first, last, prior=None):
    c = both()
    r = c.readings[(c.readings.pose >= first) & (c.readings.pose < last)]
    return fit(with_effects(c.cell, r, "absolute", NAMES, prior=prior), r, "absolute")


def learnt(last=25):
    return Posterior.of(of_poses(0, last))


def with_prior(readings, prior):
    return fit(baseline(both().cell, readings, "absolute", prior=prior), readings, "absolute")


def test_a_prior_and_new_readings_are_as_all_readings_together():
    p, together, alone = learnt(), of_poses(0, 40), of_poses(25, 40)
    still = replace(carried_prior(p), expected={e.name: 1e-9 for e in p.effects})  # no drift
    result, std = of_poses(25, 40, still), together.uncertainty.formal
    # The posterior is wider by what its own poses left out were off, here 1.1.
    np.testing.assert_allclose(result.uncertainty.formal, std, rtol=0.1)
    assert np.abs((result.theta - together.theta) / std).max() < 0.5
    assert result.dof > alone.dof + 5
    assert result.holdout.rms_m < alone.holdout.rms_m

    def correlation(of):
        covariance = covariance_of(of)
        std = np.sqrt(np.diag(covariance))
        return np.asarray(covariance / std / std[:, None])

    np.testing.assert_allclose(correlation(result), correlation(together), atol=0.1)


def test_the_order_of_the_effects_of_a_prior_does_not_matter():
    c, prior = both(), carried_prior(learnt())
    r = c.readings[c.readings.pose >= 25]
    models = [with_effects(c.cell, r, "absolute", n, prior=prior) for n in (NAMES, NAMES[::-1])]
    one, other = (fit(model, r, "absolute") for model in models)
    assert one.model.names != other.model.names
    assert one.chi2 == pytest.approx(other.chi2, rel=1e-3)
    of = [{p.name: p.value for p in result.parameters} for result in (one, other)]
    assert of[1] == pytest.approx(of[0], abs=1e-9)


@pytest.mark.long
def test_few_readings_tell_which_link_of_a_prior_has_moved():
    """Columns of the prior's gauge directions, tiny and without a prior, hid a slipped joint."""
    arm = studied_arm(configuration(), "ur10e", 0, poses=30)
    physics, prior = arm.world.physics, carried_prior(Posterior.of(arm.earlier.fit))
    zeros = physics.encoder_offset + 1.2e-3 * np.eye(6)[2]
    slipped = replace(arm.world, physics=physics.with_effect("encoder_offset", zeros))
    r = remeasured(slipped, arm.loads, 15, np.random.default_rng(2))
    result = fit(baseline(arm.cell, r, "absolute", prior=prior), r, "absolute")
    assert result.conflicts[0].group.part == "link3"
    assert result.conflicts[0].moved_sigma > 10
    assert result.variance_factor < 3


def test_a_prior_that_knows_nothing_changes_nothing():
    p, alone = learnt(), of_poses(25, 40)
    nothing = replace(p, information=np.zeros_like(p.information))
    result = of_poses(25, 40, carried_prior(nothing))
    np.testing.assert_allclose(result.theta, alone.theta, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(result.uncertainty.std, alone.uncertainty.std, rtol=1e-9)
    assert result.chi2 == pytest.approx(alone.chi2, rel=1e-9)
    assert result.dof == pytest.approx(alone.dof, rel=1e-12)
    # Without a fold flat parameters shrink: towards zero, or the mean of the prior.
    assert result.holdout.rms_m == pytest.approx(alone.holdout.rms_m, rel=1e-3)


@cache
def repaired():
    """Another campaign, after joint 3 became half as stiff again."""
    world = both().world
    softer = world.physics.joint_compliance * np.array([1, 1, 1.5, 1, 1, 1])
    world = replace(world, physics=world.physics.with_effect("joint_compliance", softer))
    r = measured(world, plan(15, 77), np.random.default_rng(5))
    return with_prior(r, carried_prior(learnt(40)))


def test_the_joint_that_moved_is_found_and_let_go():
    result = repaired()
    worst = result.conflicts[0]
    assert (worst.group.effect, worst.group.joint) == ("joint_compliance", 3)
    assert worst.moved_sigma > 6
    assert worst.drift > 0.1
    assert result.model.prior.relation == "arm"  # one part has moved
    others = [c.p_value for c in result.conflicts[1:]]
    assert min(others) > 1e-3 / len(others)
    truth = 1.5 * both().world.physics.joint_compliance[2]
    value = result.parameters["joint_compliance.j3"].value
    assert value == pytest.approx(truth, rel=0.15)
    document = to_json(result)["prior"]
    assert document["source"]["n_readings"] == len(both().readings)
    assert document["effects"][0]["joint"] == 3
    _, worst_line, *_, cause = prior_lines(result)  # a moved target looks like the last link
    assert worst_line.startswith("  joint 3's joint compliance is ")
    assert cause.endswith("hilcal compare EARLIER LATER says what has changed.")


def test_without_a_change_nothing_has_moved():
    clean, prior = noiseless(both().world, plan(15, 78)), carried_prior(learnt(40))
    fits = [with_prior(with_noise(clean, np.random.default_rng(s)), prior) for s in range(4)]
    p_values = [x.p_value for result in fits for x in result.conflicts]
    assert min(p_values) > 1e-4
    assert 0.25 < float(np.median(p_values)) < 0.75


def test_a_revision_keeps_its_prior():
    result = repaired()
    r = result.readings
    text = to_text(to_record(result, None, None, content_hash(r)))
    again = restore(from_text(text, 1), both().cell, r)
    np.testing.assert_allclose(again.theta, result.theta, rtol=1e-6, atol=1e-10)
    np.testing.assert_array_equal(again.model.prior.drift, result.model.prior.drift)
    assert again.dof == pytest.approx(result.dof, rel=1e-6)
    np.testing.assert_allclose(again.uncertainty.std, result.uncertainty.std, rtol=1e-4)


def test_another_arm_of_the_type_may_differ_by_more():
    p = learnt()
    same, other = (
        of_poses(25, 40, carried_prior(p, relation)).uncertainty.formal
        for relation in ("arm", "type")
    )
    assert (other >= same * 0.999).all()
    assert other.sum() > 1.05 * same.sum()
    assert carried_prior(p, stated={"encoder_offset": 0.7}).least["encoder_offset"] == 0.7


@pytest.mark.slow
def test_a_prior_that_is_of_another_arm_is_taken_as_such():
    """Drifts of a few parts would imitate the other arm at the measured poses alone."""
    known, rng = Posterior.of(fitted("joint_compliance", "link_geometry")), np.random.default_rng(4)
    other, p = of_links(), plan(10, 79)
    softer = other.world.physics.joint_compliance * rng.uniform(0.6, 1.6, 6)
    physics = other.world.physics.with_effect("joint_compliance", softer)
    physics = physics.with_effect("link_geometry", 5e-4 * rng.standard_normal((7, 6)))
    few = measured(replace(other.world, physics=physics), p, rng)
    result = fit(baseline(other.cell, few, "absolute", prior=carried_prior(known)), few, "absolute")
    assert (result.model.prior.relation, result.model.prior.by_readings) == ("type", True)
    assert "The readings say so" in "".join(prior_lines(result))


def test_priors_that_cannot_be_are_refused():
    c, p = both(), learnt()
    later = c.readings[c.readings.pose > 30]
    fewer, ur3e = replace(p, links=p.links[:-1]), replace(c.cell, arm=load_arm("ur3e"))
    for of, cell, readings, words in (
        (p, c.cell, c.readings, "count twice"),
        (p, ur3e, later, "differ"),
        (fewer, c.cell, later, "joints"),
    ):
        refusal(words, baseline, cell, readings, "absolute", prior=carried_prior(of))
    foreign = replace(p, effects=(replace(p.effects[0], name="cable_pull"),))
    for of, given, words in (
        (p, {"relation": "cousin"}, "arm, type"),
        (p, {"stated": {"creep": 1.0}}, "drift of creep"),
        (foreign, {}, "--effects-from"),
    ):
        refusal(words, carried_prior, of, **given)
