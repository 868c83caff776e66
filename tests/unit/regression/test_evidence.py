"""Evidence, power and tail of a test against dense algebra and draws; chains; blocks of columns."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats
from scipy.stats import beta

from hilcal.regression.evidence import (
    NO_EVIDENCE,
    STRENGTHS,
    family_power,
    noncentrality_of_power,
    power_of_test,
    ratio_tail,
    score_family,
    visible,
)
from hilcal.regression.forward_selection import (
    BlockSelection,
    CandidateFamilies,
    block_evidence,
    forward_selection,
)
from tests.support.regression_cases import KINDS, Problem, problem

DOF = 53.0


def score(of, x=None):
    x = of.x if x is None else x
    r = of.dense @ of.y
    return score_family(x.T @ of.dense @ x, x.T @ r, float(of.y @ r), DOF)


def marginal(of, variance):
    """ln p(y) to a constant: covariance M⁻¹ + X diag(variance) Xᵀ, noise factor integrated out.

    The model's parameters without a prior would make M singular, so all have one.
    """
    c = np.linalg.inv(of.dense) + (of.x * variance) @ of.x.T
    quadratic = float(of.y @ np.linalg.solve(c, of.y))
    return -0.5 * float(np.linalg.slogdet(c)[1]) - 0.5 * DOF * float(np.log(quadratic))


def with_priors(family=4, noise=1.0):
    of = problem("priors", family=family, noise=noise)
    return Problem(of.rows, np.full(len(of.ridge), 2.0), of.x, of.y)


def test_it_is_the_ratio_of_marginal_likelihoods_where_that_is_largest():
    of = with_priors()
    result = score(of)
    rss = float(of.y @ of.dense @ of.y)
    size = of.x.shape[1]
    ratios = [
        marginal(of, np.full(size, tau**2 * DOF / rss)) - marginal(of, np.zeros(size))
        for tau in STRENGTHS
    ]
    assert result.log_evidence == pytest.approx(max(ratios), rel=1e-10)
    assert result.log_evidence > 5
    assert result.strength == STRENGTHS[int(np.argmax(ratios))]
    assert result.ridge == pytest.approx(rss / (DOF * result.strength**2), rel=1e-12)


@pytest.mark.parametrize("kind", ["flat", "priors", "no columns"])
def test_posterior_mean_and_scale_are_those_of_ridge_regression(kind):
    of = problem(kind)
    result = score(of)
    h = of.x.T @ of.dense @ of.x + result.ridge * np.eye(of.x.shape[1])
    mean = np.linalg.solve(h, of.x.T @ of.dense @ of.y)
    np.testing.assert_allclose(result.step, mean, rtol=1e-10)
    left = float(of.y @ of.dense @ (of.y - of.x @ mean)) / DOF
    np.testing.assert_allclose(result.root @ result.root.T, left * np.linalg.inv(h), rtol=1e-9)


@pytest.mark.parametrize("kind", KINDS)
def test_a_common_factor_of_the_noise_changes_no_evidence(kind):
    """Columns and data in units of another noise: only the prior's strength is moved."""
    of = problem(kind)
    louder = Problem(of.rows, of.ridge, of.x, 3 * of.y)
    one, other = score(of), score(louder)
    assert other.p_value == pytest.approx(one.p_value, rel=1e-9)
    # τ is tried on a grid of steps of a fifth of a decade.
    assert other.log_evidence == pytest.approx(one.log_evidence, abs=0.02 * of.x.shape[1])


def test_directions_that_cannot_be_seen_count_for_nothing():
    of = problem("rank deficient")
    assert of.x.shape[1] == 6
    assert score(of).rank == 4
    assert score(of, 1e-4 * of.x) is NO_EVIDENCE
    assert list(visible(np.array([-1e-3, 1e-5, 1.0]))) == [False, False, True]


def test_evidences_of_a_chain_add_up():
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


@pytest.mark.parametrize("rank", [1, 4, 20])
@pytest.mark.parametrize("level", [1e-5, 0.01])
def test_the_noncentrality_is_that_of_the_power(rank, level):
    value = noncentrality_of_power(rank, 60.0, level, 0.9)
    assert power_of_test(value, rank, 60.0, level) == pytest.approx(0.9, abs=1e-4)


def test_without_a_family_the_power_is_the_level_and_known_noise_is_the_limit():
    assert power_of_test(0.0, 3, 50.0, 0.01) == pytest.approx(0.01)
    few, many, known = (power_of_test(12.0, 3, rest, 0.01) for rest in (20.0, 1e6, np.inf))
    assert few < many == pytest.approx(known, rel=1e-4)
    assert family_power(np.zeros((2, 2)), np.ones(2), 0.01) == 0.01


