"""Diagnosis: right about what is wrong, honest where it cannot know; noise told by repeats."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest
from scipy.stats import f as f_distribution

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.diagnosis.noise import judge_noise, pure_error
from hilcal.diagnosis.stepwise import add
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.injected_effects import DEFLECTION_EFFECTS
from hilcal.effects.catalogue import BUILT_IN
from hilcal.effects.protocol import EffectSpec
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.model.observe import motion
from hilcal.present.diagnosis import detectable_sizes
from hilcal.present.verdict import headline, message
from hilcal.refinement import refine
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration, noiseless, plan, with_noise
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.fit_cases import fitted_model
from tests.support.refusals import refusal
from tests.support.rows import first

MODES = ("absolute", "deflection")
NAMES = tuple(
    e.name
    for e in BUILT_IN
    if e.name not in ("joint_compliance", "guide_error", "remainder") and e.role != "observer"
)
HIDDEN = [
    *((n, "deflection" if n in DEFLECTION_EFFECTS else "absolute") for n in NAMES),
    *(
        pytest.param(n, "absolute", marks=pytest.mark.slow)
        for n in NAMES
        if n in DEFLECTION_EFFECTS
    ),
]
"""Every effect every time, in both modes in the slow suite."""


def hidden(effect, mode, seed, poses=30, **options):
    known = effect == "base_frame"  # a wrong registration shows only where one is believed
    return campaign(effect, mode, seed, poses=poses, registration_known=known, **options)


@pytest.mark.parametrize("mode", MODES)
def test_nothing_hidden_is_adequate(mode):
    d = diagnose(fitted_baseline(campaign("none", mode, 0, poses=12)))
    assert d.verdict == "adequate", message(d)
    assert d.significant == ()
    of = "of the catalogue" if mode == "absolute" else "that deflections show"
    if d.not_shown and mode == "absolute":
        of = "that these readings could show"
    assert f"No effect {of} is missing" in message(d)


@pytest.mark.parametrize("effect", first(1, ["link_geometry", "transmission_error"]))
def test_what_deflections_cannot_show_is_part_of_the_verdict(effect):
    """Errors of geometry cancel in deflections: they are adequate, and the arm is off by them."""
    c = hidden(effect, "absolute", 0, strength=10.0)
    assert diagnose(fitted_baseline(c)).verdict != "adequate"
    d = diagnose(fitted_baseline(replace(c, mode="deflection")))
    assert d.verdict == "adequate", message(d)
    assert effect in d.not_shown
    assert headline(d) == "adequate for deflections; geometry is not calibrated"
    assert "Geometry is not calibrated" in message(d)
    assert "No effect of the catalogue" not in message(d)
    document = d.to_dict()
    assert effect in document["not_shown"]
    assert {s["effect"] for s in document["suspects"] if not s["shown"]} >= set(d.not_shown)
    table = "\n".join(str(x) for x in detectable_sizes(d) if isinstance(x, str))
    assert effect in table.partition("These readings cannot show, at any plausible size:")[2]


@pytest.mark.parametrize(("effect", "mode"), HIDDEN)
def test_a_hidden_effect_leads(effect, mode):
    p = linearise(fitted_baseline(hidden(effect, mode, 0, poses=20)))
    lead = rank_suspects(p, candidates(p.fit))[0]
    assert effect in (lead.effect, *lead.same_as)
    assert lead.score.p_value < 1e-6
    assert lead.share > 0.5
    assert lead.holdout_share > 0.3


@pytest.mark.parametrize("mode", MODES)
def test_scores_foretell_what_adding_does(mode):
    """The F-test of a family is that of the refit with all its columns free."""
    fitted = fitted_baseline(hidden("joint_tilt_compliance", mode, 0, strength=0.8, poses=15))
    p = linearise(fitted)
    some = ("base_compliance", "hysteresis", "joint_tilt_compliance")
    suspects = [s for s in rank_suspects(p, candidates(p.fit)) if s.effect in some]
    assert len(suspects) == len(some)
    for s in suspects:
        after = add(fitted, s.effect)
        rank, rest = s.score.rank, fitted.dof - s.score.rank
        # Frames with a prior are learnt a little less well beside more parameters.
        assert after.dof == pytest.approx(rest, abs=0.2)
        ratio = (fitted.chi2 - after.chi2) / rank / (after.chi2 / rest)
        assert s.score.p_value > 1e-200
        # One linear step against the converged refit.
        assert f_distribution.isf(s.score.p_value, rank, rest) == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("mode", first(1, MODES))
@pytest.mark.parametrize("factor", first(1, [2.0, 0.5]))
def test_misjudged_noise_is_told_from_a_missing_effect_by_repeats(mode, factor):
    c = campaign("none", mode, plan_seed=0, poses=6, cycles=3)
    clean = noiseless(c.world, plan(6, 0, 3))
    d = diagnose(fitted_baseline(c, readings=with_noise(clean, np.random.default_rng(0), factor)))
    assert d.verdict == "noise_misjudged", message(d)
    assert d.significant == ()
    low, high = d.pure_error.interval
    # The 95 % interval, and half as much again.
    assert low < 1.25 * factor**2
    assert high > factor**2 / 1.25


@pytest.mark.long
@pytest.mark.parametrize("stated", [20.0, 100.0])
def test_noise_that_is_stated_far_too_large_is_told_beside_a_background(stated):
    """As by another unit; the arm's own errors are smaller than it, and all are in a background."""
    c = study_case(configuration(), "ur5e", "absolute", (), 0.0, 1, stated=stated, n_poses=20)
    readings = c.readings[c.readings.load == 0]
    last = refine(baseline(c.cell, readings, "absolute"), readings, "absolute")
    assert last.fit.model.background
    assert last.verdict == "noise_misjudged"
    assert "the stated covariance is too large" in message(last.diagnosis)


