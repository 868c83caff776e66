"""`study diagnosis`: its campaigns, what it counts and asks, on one process and on several."""

import io

import numpy as np
import pytest
from rich.console import Console

from hilcal.errors import InputError
from studies.diagnosis import (
    AddedEffect,
    DiagnosisCase,
    DiagnosisOutcome,
    IntervalCount,
    Judgement,
    RefinementResult,
    run_case,
)
from studies.diagnosis_claims import claims
from studies.diagnosis_rates import (
    afterwards,
    by_effect,
    coverage_by_effect,
    followed,
    found,
    unknown,
)
from studies.diagnosis_table import report
from studies.study_cases import study_case
from studies.unmodelled_laws import LAWS, law_named, shift
from tests.support.campaigns import configuration
from tests.support.cli_cases import refused
from tests.support.refusals import check, refusal, refusals


def asked(**given):
    """A question; two effects are a pair."""
    usual = {
        "kind": "hidden", "robot": "ur10e", "mode": "absolute",
        "hidden": ("creep",), "strength": 2.0, "seed": 0,
    }  # fmt: skip
    return DiagnosisCase(**{**usual, **given})


def said(lead="creep", *same_as, verdict="missing_effect", variables=("time", "load"), carriers=()):
    return Judgement(verdict, lead, same_as, variables, carriers, "a sentence of times", 1.5)


def refined(*added, same_as=(), verdict="adequate", holdout=1.0, inside=()):
    model = ("joint_compliance", *added)
    sets = tuple(AddedEffect(a, same_as) for a in added)
    return RefinementResult(said(verdict=verdict), sets, model, holdout, holdout, inside)


def outcome(lead="creep", *same_as, **given):
    """The answer that `lead` is first, to a question about creep."""
    return DiagnosisOutcome(asked(**given), said(lead, *same_as))


@pytest.mark.parametrize(
    ("lead", "same_as", "right"),
    [
        ("creep", (), True),
        ("creep", ("a", "b", "c"), True),  # it is first, whatever else is not excluded
        ("a", ("creep",), True),
        ("a", ("b", "creep"), True),
        ("a", ("b", "c", "creep"), False),  # a set of four is no answer
        ("a", (), False),
    ],
)
def test_found_is_first_or_in_a_set_of_at_most_three(lead, same_as, right):
    assert found(outcome(lead, *same_as)) is right


def test_what_came_first_instead_is_counted():
    cases = [
        outcome(),
        outcome("backlash", "creep"),
        outcome("hysteresis"),
        outcome("hysteresis"),
        outcome("load_point", "a", "b", "creep"),
        DiagnosisOutcome(asked(), failure="InputError: no"),
    ]
    (row,) = by_effect(cases)
    assert (row.found.hits, row.found.cases) == (2, 6)
    assert row.size == pytest.approx(1.5)
    expected = {"hysteresis": 2, "failed": 1, "load_point (set of 4)": 1}
    assert dict(row.instead) == expected
    assert row.instead[0] == ("hysteresis", 2)


def test_refinements_count_where_the_effect_was_found_and_named():
    inside = (IntervalCount("creep", 1, 1), IntervalCount("joint_compliance", 4, 6))
    right = DiagnosisOutcome(asked(), said(), refined("creep", inside=inside))
    more = DiagnosisOutcome(asked(), said(), refined("creep", "backlash", holdout=1.06))
    wrong = DiagnosisOutcome(asked(), said("backlash"), refined("backlash", holdout=9.0))
    (row,) = afterwards([right, more, wrong])
    assert (row.right.hits, row.right.cases) == (1, 2)
    assert (row.holdout.hits, row.holdout.cases) == (1, 2)
    assert (row.intervals.hits, row.intervals.cases) == (5, 7)
    coverage = dict(coverage_by_effect([right, more, wrong]))
    assert coverage["joint_compliance"].share == pytest.approx(4 / 6)


def test_outside_of_the_catalogue_the_verdict_and_the_variable_count():
    law = asked(kind="outside", hidden=("swaying bench",))
    late = DiagnosisOutcome(
        law, said(), refined("creep", verdict="unknown_effect"), variables=("time",)
    )
    never = DiagnosisOutcome(law, said(), refined("creep"), variables=("joint 2 angle",))
    carried = said(variables=("pose", "load"), carriers=("joint 2 angle",))
    assert [unknown(o) for o in (late, never)] == [True, False]
    assert [followed(o) for o in (late, never)] == [True, False]
    assert followed(DiagnosisOutcome(law, carried, variables=("joint 2 angle",)))
    assert not followed(DiagnosisOutcome(law, carried, variables=("time",)))