def test_the_power_is_the_share_of_rejections():
    rng = np.random.default_rng(5)
    b, x = rng.standard_normal((30, 5)), rng.standard_normal((30, 3))
    beta = np.array([0.6, -0.4, 0.3])
    m = np.eye(30) - b @ np.linalg.pinv(b)
    promised = family_power(x.T @ m @ x, beta, 0.01, dof=25.0)
    y = m @ (x @ beta + rng.standard_normal((4000, 30))).T
    q = np.linalg.qr(m @ x)[0]
    gain, total = np.sum((q.T @ y) ** 2, axis=0), np.sum(y**2, axis=0)
    rejected = np.mean(gain / 3 / ((total - gain) / 22) > stats.f.isf(0.01, 3, 22))
    assert 0.2 < promised < 0.9
    assert abs(rejected - promised) < 4 * np.sqrt(promised * (1 - promised) / 4000)


def exact(k, dimension, level, c):
    """K equal eigenvalues: zᵀLz/zᵀz is `level` times a beta variable."""
    return float(beta.sf(c / level, k / 2, (dimension - k) / 2))


@pytest.mark.parametrize("k", [2, 5, 20, 80])
@pytest.mark.parametrize("dimension", [100, 400])
@pytest.mark.parametrize("level", [1.0, 1e-6, 3e4])
def test_equal_eigenvalues_are_a_beta_law(k, dimension, level):
    """A saddlepoint approximation is right to a few per cent of the tail, here checked to 5 %."""
    for p in (0.9, 0.5, 0.1, 1e-2, 1e-4, 1e-8, 1e-14):
        c = level * float(beta.isf(p, k / 2, (dimension - k) / 2))
        tail = ratio_tail(np.full(k, level), dimension, c)
        assert tail == pytest.approx(exact(k, dimension, level, c), rel=0.05)


@pytest.mark.parametrize("seed", range(4))
def test_unequal_eigenvalues_agree_with_monte_carlo(seed):
    rng = np.random.default_rng(seed)
    k, dimension, draws = 15, 60, 200_000
    values = rng.exponential(size=k) ** 2
    squares = rng.chisquare(1, (draws, k))
    rest = rng.chisquare(dimension - k, draws)
    ratio = (squares @ values) / (squares.sum(axis=1) + rest)
    for p in (0.8, 0.3, 0.05, 0.01, 1e-3):
        c = float(np.quantile(ratio, 1 - p))
        # 4 σ of the Monte-Carlo share, and 3 % of the approximation.
        slack = 4 * np.sqrt(p * (1 - p) / draws) + 0.03 * p
        assert ratio_tail(values, dimension, c) == pytest.approx(p, abs=slack)


@pytest.mark.long
@given(
    st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=12),
    st.integers(2, 300),
    st.floats(1e-6, 1e6),
)
def test_it_is_a_probability_that_falls_and_has_no_unit(values, extra, unit):
    eigenvalues = np.array(values)
    dimension = len(values) + extra
    at = np.linspace(0.0, 1.0, 60) * eigenvalues.max()
    tail = np.array([ratio_tail(eigenvalues, dimension, c) for c in at])
    assert np.all((tail >= 0) & (tail <= 1))
    assert tail[0] == 1
    assert tail[-1] == 0
    # Monotone but for the approximation's own error near the middle.
    assert np.all(np.diff(tail) <= 1e-3)
    scaled = [ratio_tail(unit * eigenvalues, dimension, unit * c) for c in at]
    np.testing.assert_allclose(scaled, tail, rtol=1e-4, atol=1e-7)


def test_the_deep_tail_falls_without_a_step():
    """Where probabilities are too small for ordinary arithmetic, logarithms take over."""
    values = np.array([1.0, 0.8, 0.5, 0.1])
    at = np.linspace(0.3, 0.99, 200)
    tail = np.array([ratio_tail(values, 300, c) for c in at])
    steps = np.diff(np.log(tail[tail > 0]))
    assert np.all(steps < 0)
    # The logarithm of a log-concave tail bends; it does not jump.
    assert np.abs(np.diff(steps)).max() < 0.25 * np.abs(steps).max()
    assert tail.min() < 1e-100


