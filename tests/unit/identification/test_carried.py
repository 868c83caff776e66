"""The posterior of one campaign as prior of another: the same as both together, drift, refusals."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from hilcal.calibration.calibration import Calibration
from hilcal.campaign.revisions import restore, to_record
from hilcal.diagnosis.stepwise import add, remove
from hilcal.errors import InputError
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.fit import Fit, fit
from hilcal.identification.fit_document import to_json
from hilcal.identification.posterior import Posterior
from hilcal.robot.catalogue import load_arm
from hilcal.store.revision import from_text, to_text
from hilcal.store.rows import content_hash
from tests.support.campaigns import Campaign, campaign, measured, noiseless, plan, with_noise

NAMES = ("joint_compliance", "encoder_offset", "joint_tilt_compliance")


@cache
def both() -> Campaign:
    return campaign("joint_tilt_compliance", "absolute", 1, poses=40, registration_known=True)


def of_poses(first: int, last: int) -> Fit:
    c = both()
    r = c.readings[(c.readings.pose >= first) & (c.readings.pose < last)]
    return fit(with_effects(c.cell, r, "absolute", NAMES), r, "absolute")


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


def test_refusals() -> None:
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
