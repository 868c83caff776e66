"""Evidence of a family against the marginal likelihood in dense algebra, and chains of families."""

import numpy as np
import pytest

from hilcal.regression.evidence import NOTHING, STRENGTHS, score_family, visible
from hilcal.regression.forward_selection import CandidateFamilies, forward_selection
from hilcal.types import Floats
from tests.support.regression_cases import KINDS, Problem, problem

DOF = 53.0


def score(of: Problem, x: Floats | None = None):
    x = of.x if x is None else x
    r = of.dense @ of.y
    return score_family(x.T @ of.dense @ x, x.T @ r, float(of.y @ r), DOF)


def marginal(of: Problem, variance: Floats) -> float:
    """ln p(y) to a constant: covariance M⁻¹ + X diag(variance) Xᵀ, noise factor integrated out.

    The model's parameters without a prior would make M singular, so all have one.
    """
    c = np.linalg.inv(of.dense) + (of.x * variance) @ of.x.T
    quadratic = float(of.y @ np.linalg.solve(c, of.y))
    return -0.5 * float(np.linalg.slogdet(c)[1]) - 0.5 * DOF * float(np.log(quadratic))


def with_priors(family: int = 4, noise: float = 1.0) -> Problem:
    of = problem("priors", family=family, noise=noise)
    return Problem(of.rows, np.full(len(of.ridge), 2.0), of.x, of.y)


def test_it_is_the_ratio_of_marginal_likelihoods_where_that_is_largest() -> None:
    of = with_priors()
    found = score(of)
    rss = float(of.y @ of.dense @ of.y)
    size = of.x.shape[1]
    ratios = [
        marginal(of, np.full(size, tau**2 * DOF / rss)) - marginal(of, np.zeros(size))
        for tau in STRENGTHS
    ]
    assert found.log_evidence == pytest.approx(max(ratios), rel=1e-10)
    assert found.log_evidence > 5
    assert found.strength == STRENGTHS[int(np.argmax(ratios))]
    assert found.ridge == pytest.approx(rss / (DOF * found.strength**2), rel=1e-12)


@pytest.mark.parametrize("kind", ["flat", "priors", "no columns"])
def test_posterior_mean_and_scale_are_those_of_ridge_regression(kind: str) -> None:
    of = problem(kind)
    found = score(of)
    h = of.x.T @ of.dense @ of.x + found.ridge * np.eye(of.x.shape[1])
    mean = np.linalg.solve(h, of.x.T @ of.dense @ of.y)
    np.testing.assert_allclose(found.step, mean, rtol=1e-10)
    left = float(of.y @ of.dense @ (of.y - of.x @ mean)) / DOF
    np.testing.assert_allclose(found.root @ found.root.T, left * np.linalg.inv(h), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_common_factor_of_the_noise_changes_no_evidence(kind: str) -> None:
    """Columns and data in units of another noise: only the prior's strength is moved."""
    of = problem(kind)
    louder = Problem(of.rows, of.ridge, of.x, 3 * of.y)
    one, other = score(of), score(louder)
    assert other.p_value == pytest.approx(one.p_value, rel=1e-9)
    # τ is tried on a grid of steps of a fifth of a decade.
    assert other.log_evidence == pytest.approx(one.log_evidence, abs=0.02 * of.x.shape[1])


def test_directions_that_cannot_be_seen_count_for_nothing() -> None:
    of = problem("rank deficient")
    assert of.x.shape[1] == 6
    assert score(of).rank == 4
    assert score(of, 1e-4 * of.x) is NOTHING
    assert list(visible(np.array([-1e-3, 1e-5, 1.0]))) == [False, False, True]


def test_evidences_of_a_chain_add_up() -> None:
    """ln p(y | all) − ln p(y | none), each family with the strength that it was added with."""
    of = with_priors(family=6)
    columns = {"a": slice(0, 2), "b": slice(2, 3), "c": slice(3, 6)}
    r = of.dense @ of.y
    start = CandidateFamilies(
        of.projection.information(of.x), of.x.T @ r, float(of.y @ r), DOF, columns
    )
    variance, total, names = np.zeros(6), 0.0, []
    for step in forward_selection(start, 9):
        variance[columns[step.name]] = 1 / step.score.ridge
        total += step.score.log_evidence
        names.append(step.name)
        expected = marginal(of, variance) - marginal(of, np.zeros(6))
        assert total == pytest.approx(expected, rel=1e-9)
        after = step.after
        assert after.spent == pytest.approx(step.before.spent + step.score.effective)
    assert sorted(names) == ["a", "b", "c"]
    scores = start.scores()
    assert names[0] == max(scores, key=lambda n: scores[n].log_evidence)
    assert set(start.without(["a"]).columns) == {"b", "c"}
