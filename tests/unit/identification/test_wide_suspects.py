"""Columns of wide suspects, by their factors, are those of the Jacobian."""

from dataclasses import replace

import numpy as np
import pytest

from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.identification import wide_suspects
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import columns_in_parts, columns_of_each, effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.identification.wide_suspects import WideColumns
from hilcal.readings.whitening import Mode
from hilcal.regression.factored import gram
from tests.support.campaigns import campaign

POSES = 36


@pytest.fixture(autouse=True)
def small_ones_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wide_suspects, "LEAST_NUMBERS", 0)


def fitted(mode: Mode, m: int = 3, kept: slice | None = None) -> Fit:
    c = campaign("hysteresis", mode, poses=POSES, m=m)
    readings = c.readings if kept is None else c.readings[kept]
    return fit(baseline(c.cell, readings, mode), readings, mode)


@pytest.mark.parametrize(("mode", "m"), [("absolute", 3), ("deflection", 3), ("absolute", 6)])
def test_factors_are_those_of_the_jacobian(mode: Mode, m: int) -> None:
    found = fitted(mode, m)
    effects = candidates(found)
    (part,) = columns_in_parts(found, effects)
    (wide,) = (of for of in part if isinstance(of.of_readings, WideColumns))
    assert wide.effect.name == "transmission_error"
    assert isinstance(wide.of_readings, WideColumns)
    groups = wide.of_readings.white.direction
    assert len(groups) == POSES  # readings of one pose share their values
    s, w = found.solution, found.whitening
    jacobian = found.model.jacobian_of((wide.effect,), s.prediction, s.theta, m) * wide.scale
    white = w.whiten(w.raw(jacobian))
    close = {"rtol": 1e-9, "atol": 1e-11 * np.abs(white).max()}
    np.testing.assert_allclose(wide.white, white, **close)
    np.testing.assert_allclose(gram(wide.tall), white.T @ white, rtol=1e-9, atol=1e-7)
    np.testing.assert_allclose(wide.motion, w.raw(jacobian)[:, :3], rtol=1e-9, atol=1e-15)
    unloaded = jacobian[found.readings.unloaded, :3]
    np.testing.assert_allclose(wide.unloaded, unloaded, rtol=1e-9, atol=1e-15)
    alone = effect_columns(found, wide.effect)
    np.testing.assert_allclose(alone.white, white, **close)


@pytest.mark.parametrize("mode", ["absolute", "deflection"])
def test_scores_do_not_depend_on_factors(mode: Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    found = fitted(mode)
    p, effects = linearise(found), candidates(found)
    by_factors = rank_suspects(p, effects, 1.0)
    monkeypatch.setattr(wide_suspects, "WIDE", 10_000)
    written = rank_suspects(p, effects, 1.0)
    assert [s.effect for s in by_factors] == [s.effect for s in written]
    for a, b in zip(by_factors, written, strict=True):
        assert (a.score.rank, a.score.strength) == (b.score.rank, b.score.strength)
        assert a.score.log_evidence == pytest.approx(b.score.log_evidence, rel=1e-9, abs=1e-9)
        assert a.holdout_share == pytest.approx(b.holdout_share, rel=1e-7, abs=1e-9)
        assert a.kept == pytest.approx(b.kept, rel=1e-7)


def test_values_that_differ_within_a_pose_are_not_factored() -> None:
    c = campaign("hysteresis", "deflection", poses=POSES)
    rng = np.random.default_rng(3)
    actual = c.readings.states.q + 1e-3 * rng.standard_normal(c.readings.states.q.shape)
    readings = replace(c.readings, states=replace(c.readings.states, q_actual=actual))
    found = fit(baseline(c.cell, readings, "deflection"), readings, "deflection")
    for of in columns_of_each(found, candidates(found)):
        assert not isinstance(of.of_readings, WideColumns)


def test_poses_with_other_numbers_of_readings_are_factored_reading_by_reading() -> None:
    found = fitted("absolute", kept=slice(2, None))
    (wide,) = (
        of
        for of in columns_of_each(found, candidates(found))
        if isinstance(of.of_readings, WideColumns)
    )
    assert isinstance(wide.of_readings, WideColumns)
    assert len(wide.of_readings.white.direction) == len(found.readings)
    s, w = found.solution, found.whitening
    jacobian = found.model.jacobian_of((wide.effect,), s.prediction, s.theta, 3) * wide.scale
    np.testing.assert_allclose(wide.white, w.whiten(w.raw(jacobian)), rtol=1e-9, atol=1e-9)
