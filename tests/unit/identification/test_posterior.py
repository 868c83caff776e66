"""What a campaign taught of an arm: as a posterior, beside another one, and as prior."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import hilcal as hc
from hilcal.calibration.calibration import Calibration
from hilcal.campaign.revisions import restore, to_record
from hilcal.config import load_config
from hilcal.diagnosis.stepwise import add, remove
from hilcal.drivers.simulated.world import stand
from hilcal.effects.catalogue import installed
from hilcal.errors import CannotAnswerError, InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.posterior import Differences, Posterior, Source, parameter_differences
from hilcal.identification.posterior_document import read, write
from hilcal.identification.predictive import predictive
from hilcal.readings.same_readings import among
from hilcal.robot.catalogue import configs_dir, load_arm
from hilcal.store.revision import from_text, to_text
from hilcal.store.rows import content_hash
from studies.change import StudiedArm, studied_arm
from studies.change import measured as measured_again
from tests.support.campaigns import Campaign, campaign, measured, noiseless, plan, with_noise
from tests.support.fit_cases import based


@cache
def fitted(*names: str) -> Fit:
    c = campaign("link_geometry", "absolute", 2, poses=30, strength=2.0, target_known=False)
    return based(c.cell, c.readings, "absolute", names)


def test_the_setup_is_marginalised_out() -> None:
    found = fitted("joint_compliance", "encoder_offset")
    assert {"base_frame", "target_offset"} < set(found.model.names)
    p = Posterior.of(found, Source("a.hilcal", 3))
    assert [e.name for e in p.effects] == ["joint_compliance", "encoder_offset"]
    names = [f"{e.name}.{q.name}" for e in found.model.effects for q in e.parameters]
    mine = [names.index(n) for n in p.names]
    # The whole covariance's part is the inverse of the Schur complement of the whole information:
    # that of a fit to readings whose noise has the misfit, since the geometry is missing here.
    used, s = found.readings, found.solution
    left_out = found.holdout.rms_sigma
    more = predictive(found.model, s.theta, s.prior, used, "absolute", left_out).excess
    assert more.position > 0
    wide = fit(found.model, more.of_readings(used, "absolute"), "absolute", start=s.theta)
    std, seen = wide.uncertainty.formal[mine], np.isfinite(p.std)
    ratio = p.std[seen] / std[seen]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-3)
    assert ratio[0] > 1.0
    # A joint's zero that a turn of the base or the target hides is not known.
    assert not seen[p.index("encoder_offset")].all()
    assert seen[p.index("joint_compliance")].all()
    assert p.source.n_readings == len(found.readings)


def test_a_misfit_widens_what_is_stated() -> None:
    """The geometry is missing in this model."""
    found = fitted("joint_compliance", "encoder_offset")
    p = Posterior.of(found)
    names = [f"{e.name}.{q.name}" for e in found.model.effects for q in e.parameters]
    std = found.uncertainty.formal[[names.index(n) for n in p.names]]
    seen = np.isfinite(p.std)
    assert found.variance_factor > 1.2**2
    assert (p.std[seen] > np.sqrt(found.variance_factor) * std[seen]).all()


def test_it_comes_back_exactly(tmp_path: Path) -> None:
    p = Posterior.of(fitted("joint_compliance", "transmission_error", "link_geometry"))
    again = Posterior.from_json(json.loads(json.dumps(p.to_json())))
    for name in ("mean", "information", "own_precision", "scale", "links", "prints"):
        np.testing.assert_array_equal(getattr(again, name), getattr(p, name))
    for name in ("arm", "mode", "effects", "names", "units", "scatter", "ranges", "source"):
        assert getattr(again, name) == getattr(p, name)
    path = tmp_path / "a.json"
    write(p, path)
    np.testing.assert_array_equal(read(path).information, p.information)


def test_what_was_not_determined_has_no_information() -> None:
    p = Posterior.of(fitted("joint_compliance", "link_geometry"))
    geometry = p.index("link_geometry")
    information = p.marginal(geometry) * 1e-6
    values, vectors = np.linalg.eigh(information)
    assert abs(values[0]) < 1e-12 * values[-1]
    null = vectors[:, values < 1e-12 * values[-1]]
    # A shift of the first link is one of the base.
    frames = [0, 1, 2]
    np.testing.assert_allclose(np.linalg.norm(null[frames], axis=1), 1.0, atol=1e-3)
    assert np.isinf(p.std[geometry[frames]]).all()
    assert np.isfinite(p.std[p.index("joint_compliance")]).all()


def test_a_harmonic_that_was_dropped_is_not_known_to_be_zero() -> None:
    found = fitted("joint_compliance", "transmission_error")
    family = found.model.slices()[found.model.names.index("transmission_error")]
    dropped = np.flatnonzero(found.solution.prior[family] == 0)
    assert len(dropped)
    p = Posterior.of(found)
    std = p.std[p.index("transmission_error")][dropped]
    assert (std > 0).all()
    assert np.isfinite(std).all()


def test_its_readings_are_known_again() -> None:
    found = fitted("joint_compliance")
    p = Posterior.of(found)
    assert among(found.readings[5:9], p.prints).all()
    other = campaign("link_geometry", "absolute", 3, poses=30, strength=2.0, target_known=False)
    assert not among(other.readings, p.prints).any()


def test_what_is_no_posterior_is_refused() -> None:
    c = campaign("link_geometry", "absolute", 2, poses=30, strength=2.0, target_known=False)
    bare = based(c.cell, c.readings, "absolute", ())
    with pytest.raises(CannotAnswerError, match="no effect of the arm"):
        Posterior.of(bare)
    model = with_effects(c.cell, c.readings, "absolute", ("joint_compliance",))
    with pytest.raises(InputError, match="scaling gc"):
        Posterior.of(fit(model, c.readings, "absolute", "none"))
    p = Posterior.of(fitted("joint_compliance")).to_json()
    for damaged, words in (
        ({}, "format"),
        ({**p, "version": 9}, "version 9"),
        ({**p, "mean": [1.0]}, "damaged"),
    ):
        with pytest.raises(InputError, match=words):
            Posterior.from_json(damaged)


def test_every_effect_says_whose_it_is() -> None:
    setup = {kind.name for kind in installed().effects if kind.of_setup}
    assert {"base_frame", "target_offset", "tracker_drift", "wrench_bias", "load_point"} <= setup
    assert not {"joint_compliance", "link_geometry", "transmission_error"} & setup


CONFIG = load_config(configs_dir() / "cells" / "demo_ur10e.toml")
EFFECTS = ("encoder_offset", "joint_compliance")


@pytest.fixture(scope="module")
def arm() -> StudiedArm:
    """An arm without errors of its links, so that two small models hold all there is."""
    arm = studied_arm(CONFIG, "ur10e", 3, poses=10)
    physics = arm.world.physics
    for name in ("link_geometry", "transmission_error"):
        physics = physics.with_effect(name, 0.0 * getattr(physics, name))
    return replace(arm, world=replace(arm.world, physics=physics))


def posterior(arm: StudiedArm, seed: int, zero3: float = 0.0) -> Posterior:
    """Measure the arm by a tracker that stands anywhere, and fit it."""
    rng = np.random.default_rng(seed)
    registration, station = stand(arm.cell, rng)
    offset = arm.world.physics.encoder_offset + zero3 * np.eye(6)[2]
    physics = arm.world.physics.with_effect("encoder_offset", offset)
    world = replace(arm.world, physics=physics, registration=registration, station=station)
    readings = measured_again(world, arm.loads[:1], 12, rng)
    model = hc.baseline(arm.cell, readings, readings="absolute") + hc.effect("encoder_offset")
    return Posterior.of(hc.fit(model, readings, readings="absolute"))


def by_name(d: Differences) -> dict[str, float | None]:
    return {r.name: r.z for r in d.rows}


def test_two_campaigns_of_an_unchanged_arm_differ_by_their_uncertainty(arm: StudiedArm) -> None:
    found = [
        parameter_differences(posterior(arm, 2 * k), posterior(arm, 2 * k + 1)) for k in range(4)
    ]
    z = np.array([r.z for d in found for r in d.rows if r.z is not None])
    assert len(z) >= 40
    assert 0.6 < np.sqrt(np.mean(z**2)) < 1.4
    assert min(e.p_value for d in found for e in d.effects) > 1e-3


def test_a_zero_that_the_trackers_place_absorbs_is_not_compared(arm: StudiedArm) -> None:
    d = by_name(parameter_differences(posterior(arm, 0), posterior(arm, 1)))
    assert d["encoder_offset.j1"] is None
    assert d["encoder_offset.j3"] is not None


def test_a_change_is_seen_with_its_size_in_its_effect_alone(arm: StudiedArm) -> None:
    d = parameter_differences(posterior(arm, 0), posterior(arm, 1, zero3=1e-3))
    (row,) = [r for r in d.rows if r.name == "encoder_offset.j3"]
    assert row.std is not None
    assert abs(row.difference - 1e-3) < 4 * row.std
    p = {e.effect: e.p_value for e in d.effects}
    assert p["encoder_offset"] < 1e-10
    assert p["joint_compliance"] > 1e-3


def test_effects_that_one_fit_lacks_are_named(arm: StudiedArm) -> None:
    one = posterior(arm, 0)
    mine = one.index("joint_compliance")
    less = replace(
        one,
        names=tuple(one.names[k] for k in mine),
        units=tuple(one.units[k] for k in mine),
        scale=one.scale[mine],
        mean=one.mean[mine],
        information=one.marginal(mine),
        own_precision=one.own_precision[mine],
    )
    d = parameter_differences(one, less)
    assert d.apart == ("encoder_offset",)
    assert {r.name.split(".")[0] for r in d.rows} == {"joint_compliance"}


NAMES = ("joint_compliance", "encoder_offset", "joint_tilt_compliance")


@cache
def both() -> Campaign:
    return campaign("joint_tilt_compliance", "absolute", 1, poses=40, registration_known=True)


def of_poses(first: int, last: int) -> Fit:
    c = both()
    r = c.readings[(c.readings.pose >= first) & (c.readings.pose < last)]
    return based(c.cell, r, "absolute", NAMES)


def with_prior(prior: CarriedPrior, first: int = 25, last: int = 40) -> Fit:
    c = both()
    r = c.readings[(c.readings.pose >= first) & (c.readings.pose < last)]
    return fit(with_effects(c.cell, r, "absolute", NAMES, prior=prior), r, "absolute")


def still(p: Posterior) -> CarriedPrior:
    """No drift is thought possible."""
    return replace(carried_prior(p), expected={e.name: 1e-9 for e in p.effects})


def test_a_prior_and_new_readings_are_as_all_readings_together() -> None:
    first, together = of_poses(0, 25), of_poses(0, 40)
    found = with_prior(still(Posterior.of(first)))
    std = together.uncertainty.formal
    # The posterior is wider by what its own poses left out were off, here 1.1.
    np.testing.assert_allclose(found.uncertainty.formal, std, rtol=0.1)
    assert np.abs((found.theta - together.theta) / std).max() < 0.5
    assert found.dof > of_poses(25, 40).dof + 5
    assert found.holdout.rms_m < of_poses(25, 40).holdout.rms_m


def test_a_prior_that_knows_nothing_changes_nothing() -> None:
    p = Posterior.of(of_poses(0, 25))
    nothing = replace(p, information=np.zeros_like(p.information))
    found, alone = with_prior(carried_prior(nothing)), of_poses(25, 40)
    np.testing.assert_allclose(found.theta, alone.theta, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(found.uncertainty.std, alone.uncertainty.std, rtol=1e-9)
    assert found.chi2 == pytest.approx(alone.chi2, rel=1e-9)
    assert found.dof == pytest.approx(alone.dof, rel=1e-12)
    # Without a fold flat parameters shrink: towards zero, or the mean of the prior.
    assert found.holdout.rms_m == pytest.approx(alone.holdout.rms_m, rel=1e-3)


@cache
def repaired() -> tuple[Fit, Fit]:
    """A campaign, and another after joint 3 became half as stiff again."""
    c = both()
    first = of_poses(0, 40)
    p = plan(15, 77)
    softer = c.world.physics.joint_compliance * np.array([1, 1, 1.5, 1, 1, 1])
    world = replace(c.world, physics=c.world.physics.with_effect("joint_compliance", softer))
    r = measured(world, p, np.random.default_rng(5))
    prior = carried_prior(Posterior.of(first))
    return first, fit(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")


def test_the_joint_that_moved_is_found_and_let_go() -> None:
    first, found = repaired()
    worst = found.conflicts[0]
    assert (worst.group.effect, worst.group.joint) == ("joint_compliance", 3)
    assert worst.moved_sigma > 6
    assert worst.drift > 0.1
    others = [c.p_value for c in found.conflicts[1:]]
    assert min(others) > 1e-3 / len(others)
    k = [f"{e.name}.{q.name}" for e in found.model.effects for q in e.parameters].index(
        "joint_compliance.j3"
    )
    truth = 1.5 * both().world.physics.joint_compliance[2]
    assert abs(found.theta[k] - truth) < 0.15 * truth
    document = to_json(found)["prior"]
    assert document["source"]["n_readings"] == len(first.readings)  # type: ignore[index]
    assert document["effects"][0]["joint"] == 3  # type: ignore[index]


@pytest.mark.filterwarnings("error")
def test_an_effect_may_be_taken_out_or_added() -> None:
    _, found = repaired()
    without = remove(found, "joint_compliance")
    assert without.model.names == NAMES[1:]
    assert np.isfinite(without.theta).all()
    assert without.chi2 > found.chi2
    more = add(found, "base_compliance")
    assert more.model.names == (*found.model.names, "base_compliance")
    # The drift is chosen anew, so that the sum of squares may grow a little.
    assert more.holdout.rms_sigma < 1.05 * found.holdout.rms_sigma


def test_without_a_change_nothing_has_moved() -> None:
    c, first = both(), of_poses(0, 40)
    clean = noiseless(c.world, plan(15, 78))
    prior, p_values = carried_prior(Posterior.of(first)), []
    for seed in range(4):
        r = with_noise(clean, np.random.default_rng(seed))
        found = fit(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")
        p_values += [x.p_value for x in found.conflicts]
    assert min(p_values) > 1e-4
    assert 0.25 < float(np.median(p_values)) < 0.75


def test_a_revision_keeps_its_prior() -> None:
    _, found = repaired()
    r = found.readings
    text = to_text(to_record(found, None, None, content_hash(r)))
    again = restore(from_text(text, 1), both().cell, r)
    np.testing.assert_allclose(again.theta, found.theta, rtol=1e-6, atol=1e-10)
    np.testing.assert_array_equal(again.model.prior.drift, found.model.prior.drift)  # type: ignore[union-attr]
    assert again.dof == pytest.approx(found.dof, rel=1e-6)
    np.testing.assert_allclose(again.uncertainty.std, found.uncertainty.std, rtol=1e-4)


def test_another_arm_of_the_type_may_differ_by_more() -> None:
    p = Posterior.of(of_poses(0, 25))
    same, other = with_prior(carried_prior(p)), with_prior(carried_prior(p, "type"))
    assert (other.uncertainty.formal >= same.uncertainty.formal * 0.999).all()
    assert other.uncertainty.formal.sum() > 1.05 * same.uncertainty.formal.sum()
    given = carried_prior(p, stated={"encoder_offset": 0.7})
    assert given.least["encoder_offset"] == 0.7


def test_priors_that_cannot_be_are_refused() -> None:
    c, p = both(), Posterior.of(of_poses(0, 25))
    cases = (
        (carried_prior(p), c.cell, c.readings, "count twice"),
        (
            carried_prior(p),
            replace(c.cell, arm=load_arm("ur3e")),
            c.readings[c.readings.pose > 30],
            "other",
        ),
        (
            carried_prior(replace(p, links=p.links[:-1])),
            c.cell,
            c.readings[c.readings.pose > 30],
            "joints",
        ),
    )
    for prior, cell, readings, words in cases:
        with pytest.raises(InputError, match=words):
            baseline(cell, readings, "absolute", prior=prior)
    with pytest.raises(InputError, match="arm, type"):
        carried_prior(p, "cousin")
    with pytest.raises(InputError, match="drift of creep"):
        carried_prior(p, stated={"creep": 1.0})
    foreign = replace(p, effects=(replace(p.effects[0], name="cable_pull"),))
    with pytest.raises(InputError, match="--effects-from"):
        carried_prior(foreign)


def test_a_calibration_is_surer_with_a_prior() -> None:
    prior = carried_prior(Posterior.of(of_poses(0, 25)))
    found, alone = Calibration.of(with_prior(prior)), Calibration.of(of_poses(25, 40))
    q = both().readings.states.q[:20]
    stated = [c.predict(q).covariance for c in (found, alone)]
    spread = [np.trace(c, axis1=1, axis2=2).mean() for c in stated if c is not None]
    assert spread[0] < spread[1]
