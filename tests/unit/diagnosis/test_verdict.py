"""The rules of the verdict, of several targets, of a background; probabilities of effects."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from hilcal.diagnosis.background_evidence import background_evidence, p_value_of_others, proved
from hilcal.diagnosis.diagnosis import (
    LARGEST_LOG_EVIDENCE,
    PRIOR_ODDS,
    History,
    effect_probabilities,
    in_doubt,
)
from hilcal.diagnosis.evidence import Alternative, Evidence
from hilcal.diagnosis.noise import NoiseVerdict
from hilcal.diagnosis.verdict import diagnose, judge, with_unconfirmed_suspect
from hilcal.identification.background import with_background
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.identification.linearisation import HeldOut
from hilcal.identification.prediction.full_prediction import full_prediction
from hilcal.numbers import length
from hilcal.present.verdict import headline, message
from hilcal.refinement import refine
from studies.study_cases import study_case
from tests.support.campaigns import campaign, configuration
from tests.support.diagnosis_cases import fitted_baseline
from tests.support.fit_cases import fitted_model, refined
from tests.support.reflector_cases import reflectors


def evidence(effect, mode, seed, **options):
    c = campaign(effect, mode, seed, **options)
    return Evidence(fitted_baseline(c))


def check(d):
    """What holds of every diagnosis."""
    groups = [(s.passes, s.explains) for s in d.suspects]
    assert groups == sorted(groups, reverse=True)
    for _, group in itertools.groupby(d.suspects, lambda s: (s.passes, s.explains)):
        values = [s.score.log_evidence for s in group]
        assert values == sorted(values, reverse=True)
    for s in d.suspects:
        assert not (s.passes and s.effect in d.history.rejected)
        assert set(s.same_as).isdisjoint(d.history.rejected)
    words, first = message(d), d.suspects[0].effect
    if d.verdict == "missing_effect" or d.reason in (
        "inseparable_suspects",
        "insufficient_catalogue",
    ):
        assert words.startswith(first)
        assert d.suspects[0].passes
    named = [s.effect for s in d.suspects if f"{s.effect} is missing" in words]
    assert named == ([first] if d.reason == "one_suspect" else [])
    assert not ("is missing:" in words and "lower the error" in words)
    for name in d.history.rejected:
        assert f"{name} is missing" not in words
    assert bool(in_doubt(d)) == (d.verdict == "ambiguous")


@pytest.mark.parametrize(
    ("effect", "mode", "seed"),
    [("base_compliance", "deflection", 3), ("encoder_offset", "absolute", 4)],
)
def test_rejected_suspects_are_not_named_until_none_is_left(effect, mode, seed):
    e = evidence(effect, mode, seed, poses=12)
    d = judge(e, History())
    check(d)
    rejected = []
    while d.significant:
        rejected.append(d.significant[0])
        d = judge(e, History(rejected=tuple(rejected)))
        check(d)
    assert d.verdict == "unknown_effect"
    assert d.suspects[0].effect in rejected
    assert f"{d.suspects[0].effect}, explains" in message(d)
    assert "does not lower the error on poses left out" in message(d)


@pytest.mark.parametrize(("times", "said"), [(1.5, False), (5.0, True)])
def test_an_adequate_model_that_predicts_far_worse_than_it_fits_says_so(times, said):
    d = diagnose(fitted_baseline(campaign("none", "absolute", 0, poses=20)))
    worse = replace(d.fit)
    rms = times * full_prediction(d.fit).noise_floor
    worse.__dict__["holdout"] = replace(d.fit.holdout, rms_m=rms)
    d = replace(d, fit=worse)
    assert d.verdict == "adequate"
    assert (f"are off by {length(rms)} rms on poses left out" in message(d)) == said


def test_an_adequate_model_is_in_doubt_where_another_effect_could_replace_an_addition():
    c = campaign("tracker_scale", "absolute", 1, poses=20, strength=1.0)
    model = baseline(c.cell, c.readings, "absolute")
    model = model + model.catalogue.make("tracker_scale", c.cell, c.readings.states)
    e = Evidence(fit(model, c.readings, "absolute"))
    given, chosen = judge(e, History()), judge(e, History(added=("tracker_scale",)))
    check(given)
    check(chosen)
    assert given.verdict == "adequate"
    assert chosen.reason == "inseparable_addition"
    assert chosen.residual_is_noise
    assert message(chosen).startswith(message(given))
    others = chosen.alternatives[0].same_as
    assert in_doubt(chosen) == ("tracker_scale", *others)[:4]
    tried = judge(e, History(added=("tracker_scale",), removed=others))
    assert in_doubt(tried) == in_doubt(chosen)  # trying the others before does not rule them out


def step(suspects=None, background=None, alternatives=()):
    """A diagnosis that says log evidences, and likelihood ratios of a background."""
    return SimpleNamespace(
        suspects=[
            SimpleNamespace(effect=n, score=SimpleNamespace(log_evidence=v))
            for n, v in (suspects or {}).items()
        ],
        background=[SimpleNamespace(effect=n, ratio=v) for n, v in (background or {}).items()],
        alternatives=alternatives,
    )


def odds(p):
    return p / (1 - p)


def test_odds_are_the_prior_ones_times_what_was_said_last_less_its_price():
    last = step({"a": 6.0, "b": -2.0}, {"c": 8.0}, (Alternative("f", 3.0, (), (), 0.0),))
    p = effect_probabilities([step({"a": 9.0, "e": 3.0, "f": 2.0}), last], "abcdef")
    assert list(p) == list("abcdef")
    for name, evidence in zip("abcdef", (6.0, -2.0, 4.0, 0.0, 3.0, 3.0), strict=True):
        assert odds(p[name]) == pytest.approx(PRIOR_ODDS * np.exp(evidence - 1.0))


def test_others_share_the_probability_of_what_they_may_stand_for():
    one = effect_probabilities(
        [step(alternatives=(Alternative("a", 20.0, (), ("b",), 20.0),))], "ab"
    )
    assert one == pytest.approx({"a": 0.5, "b": 0.5})
    # Two that only together explain as much cost one unit more.
    two = (Alternative("a", 20.0, (), ("b", "c"), 20.0),)
    p = effect_probabilities([step(alternatives=two)], "abc")
    assert odds(p["a"]) == pytest.approx(np.e)
    assert p["b"] == p["c"] == pytest.approx(1 - p["a"])


def test_no_evidence_is_a_certainty():
    p = effect_probabilities([step({"a": 1e6, "b": -1e6})], "ab")
    assert odds(p["a"]) == pytest.approx(PRIOR_ODDS * np.exp(LARGEST_LOG_EVIDENCE - 1.0), rel=1e-2)
    assert 0.0 < p["b"] < 1e-12


def test_a_refinement_says_what_is_hidden():
    c = campaign("encoder_offset", "absolute", 1, poses=30)
    path = refined(c.cell, c.readings, "absolute")
    p = path.probabilities(["encoder_offset", "backlash", "tracker_drift"])
    assert p["encoder_offset"] > 0.5 > max(p["backlash"], p["tracker_drift"])


def case_of(mode, hidden, strength):
    return study_case(configuration(), "ur10e", mode, hidden, strength, 0)


@pytest.mark.long
def test_gears_that_all_give_in_one_direction_are_no_scale_of_the_tracker():
    # Their zero mean leaves what a scale of some per cent would explain; ordinary ones have 1e-5.
    case = case_of("deflection", ("joint_stiffening",), 1.0)
    first = fitted_model(case.cell, case.readings, "deflection")
    fitted = with_background(first, first.model.names)
    tested = {b.effect: b for b in background_evidence(fitted)}
    assert tested["tracker_scale"].p_value > 0.05
    assert proved(tuple(tested.values())) == ("joint_stiffening",)


@pytest.mark.long
def test_a_model_with_shrunk_lines_is_refined_further():
    case = case_of("absolute", ("transmission_error",), 3.0)
    refinement = refined(case.cell, case.readings, "absolute")
    assert "transmission_error" in refinement.fit.model.random
    assert p_value_of_others(refinement.fit) > 0.01  # nothing else is there
    again = refine(refinement.fit.model, case.readings, "absolute")
    assert again.verdict == refinement.verdict == "adequate"


KNOWN = (True, False, False)


STD = 2.5e-5


def unstated(c):
    """The readings with the instrument's covariance alone, as a table without the arm's has it."""
    common = c.readings.common
    instrument = c.readings.covariance - common @ np.swapaxes(common, 1, 2)
    return replace(c.readings, covariance=instrument, common=None, scatter_stated=False)


@pytest.mark.long
@pytest.mark.parametrize(("mode", "seed"), [("absolute", 2), ("deflection", 0)])
def test_an_unknown_scatter_is_found_and_not_taken_for_a_cause(mode, seed):
    """Taken for independent, these readings name a cause: transmission_error in the second."""
    c = reflectors(seed=seed, poses=20, known=KNOWN, joint_std=STD)
    readings = unstated(c)
    fitted = fitted_model(c.cell, readings, mode)
    d = diagnose(fitted)
    assert fitted.variance_factor > 4
    assert (d.verdict, d.reason, d.significant) == ("adequate", "arm_scatter", ())
    assert d.scatter.kind == "joints"
    assert d.scatter.std[0] == pytest.approx(STD, abs=4 * d.scatter.std_error[0])


def test_a_suspect_that_few_poses_do_not_confirm_is_no_unknown_effect():
    """Of 36 campaigns of 5 to 8 poses 5 said that the catalogue lacks what it explained."""
    d = diagnose(evidence("joint_tilt_compliance", "deflection", 1, poses=6).fit)
    lead, *others = d.suspects
    unsure = replace(lead, left_out=lambda: HeldOut(lead.holdout_share, False))
    others = [replace(s, explains=False) for s in others]
    d = replace(d, reason="no_suspect", suspects=(unsure, *others), predictable_share=0.0)
    unconfirmed = with_unconfirmed_suspect(d)
    assert (unconfirmed.verdict, unconfirmed.reason) == ("ambiguous", "unconfirmed_suspect")
    assert message(unconfirmed).startswith(lead.effect)
    assert "--after RUN" in message(unconfirmed)
    two = with_unconfirmed_suspect(replace(d, suspects=(unsure, replace(unsure, effect="creep"))))
    assert in_doubt(two) == (lead.effect, "creep")
    for law in (
        replace(d, predictable_share=lead.holdout_share + 0.01),  # something else predicts more
        replace(d, suspects=(replace(unsure, share=0.2), *others)),  # which leaves a misfit
        replace(d, suspects=(replace(unsure, refuted=True), *others)),
    ):
        assert with_unconfirmed_suspect(law).reason == "no_suspect"


def test_a_headline_asserts_no_wrong_noise_that_its_sentence_calls_unknown():
    d = diagnose(evidence("none", "deflection", 1).fit)
    for noise, asserted in (("unknown", False), ("too_large", True)):
        d = replace(d, reason="misjudged_noise", noise=NoiseVerdict(noise), scatter=None)
        assert ("not what was stated" in headline(d)) == asserted
        assert ("it is not known" in message(d)) != asserted
