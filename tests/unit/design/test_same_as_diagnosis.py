"""The planner's information, power and estimates are the diagnosis's, on the same campaign."""

import numpy as np
import pytest

from hilcal.design.discriminated_pairs import LEVEL, discriminated_pairs, estimate, pair_of, power
from hilcal.design.information import DesignProblem, problem
from hilcal.design.nominal_model import after
from hilcal.diagnosis.effect_ranking import candidates, rank_suspects
from hilcal.identification.baseline import baseline
from hilcal.identification.effect_columns import effect_columns
from hilcal.identification.fit import Fit, fit
from hilcal.identification.linearisation import linearise
from hilcal.readings.whitening import Mode
from hilcal.regression.evidence import family_power
from hilcal.regression.projection import projection
from hilcal.regression.schur import schur_complement
from hilcal.types import Floats
from tests.support.campaigns import campaign
from tests.support.plan_cases import config_of, poses_of

TILT, LINK = "joint_tilt_compliance", "link_compliance"
MODES: tuple[Mode, ...] = ("deflection", "absolute")


def case(mode: Mode) -> tuple[Fit, DesignProblem]:
    """A fit without tilting joints, which are there, and the design problem after it."""
    c = campaign(TILT, mode, 3, poses=10, strength=2.0, plan_seed=21)
    model = baseline(c.cell, c.readings, mode)
    found = fit(model, c.readings, mode)
    # A fit keeps the rows of its last linearisation, a negligible step before its minimum; those of
    # one that begins there are of the minimum, as the plan's are.
    found = fit(model, c.readings, mode, start=found.theta)
    config = config_of(mode, against=(TILT, LINK))
    return found, problem(after(found, config), config, poses_of(8, 21))


def columns(of: DesignProblem, found: Fit) -> dict[str, Floats]:
    """Whitened columns of the families in the units of the design problem."""
    each = {e.name: effect_columns(found, e) for e in of.families}
    return {n: c.white * (of.scale[of.of_effect(n)] / c.scale) for n, c in each.items()}


@pytest.mark.parametrize("mode", MODES)
def test_information_beside_the_model_and_power_beside_model_and_rival(mode: Mode) -> None:
    found, of = case(mode)
    linear, x = linearise(found), columns(of, found)
    so_far = discriminated_pairs(of).prior
    model = np.arange(of.model_size)
    for name, white in x.items():
        planned = schur_complement(so_far, of.of_effect(name), model)
        tested = linear.information(white)
        np.testing.assert_allclose(planned, tested, rtol=0, atol=1e-12 * np.abs(tested).max())
    beta = np.full(x[TILT].shape[1], 0.5)
    ridge = np.concatenate([linear.projection.ridge, np.zeros(x[LINK].shape[1])])
    with_rival = projection(np.hstack([linear.rows, x[LINK]]), ridge)
    promised = power(pair_of(of, (TILT, LINK), beta), so_far)
    assert promised == pytest.approx(
        family_power(with_rival.information(x[TILT]), beta, LEVEL), rel=1e-10
    )
    assert 2 * LEVEL < promised < 0.9


@pytest.mark.parametrize("mode", MODES)
def test_evidence_and_estimates_of_suspects(mode: Mode) -> None:
    found, of = case(mode)
    linear = linearise(found)
    ranked = {s.effect: s.score for s in rank_suspects(linear, candidates(found))}
    for family in of.families:
        made, score = estimate(linear, family), ranked[family.name]
        assert made is not None
        assert made.log_evidence == pytest.approx(score.log_evidence, rel=1e-12)
        scale = np.array([p.scale for p in family.parameters])
        np.testing.assert_allclose(made.mean, scale * score.step, rtol=1e-10)
        assert made.supported
