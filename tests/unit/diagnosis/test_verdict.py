"""The rules of the verdict: what is known of the way to a model enters the same judgement."""

import itertools

import pytest

from hilcal.diagnosis.diagnosis import VERDICTS, Diagnosis, History, in_doubt
from hilcal.diagnosis.evidence import Evidence
from hilcal.diagnosis.verdict import judge
from hilcal.identification.baseline import baseline
from hilcal.identification.fit import fit
from hilcal.present.verdict import message
from tests.support.campaigns import campaign


def evidence(effect: str, mode: str, seed: int, **options) -> Evidence:
    c = campaign(effect, mode, seed, **options)
    return Evidence(fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode))


def check(d: Diagnosis) -> None:
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
    assert d.lead is not None
    rejected: list[str] = []
    while d.significant:
        rejected.append(d.significant[0])
        d = judge(e, History(rejected=tuple(rejected)))
        check(d)
    assert d.verdict == "unknown_effect"
    assert d.suspects[0].effect in rejected
    assert f"{d.suspects[0].effect}, explains" in message(d)
    assert "does not lower the error on poses left out" in message(d)


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
    without = judge(e, History(added=("tracker_scale",), removed=others))
    assert set(others).isdisjoint(in_doubt(without))


def test_every_reason_has_a_verdict():
    assert set(VERDICTS.values()) == {
        "adequate",
        "missing_effect",
        "ambiguous",
        "unknown_effect",
        "noise_misjudged",
    }