def test_claims_are_met_or_not_by_what_is_asked():
    quiet = [DiagnosisOutcome(asked(kind="nothing", hidden=()), said(verdict="adequate"))] * 99
    loud = DiagnosisOutcome(asked(kind="nothing", hidden=()), said())
    (claim,) = claims([*quiet, loud])
    assert (claim.rate.share, claim.met) == (0.99, True)
    (claim,) = claims([*quiet, loud, loud])
    assert claim.met is False
    # An interval may hold too often as well.
    often = DiagnosisOutcome(
        asked(), said(), refined("creep", inside=(IntervalCount("creep", 9, 9),))
    )
    (always,) = (c for c in claims([often]) if "intervals" in c.words)
    assert always.met is False


def raising(error):
    def run(question):
        raise error

    return run


def test_a_case_that_fails_is_a_miss_that_says_why_and_one_that_cannot_be_does_not_count():
    o = run_case(asked(), raising(ValueError("no\n such thing")))
    assert o.failure == "ValueError: no such thing"
    assert not found(o)
    shown = written([o])
    assert "1 cases failed" in shown
    assert "creep, ur10e, absolute, 2 σ, seed 0" in shown
    o = run_case(asked(), raising(InputError("effect 'creep' cannot reach 2 sigma")))
    assert (o.failure, o.impossible) == ("", "effect 'creep' cannot reach 2 sigma")
    (row,) = by_effect([outcome(), o])
    assert (row.found.hits, row.found.cases, row.instead) == (1, 1, ())
    assert "1 campaigns cannot be" in written([outcome(), o])


def written(outcomes):
    out = Console(file=io.StringIO(), width=100)
    for part in report(outcomes):
        out.print(part)
    return out.file.getvalue()


@refusals("study_arguments")
def test_wrong_input_of_a_study_is_refused_in_one_line(case, given, capsys):
    check(case, refused(capsys, 2, "studies", *given.split()))


def case(*hidden, mode="absolute", strength=2.0, **given):
    return study_case(
        configuration(), "ur10e", mode, hidden, strength, int(given.get("seed", 3)),
        cycles=int(given.get("cycles", 1)),
        stated=given.get("stated", 1.0),
        n_poses=int(given.get("poses", 8)),
    )  # fmt: skip


def seen(c):
    """What would be read without noise."""
    return c.readings.value - c.noise


def test_the_noise_is_as_large_as_stated_or_as_misjudged():
    for stated in (0.5, 1.0, 2.0):
        many = [case(mode="deflection", seed=s, stated=stated, cycles=2) for s in range(4)]
        white = [
            np.linalg.solve(np.linalg.cholesky(c.readings.covariance), c.noise[:, :, None])
            for c in many
        ]
        # 4 · 96 readings of three elements: 2 % of a standard deviation
        assert np.std(np.concatenate(white)) == pytest.approx(1 / stated, rel=0.08)


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.name)
def test_a_law_outside_of_the_catalogue_acts_at_the_strength_asked(law):
    for mode in law.readings:
        c = case(law.name, mode=mode, strength=3.0)
        assert c.variables == law.variables
        clean = c.world.ideal_readings(c.readings.states)
        change = seen(c) - clean.position
        covariance = c.world.covariance(clean)
        if mode == "deflection":
            first = np.repeat(np.arange(0, 48, 6), 6)
            change = change - change[first]
            covariance = covariance + covariance[first]
            loaded = c.readings.load > 0
            change, covariance = change[loaded], covariance[loaded]
        white = np.linalg.solve(np.linalg.cholesky(covariance), change[:, :, None])
        assert np.sqrt(np.mean(white**2)) == pytest.approx(3.0, rel=1e-6)


def test_laws_and_effects_that_do_not_fit_are_refused():
    refusal("crossed gear", law_named, "crossed gears")
    refusal("absolute", case, "crossed gear", mode="deflection")
    refusal("cancels in deflections", case, "encoder_offset", mode="deflection")
    c = case()
    still = c.readings.states
    law, none = law_named("base that turns"), np.zeros(3, dtype=np.int64)
    refusal("no loaded reading", shift, law, c.world, still[none], 3.0, "deflection", none, none)
    with pytest.raises(InputError, match="no unloaded reading"):
        shift(law, c.world, still[none + 1], 3.0, "deflection", none, none)
    with pytest.raises(InputError, match="changes nothing"):
        shift(law_named("swaying bench"), c.world, still[none], 3.0, "absolute", none, none)
