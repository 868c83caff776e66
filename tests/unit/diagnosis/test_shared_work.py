"""What parts of a judgement share is what each of them would compute by itself."""

import numpy as np
import pytest

from hilcal.diagnosis import residual_regression as regression
from hilcal.diagnosis.effect_ranking import candidates, most, rank_suspects, unloaded_readings
from hilcal.diagnosis.evidence import StepwiseAlternatives, backward_elimination
from hilcal.diagnosis.residual_regression import Regressions, residual_regression
from hilcal.diagnosis.stepwise import add
from hilcal.identification import effect_columns
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import columns_of_each
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import Linearisation, linearise
from tests.support.campaigns import campaign


@pytest.fixture(scope="module")
def found() -> Fit:
    c = campaign("hysteresis", "deflection", poses=12)
    return add(fit(baseline(c.cell, c.readings, c.mode), c.readings, c.mode), "encoder_offset")


@pytest.mark.parametrize("together", [0, 20_000, 8_000_000])
def test_columns_of_several_effects_are_those_of_each(
    found: Fit, together: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(effect_columns, "TOGETHER", together)
    effects = candidates(found)
    s, w = found.solution, found.whitening
    for effect, of in zip(effects, columns_of_each(found, effects), strict=True):
        assert of.effect is effect
        jacobian = found.model.jacobian_of((effect,), s.prediction, s.theta, w.m) * of.scale
        unloaded = jacobian[found.readings.unloaded, :3]
        np.testing.assert_allclose(of.unloaded, unloaded, rtol=1e-11, atol=1e-15)
        motion = w.raw(jacobian)[:, :3]
        np.testing.assert_allclose(of.motion, motion, rtol=1e-11, atol=1e-15)
        white = w.whiten_readings(jacobian)
        atol = 1e-12 * np.abs(white).max(initial=0.0)
        np.testing.assert_allclose(of.white, white, rtol=1e-9, atol=atol)


def test_scores_of_a_catalogue_are_those_of_each_effect_by_itself(found: Fit) -> None:
    p, effects, w = linearise(found), candidates(found), found.whitening
    ranked = {s.effect: s.score for s in rank_suspects(p, effects)}
    bare = unloaded_readings(found)
    for of in columns_of_each(found, effects):
        jacobian = found.model.jacobian_of((of.effect,), found.solution.prediction, found.theta, 3)
        x = w.whiten(w.raw(jacobian)) * of.scale
        score = p.score(x, x.T @ p.project_out(x), most(of, bare))
        together = ranked[of.effect.name]
        assert (together.rank, together.strength) == (score.rank, score.strength)
        assert together.log_evidence == pytest.approx(score.log_evidence, rel=1e-9, abs=1e-9)
        assert together.gain == pytest.approx(score.gain, rel=1e-9, abs=1e-9)
        assert together.p_value == pytest.approx(score.p_value, rel=1e-6)


def test_the_residual_of_a_fit_is_regressed_once(
    found: Fit, monkeypatch: pytest.MonkeyPatch
) -> None:
    alone = residual_regression(linearise(found))
    grown: list[float] = []
    trees = regression.tree_share

    def counted(p: Linearisation, beyond: float) -> float:
        grown.append(beyond)
        return trees(p, beyond)

    monkeypatch.setattr(regression, "tree_share", counted)
    made = Regressions()
    first = made.of(linearise(found))
    assert (first.share, len(first.dependences)) == (alone.share, len(alone.dependences))
    assert made.of(linearise(found)) is first
    assert made.tree_share(linearise(found), 0.5) == made.tree_share(linearise(found), 0.5)
    assert len(grown) == len(set(grown))
    assert 0.5 in grown


def test_redundant_effects_by_scores_that_the_alternatives_made(found: Fit) -> None:
    algebra = StepwiseAlternatives(found)
    algebra.of("encoder_offset")
    by_itself, shared = (backward_elimination(found, k) for k in ({}, algebra.eliminated))
    assert "encoder_offset" in algebra.eliminated
    assert list(by_itself) == list(shared)
    for name, one in by_itself.items():
        assert one.p_value == pytest.approx(shared[name].p_value, rel=1e-9)
