"""Effects of a carried prior that new readings speak against are taken out, others stay."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from hilcal.diagnosis.evidence import spoken_against
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.carried import CarriedPrior, carried_prior
from hilcal.identification.drift import carried_effects, evidence_of_carried
from hilcal.identification.fit import Fit, fit
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.posterior import Posterior
from hilcal.identification.priors import names_of
from hilcal.readings.readings import Readings
from hilcal.refinement import refine
from tests.support.campaigns import Campaign, campaign, measured, plan

HIDDEN = "joint_tilt_compliance"
NAMES = ("joint_compliance", HIDDEN)


@cache
def before() -> tuple[Campaign, CarriedPrior]:
    """A campaign of an arm whose joints tilt, and what it taught."""
    c = campaign(HIDDEN, "absolute", 1, poses=20, registration_known=True)
    found = fit(with_effects(c.cell, c.readings, "absolute", NAMES), c.readings, "absolute")
    return c, carried_prior(Posterior.of(found))


@cache
def later(*, repaired: bool, poses: int) -> Readings:
    c, _ = before()
    physics = c.world.physics
    if repaired:
        stiff = np.zeros_like(getattr(physics, HIDDEN))
        physics = physics.with_effect(HIDDEN, stiff)
    world = replace(c.world, physics=physics)
    return measured(world, plan(poses, 91), np.random.default_rng(7))


def fitted(*, repaired: bool, poses: int = 10) -> Fit:
    c, prior = before()
    r = later(repaired=repaired, poses=poses)
    return fit(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")


def test_what_was_repaired_is_spoken_against_and_what_is_there_is_not() -> None:
    assert spoken_against(fitted(repaired=True)) == (HIDDEN,)
    assert spoken_against(fitted(repaired=False)) == ()


def test_the_evidence_is_the_ratio_of_normal_densities_of_the_readings() -> None:
    """Against the densities written out, flat parameters with a wide prior instead."""
    found = fitted(repaired=True, poses=3)
    model, s, p = found.model, found.solution, before()[1].posterior
    assert carried_effects(model) == (HIDDEN,)
    a = whitened_jacobian(model, s.prediction, s.theta, found.whitening, np.arange(model.size))
    y = s.white + a @ s.theta
    drift = model.prior.drift if model.prior is not None else np.zeros(0)
    c = (1 + drift[0] ** 2) * np.linalg.inv(p.information)
    of = carried_prior(p)
    c += np.diag((drift[1:][of.group] * of.unit) ** 2)

    def density(names: tuple[str, ...]) -> float:
        mean, cov = np.zeros(len(y)), s.beta * np.eye(len(y))
        kept = [k for k, name in enumerate(p.names) if name.split(".")[0] in names]
        own = [list(names_of(model)).index(p.names[k]) for k in kept]
        mean = a[:, own] @ p.mean[kept]
        cov += a[:, own] @ c[np.ix_(kept, kept)] @ a[:, own].T
        flat = np.delete(a, [list(names_of(model)).index(n) for n in p.names], axis=1)
        cov += 1e4**2 * flat @ flat.T
        return float(multivariate_normal(mean, cov).logpdf(y))

    expected = density(("joint_compliance", HIDDEN)) - density(("joint_compliance",))
    evidence = evidence_of_carried(model, s, found.whitening, (HIDDEN,))[HIDDEN]
    assert evidence == pytest.approx(expected, rel=1e-3)
    assert abs(expected) > 1


def test_refine_takes_a_repaired_effect_out_and_leaves_one_that_is_there() -> None:
    for repaired in (True, False):
        c, prior = before()
        r = later(repaired=repaired, poses=10)
        path = refine(baseline(c.cell, r, "absolute", prior=prior), r, "absolute")
        assert (HIDDEN in path.fit.model.names) is not repaired
        assert [s.removed for s in path.steps if s.removed] == ([HIDDEN] if repaired else [])
        assert path.verdict == "adequate"