def test_nothing_to_test_is_no_evidence():
    assert ratio_tail(np.zeros(0), 10, 0.1) == 1.0
    assert ratio_tail(np.zeros(3), 10, 0.1) == 1.0
    assert ratio_tail(np.ones(3), 10, 0.0) == 1.0
    assert ratio_tail(np.ones(3), 10, 1.0) == 0.0


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_no_more_dimensions_than_eigenvalues_and_any_scale(scale):
    lam = scale * np.array([1e-9, 0.5, 1.0, 1.0, 2.0])
    drawn = np.random.default_rng(0).standard_normal((20000, 5)) ** 2
    ratio = (drawn @ lam) / drawn.sum(axis=1)
    for c in scale * np.array([0.3, 0.9, 1.4]):
        assert ratio_tail(lam, 4.0, c) == pytest.approx(np.mean(ratio > c), abs=0.02)
    assert ratio_tail(np.full(5, scale), 5.0, 0.5 * scale) == 1.0


TRIED = np.logspace(-2, 3, 21)
ROWS, MODEL, BLOCKS, WIDTH, FOLDS = 400, 12, 15, 4, 5


def chosen_by_columns(model, ridge, flat, x, y, most, least):
    """Whiten all columns by the covariance of the random part, and project them off the flat."""
    random = model[:, flat:] / np.sqrt(ridge[flat:])
    root = np.linalg.cholesky(np.eye(len(y)) + random @ random.T)
    b = np.linalg.qr(np.linalg.solve(root, model[:, :flat]))[0]
    blocks = np.linalg.solve(root, x.reshape(len(y), -1)).reshape(x.shape)
    r, dof = np.linalg.solve(root, y), len(y) - flat
    blocks, r = (
        blocks - np.tensordot(b, np.tensordot(b.T, blocks, axes=1), axes=1),
        r - b @ (b.T @ r),
    )
    chosen = []
    for _ in range(most):
        gram = np.einsum("rlv,rlw->lvw", blocks, blocks)
        g = np.einsum("rlw,r->lw", blocks, r)
        evidence = block_evidence(gram, g, float(r @ r), dof, TRIED)
        best = int(np.argmax(evidence))
        if evidence[best] < least:
            break
        chosen.append(best)
        u, s, _ = np.linalg.svd(blocks[:, best], full_matrices=False)
        u = u[:, s > 1e-3 * s[0]]
        blocks = blocks - np.tensordot(u, np.tensordot(u.T, blocks, axes=1), axes=1)
        r, dof = r - u @ (u.T @ r), max(dof - u.shape[1], 1)
    return chosen


def test_the_same_blocks_in_the_same_order():
    lengths = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        model, x = rng.normal(size=(ROWS, MODEL)), rng.normal(size=(ROWS, BLOCKS, WIDTH))
        x[:, 3] = x[:, 2] + 0.1 * x[:, 3]  # nearly the same block
        x[:, 5, 0] = model[:, 1]  # a column of the model
        ridge = np.where(np.arange(MODEL) < 6, 1e-6, 50.0)
        y = x[:, 2] @ rng.normal(size=WIDTH) + x[:, 7, 0] + x[:, 9, 1] + rng.normal(size=ROWS)
        y += model @ rng.normal(size=MODEL)
        fold = rng.integers(0, FOLDS, ROWS)
        selection = BlockSelection(model, ridge, x, y, fold, 6)
        for f in range(FOLDS):
            rest = fold != f
            expected = chosen_by_columns(model[rest], ridge, 6, x[rest], y[rest], 4, 8.0)
            assert selection.without(f, 4, 8.0, TRIED) == expected
            lengths.append(len(expected))
    assert min(lengths) >= 3


def test_nothing_is_chosen_of_noise():
    rng = np.random.default_rng(1)
    model, x = rng.normal(size=(ROWS, MODEL)), rng.normal(size=(ROWS, BLOCKS, WIDTH))
    y, fold = rng.normal(size=ROWS), np.arange(ROWS) % FOLDS
    selection = BlockSelection(model, np.full(MODEL, 1e-6), x, y, fold, MODEL)
    assert [selection.without(f, 4, 8.0, TRIED) for f in range(FOLDS)] == [[]] * FOLDS


def test_a_fold_that_the_sample_has_no_row_of_is_left_out_of_nothing():
    """As one pose read 12,000 times beside others: a sample of the rows misses whole poses."""
    rng = np.random.default_rng(0)
    model, x = rng.normal(size=(60, 2)), rng.normal(size=(60, 3, 2))
    y = x[:, 1, 0] + 0.1 * rng.normal(size=60)
    first = BlockSelection(model, np.ones(2), x, y, np.arange(60) % 3, 0)
    strengths = np.array([0.1, 1.0])
    assert first.without(3, 2, 3.0, strengths) == first.without(7, 2, 3.0, strengths) == [1]
