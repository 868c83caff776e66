"""Diagnosis: exact where nothing is wrong, right about what is, and honest where it cannot know."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import f as f_distribution

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.diagnosis.misfit_breakdown import misfit_breakdown
from hilcal.diagnosis.verdict import diagnose
from hilcal.drivers.simulated.injected_effects import DEFLECTION_EFFECTS
from hilcal.effects.catalogue import BUILT_IN
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import linearise
from hilcal.present.diagnosis import detectable_sizes
from hilcal.present.verdict import headline, message
from hilcal.refinement import add
from tests.support.campaigns import campaign, noiseless, plan, with_noise
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.refusals import refusal
from tests.support.rows import first

MODES = ("absolute", "deflection")
NAMES = tuple(
    e.name
    for e in BUILT_IN
    if e.name not in ("joint_compliance", "guide_error") and e.role != "observer"
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
    for seed in range(2):
        d = diagnose(fitted_baseline(campaign("none", mode, seed, poses=12)))
        assert d.verdict == "adequate", message(d)
        assert d.significant == ()
        of = "of the catalogue" if mode == "absolute" else "that deflections show"
        if d.not_shown and mode == "absolute":
            of = "that these readings could show"
        assert f"No effect {of} is missing" in message(d)


def test_what_deflections_cannot_show_is_part_of_the_verdict():
    """Errors of geometry cancel in deflections: they are adequate, and the arm is off by them."""
    for effect in ("link_geometry", "transmission_error"):
        c = hidden(effect, "absolute", 0, strength=10.0)
        assert diagnose(fitted_baseline(c)).verdict != "adequate"
        d = diagnose(fitted_baseline(replace(c, mode="deflection")))
        assert d.verdict == "adequate", message(d)
        assert effect in d.not_shown
        assert headline(d) == "adequate for deflections; geometry is not calibrated"
        assert "Geometry is not calibrated" in message(d)
        assert "No effect of the catalogue" not in message(d)
        told = d.to_dict()
        assert effect in told["not_shown"]
        assert {s["effect"] for s in told["suspects"] if not s["shown"]} >= set(d.not_shown)
        table = "\n".join(str(x) for x in detectable_sizes(d) if isinstance(x, str))
        assert effect in table.partition("At no plausible size would these readings show")[2]


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
    found = fitted_baseline(hidden("joint_tilt_compliance", mode, 0, strength=0.8, poses=15))
    p = linearise(found)
    some = ("base_compliance", "hysteresis", "joint_tilt_compliance")
    suspects = [s for s in rank_suspects(p, candidates(p.fit)) if s.effect in some]
    assert len(suspects) == len(some)
    for s in suspects:
        after = add(found, s.effect)
        rank, rest = s.score.rank, found.dof - s.score.rank
        # Frames with a prior are learnt a little less well beside more parameters.
        assert after.dof == pytest.approx(rest, abs=0.2)
        ratio = (found.chi2 - after.chi2) / rank / (after.chi2 / rest)
        assert s.score.p_value > 1e-200
        # One linear step against the converged refit.
        assert f_distribution.isf(s.score.p_value, rank, rest) == pytest.approx(ratio, rel=0.03)


@pytest.mark.parametrize("mode", first(1, MODES))
@pytest.mark.parametrize("factor", [2.0, 0.5])
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


def test_misjudged_noise_without_repeats_cannot_be_known_to_be_it():
    c = campaign("none", "absolute", plan_seed=0, poses=12)
    clean = noiseless(c.world, plan(12))
    d = diagnose(fitted_baseline(c, readings=with_noise(clean, np.random.default_rng(0), 2.0)))
    assert d.verdict == "noise_misjudged"
    assert d.pure_error is None
    assert "Without repeated readings it cannot be known" in message(d)


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


def test_a_diagnosis_needs_whitened_residuals():
    c = campaign(plan_seed=0)
    found = fit(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute", "none")
    refusal("diagnosis needs a fit with scaling gc, this one has none", diagnose, found)


def test_effects_that_need_missing_columns_are_no_suspects():
    c = campaign(plan_seed=0)
    bare = replace(c.readings, states=replace(c.readings.states, time=None, approach=None))
    d = diagnose(fitted_baseline(c, readings=bare))
    assert {"hysteresis", "tracker_drift"}.isdisjoint(s.effect for s in d.suspects)
    assert all("approach" not in v.variable and v.variable != "time" for v in d.misfit_breakdown)