@pytest.mark.long
def test_noise_that_was_estimated_is_nowhere_stated_too_large():
    """A few poses of an arm with gear waves: the estimated noise contains them."""
    hidden = ("link_geometry", "transmission_error")
    c = study_case(configuration(), "ur5e", "absolute", hidden, 3.0, 0, n_poses=20)
    unloaded = c.readings[c.readings.load == 0]
    large = replace(unloaded, covariance=9.0 * unloaded.covariance)
    verdicts = {
        stated: refine(baseline(c.cell, r, "absolute"), r, "absolute").verdict
        for stated in (True, False)
        for r in [replace(large, noise_stated=stated)]
    }
    assert verdicts == {True: "noise_misjudged", False: "ambiguous"}


def test_a_fit_that_uses_most_of_the_readings_proves_nothing():
    c = study_case(configuration(), "ur5e", "absolute", (), 0.0, 1)
    unloaded = c.readings[c.readings.load == 0]
    model = baseline(c.cell, unloaded, "absolute") + EffectSpec("link_geometry")
    model = model + EffectSpec("joint_compliance")
    few, many = (
        diagnose(fit(model, unloaded[:poses], "absolute")) for poses in (18, len(unloaded))
    )
    assert (few.verdict, many.verdict) == ("ambiguous", "adequate")
    assert "has used 31 of 54 degrees of freedom" in message(few)


@pytest.mark.long
def test_further_loads_at_few_poses_prove_nothing_of_geometry():
    """Couplings of joints in place of the waves of gears fit 12 poses under five loads as well."""
    hidden = ("link_geometry", "transmission_error")
    c = study_case(configuration(), "ur10e", "absolute", hidden, 3.0, 0, n_poses=12)
    names = ("joint_compliance", "link_geometry", "joint_coupling")
    wrong = diagnose(fitted_model(c.cell, c.readings, "absolute", names))
    assert (wrong.verdict, wrong.reason) == ("ambiguous", "few_readings")
    assert wrong.fit.dof > 0.7 * wrong.fit.whitening.rank
    assert wrong.fit.left_out_over_residual > 100.0
    assert re.search(r"poses left out are off by \d+\.\d times as much", message(wrong))
    alone = study_case(configuration(), "ur10e", "absolute", hidden[:1], 3.0, 0, n_poses=12)
    right = refine(baseline(alone.cell, alone.readings, "absolute"), alone.readings, "absolute")
    assert (right.fit.model.named[-1], right.verdict) == ("link_geometry", "adequate")


