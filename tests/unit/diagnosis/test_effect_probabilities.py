"""Probabilities of effects: by the last that was said of each, shared with what stands for it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hilcal.diagnosis.diagnosis import LARGEST, PRIOR_ODDS, effect_probabilities
from hilcal.diagnosis.evidence import Alternative
from hilcal.identification.baseline import baseline
from hilcal.refinement import refine
from tests.support.campaigns import campaign


def step(
    suspects: dict[str, float] | None = None,
    background: dict[str, float] | None = None,
    alternatives: tuple[Alternative, ...] = (),
) -> Any:
    """A diagnosis that says log evidences, and likelihood ratios of a background."""
    return SimpleNamespace(
        suspects=[
            SimpleNamespace(effect=n, score=SimpleNamespace(log_evidence=v))
            for n, v in (suspects or {}).items()
        ],
        background=[SimpleNamespace(effect=n, ratio=v) for n, v in (background or {}).items()],
        alternatives=alternatives,
    )


def odds(p: float) -> float:
    return p / (1 - p)


def test_odds_are_the_prior_ones_times_the_evidence_less_its_price() -> None:
    p = effect_probabilities([step({"a": 6.0, "b": -2.0}, {"c": 8.0})], "abcd")
    assert list(p) == ["a", "b", "c", "d"]
    for name, evidence in (("a", 6.0), ("b", -2.0), ("c", 4.0), ("d", 0.0)):
        assert odds(p[name]) == pytest.approx(PRIOR_ODDS * np.exp(evidence - 1.0))


def test_what_was_said_last_counts() -> None:
    last = step({"a": 1.0}, alternatives=(Alternative("b", 20.0, (), (), 0.0),))
    p = effect_probabilities([step({"a": 9.0, "b": 2.0, "c": 3.0}), last], "abc")
    assert odds(p["a"]) == pytest.approx(PRIOR_ODDS)
    assert p["b"] > 0.9999
    assert odds(p["c"]) == pytest.approx(PRIOR_ODDS * np.exp(2.0))


def test_others_share_the_probability_of_what_they_may_stand_for() -> None:
    one = effect_probabilities(
        [step(alternatives=(Alternative("a", 20.0, (), ("b",), 20.0),))], "ab"
    )
    assert one == pytest.approx({"a": 0.5, "b": 0.5})
    # Two that only together explain as much cost one unit more.
    two = (Alternative("a", 20.0, (), ("b", "c"), 20.0),)
    p = effect_probabilities([step(alternatives=two)], "abc")
    assert odds(p["a"]) == pytest.approx(np.e)
    assert p["b"] == p["c"] == pytest.approx(1 - p["a"])


def test_no_evidence_is_a_certainty() -> None:
    p = effect_probabilities([step({"a": 1e6, "b": -1e6})], "ab")
    assert odds(p["a"]) == pytest.approx(PRIOR_ODDS * np.exp(LARGEST - 1.0), rel=1e-2)
    assert 0.0 < p["b"] < 1e-12


def test_a_refinement_says_what_is_hidden() -> None:
    c = campaign("encoder_offset", "absolute", 1, poses=30)
    path = refine(baseline(c.cell, c.readings, "absolute"), c.readings, "absolute")
    p = path.probabilities(["encoder_offset", "backlash", "tracker_drift"])
    assert p["encoder_offset"] > 0.5 > max(p["backlash"], p["tracker_drift"])