def test_misjudged_noise_without_repeats_cannot_be_known_to_be_it():
    c = campaign("none", "absolute", plan_seed=0, poses=12)
    clean = noiseless(c.world, plan(12))
    d = diagnose(fitted_baseline(c, readings=with_noise(clean, np.random.default_rng(0), 2.0)))
    assert d.verdict == "noise_misjudged"
    assert d.pure_error is None
    assert "Without repeated readings it is not known" in message(d)


@pytest.mark.parametrize(
    ("effect", "mode", "kind"),
    [
        ("hysteresis", "absolute", "approach"),
        ("joint_stiffening", "deflection", "torque"),
        ("tracker_drift", "absolute", "time"),
        ("transmission_error", "absolute", "angle"),
    ],
)
def test_the_misfit_follows_the_variable_that_drives_it(effect, mode, kind):
    places = misfit_breakdown(linearise(fitted_baseline(hidden(effect, mode, 0))))
    # "pose" and "direction" say where, not after what.
    follows = [v for v in places if v.variable != "pose" and "direction" not in v.variable]
    strongest = min(follows, key=lambda v: v.p_value)
    assert kind in strongest.variable, [(v.variable, v.share, v.p_value) for v in places[:4]]
    assert any(kind in v.variable for v in follows[:3])
    assert strongest.p_value < 1e-10


@pytest.mark.parametrize(
    ("wave", "instead"),
    [(0.0, ("air temperature",)), pytest.param(3.0, (), marks=pytest.mark.long)],
)
@pytest.mark.long
def test_an_effect_in_time_may_be_one_in_an_air_temperature_that_rises_with_it(wave, instead):
    c = hidden("tracker_drift", "absolute", 0)
    t = (c.readings.states.time - c.readings.states.time.min()) / np.ptp(c.readings.states.time)
    air = 20.0 + 4.0 * t + wave * np.sin(12.0 * t)
    states = replace(c.readings.states, air_temperature=air, joint_temperature=None)
    before = fitted_baseline(c, readings=replace(c.readings, states=states))
    for d in (diagnose(before), diagnose(add(before, "tracker_drift"))):  # suspected, and named
        confounded = next((x for x in d.confounded if x.effect == "tracker_drift"), None)
        assert (() if confounded is None else confounded.instead) == instead
        assert ("could as well follow the air temperature" in message(d)) == bool(instead)
        assert len(d.to_dict()["confounded"]) == len(d.confounded)


def test_a_variable_in_place_of_another_stays_within_its_range():
    c = hidden("creep", "deflection", 0)
    air = 20.0 + c.readings.states.load_time / 100.0
    air[np.argmin(air)] -= 1.0  # by the others, a time under load below zero
    states = replace(c.readings.states, air_temperature=air, joint_temperature=None)
    before = fitted_baseline(c, readings=replace(c.readings, states=states))
    (confounded,) = diagnose(add(before, "creep")).confounded
    assert (confounded.effect, confounded.instead) == ("creep", ("air temperature",))


def test_a_diagnosis_needs_whitened_residuals():
    c = campaign(plan_seed=0)
    fitted = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", "none")
    refusal("diagnosis needs a fit with scaling gc, this one has none", diagnose, fitted)


def test_effects_that_need_missing_columns_are_no_suspects():
    c = campaign(plan_seed=0)
    bare = replace(c.readings, states=replace(c.readings.states, time=None, approach=None))
    d = diagnose(fitted_baseline(c, readings=bare))
    assert {"hysteresis", "tracker_drift"}.isdisjoint(s.effect for s in d.suspects)
    assert all("approach" not in v.variable and v.variable != "time" for v in d.misfit_breakdown)


class Repeated:
    """A campaign measured twice or more, of which some readings are missing."""

    def __init__(self, mode, poses, cycles=2, m=3, missing=0.15, effect="none"):
        c = campaign(effect, mode, plan_seed=0, poses=poses, cycles=cycles, m=m,
                     registration_known=True)  # fmt: skip
        clean = noiseless(c.world, plan(poses, 0, cycles), m)
        kept = np.random.default_rng(5).random(len(clean)) >= missing
        self.clean = clean[kept | clean.unloaded]
        self.mode = mode
        self.model = baseline(c.cell, self.clean, mode)

    def fit(self, readings):
        return fit(self.model, readings, self.mode)

    def motion(self):
        p = self.model.predict(self.clean.states, np.zeros(self.model.size))
        cell, chain = self.model.cell, p.situation.chain
        return motion(cell, p.observation, chain, p.deviation, self.clean.m).dq


def pure_error_of(r, readings):
    return pure_error(r.fit(readings))


def null_p_values(mode, m, seeds):
    r, rng = Repeated(mode, 6, m=m), np.random.default_rng(1)
    pure, lack = [], []
    for _ in range(seeds):
        e = pure_error_of(r, with_noise(r.clean, rng))
        pure.append(chi2.sf(e.factor * e.dof, e.dof))
        lack.append(e.lack_of_fit_p)
    return pure, lack


@pytest.mark.long
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    ("m", "seeds"), [(3, 40), *(pytest.param(m, 300, marks=pytest.mark.slow) for m in (3, 6))]
)
def test_the_factor_is_chi_square_and_so_is_what_is_left(mode, m, seeds):
    for p in null_p_values(mode, m, seeds):
        assert kstest(p, "uniform").pvalue > 1e-3 / 8


@pytest.mark.parametrize("mode", first(1, MODES))
def test_estimated_covariances_do_not_bias_the_factor(mode):
    """Ten samples each, and a prior worth twenty."""
    r, rng, m = Repeated(mode, 8, m=6), np.random.default_rng(2), 6
    root, factors = np.linalg.cholesky(r.clean.covariance), []
    for _ in range(12):
        z = rng.standard_normal((len(r.clean), 9, m))
        estimate = (20 * np.eye(m) + np.swapaxes(z, 1, 2) @ z) / 29
        covariance = root @ estimate @ np.swapaxes(root, 1, 2)
        e = pure_error_of(r, replace(with_noise(r.clean, rng), covariance=covariance))
        factors.append(e.factor)
    # 4 σ of the mean; uncorrected, the factor would be 1.07.
    assert np.mean(factors) == pytest.approx(1, abs=4 * np.sqrt(2 / e.dof / len(factors)))


def test_drift_and_friction_between_repeats_are_not_noise():
    for effect in ("hysteresis", "tracker_drift"):
        r = Repeated("absolute", 10, effect=effect)
        e = pure_error_of(r, with_noise(r.clean, np.random.default_rng(3)))
        assert e.lack_of_fit_p < 1e-6
        assert e.factor == pytest.approx(1, abs=4 * np.sqrt(2 / e.dof))


def spoilt(r, what, rng):
    read = with_noise(r.clean, rng)
    value, v = read.value.copy(), r.clean.covariance[:, :3, :3]
    draw = rng.standard_normal(len(value))[:, None]
    if what == "along the beam":
        u = r.clean.value[:, :3] / np.linalg.norm(r.clean.value[:, :3], axis=1)[:, None]
        value[:, :3] += 3 * u * np.sqrt(np.einsum("ki,kij,kj->k", u, v, u))[:, None] * draw
    elif what.startswith("joint"):
        value += r.motion()[:, :, int(what[-1]) - 1] * 4e-5 * draw
    else:
        name = "none" if what == "unloaded" else what
        of_load = np.array(r.clean.load_names)[r.clean.load] == name
        value[of_load] += 2 * (read.value - r.clean.value)[of_load]
    return replace(read, value=value)


@pytest.mark.parametrize("mode", first(1, MODES))
@pytest.mark.parametrize(
    "what", first(3, ["along the beam", "joint 3", "10kg", "joint 1", "unloaded"])
)
def test_the_direction_that_scatters_is_named(mode, what):
    r = Repeated(mode, 20, missing=0.0)
    e = pure_error_of(r, spoilt(r, what, np.random.default_rng(0)))
    assert e.where.name == what
    assert e.where.p_value < 1e-3
    assert e.where.interval[0] > 1.5
    if what == "along the beam":
        assert e.where.interval[0] < 10 < e.where.interval[1]


def test_repeats_that_scatter_less_blame_the_model():
    r = Repeated("absolute", 10, effect="encoder_offset")
    f = r.fit(with_noise(r.clean, np.random.default_rng(0), 2.0))
    verdict = judge_noise(f, pure_error(f), False)
    assert verdict.contradicted
    assert not verdict.misjudged
    assert verdict.reason == "lack_of_fit"
