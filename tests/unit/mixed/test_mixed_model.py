"""The mixed model against dense formulas, finite differences, and its own sampling spread."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import kstest

from hilcal.mixed.equations import _ByColumns, _ByRows, equations, left_out
from hilcal.mixed.families import Families, Family, LogStdPrior
from hilcal.mixed.problem import Noise, independent_rows, mixed_problem
from hilcal.mixed.variances import coordinates_covariance, estimate_variances, evidence

FLAT = LogStdPrior(0.0, 3.0)


def family(name, start, count, prior=FLAT):
    return Family(name, name, np.arange(start, start + count), np.linspace(0.5, 2.0, count), prior)


def problem(rng, groups=12, *, scatter=True, over=0):
    """A small problem: frames of four columns of which three count, families of 3 and 5 + over."""
    rows = 3 * groups
    jacobian = rng.standard_normal((rows, 12 + over))
    jacobian[:, 3] = jacobian[:, 0] + jacobian[:, 1]
    families = Families(np.arange(4), (family("a", 4, 3), family("b", 7, 5 + over)))
    noise = [instrument(rows)]
    if scatter:
        variance = rng.standard_normal(rows).clip(0.0) ** 2
        noise.append(Noise("scatter", variance, LogStdPrior(0.0, 1.5)))
    y = rng.standard_normal(rows) * 2 + jacobian @ rng.standard_normal(12 + over)
    return mixed_problem(y, jacobian, families, noise)


def instrument(rows, spread=1.5):
    return Noise("instrument", np.ones(rows), LogStdPrior(0.0, spread))


def dense(p, x):
    """ℓ from V = Σ s² Z D Zᵀ + R itself, BLUP coordinates, P, and their errors' covariance."""
    q, z = p.x[:, : p.flat], p.x[:, p.flat :]
    scale = np.exp(x)[p.family]
    etas = x[len(p.families.random) :]
    r = sum(np.exp(2 * eta) * np.diag(n.variance) for n, eta in zip(p.noise, etas, strict=True))
    v = r + (z * scale**2) @ z.T
    vi = np.linalg.inv(v)
    inner = q.T @ vi @ q
    left = vi - vi @ q @ np.linalg.solve(inner, q.T @ vi)
    ll = -0.5 * (np.linalg.slogdet(v)[1] + np.linalg.slogdet(inner)[1] + p.y @ left @ p.y)
    b = np.linalg.solve(inner, q.T @ vi @ p.y)
    henderson = p.x.T @ np.linalg.solve(r, p.x)
    henderson += np.diag(np.concatenate([np.zeros(p.flat), scale**-2.0]))
    coordinates = np.concatenate([b, scale**2 * (z.T @ left @ p.y)])
    return ll, coordinates, left, np.linalg.inv(henderson)


@pytest.mark.parametrize(("over", "form"), [(0, _ByColumns), (60, _ByRows)])
@pytest.mark.parametrize("scatter", [True, False])
def test_they_are_those_of_the_whole_covariance(scatter, over, form):
    rng = np.random.default_rng(1)
    p = problem(rng, scatter=scatter, over=over)
    at = [0.3 * rng.standard_normal(len(p.priors)) for _ in range(3)]
    first, *others = (equations(p, x) for x in at)
    assert isinstance(first.projection, form)
    ll, coordinates, left, covariance = dense(p, at[0])
    np.testing.assert_allclose(first.coordinates, coordinates, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(first.covariance, covariance, rtol=1e-8, atol=1e-10)
    for e, x in zip(others, at[1:], strict=True):  # up to the constant
        gain = e.log_likelihood - first.log_likelihood
        assert gain == pytest.approx(dense(p, x)[0] - ll, rel=1e-9)
    columns = rng.standard_normal((len(p.y), 2))
    inner, score = first.score(columns)
    np.testing.assert_allclose(inner, columns.T @ left @ columns, rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(score, columns.T @ left @ p.y, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("over", [0, 60])
@pytest.mark.parametrize("scatter", [True, False])
def test_slopes_are_finite_differences(scatter, over):
    rng = np.random.default_rng(2)
    p = problem(rng, scatter=scatter, over=over)
    x, step = 0.3 * rng.standard_normal(len(p.priors)), 1e-5

    def along(value):
        out = []
        for k in range(len(x)):
            ends = []
            for sign in (1, -1):
                moved = x.copy()
                moved[k] += sign * step
                ends.append(np.asarray(getattr(equations(p, moved), value)))
            out.append((ends[0] - ends[1]) / (2 * step))
        return out

    e = equations(p, x)
    np.testing.assert_allclose(e.slope, along("log_likelihood"), rtol=1e-5, atol=1e-6)
    moved = np.stack(along("coordinates"), axis=1)
    np.testing.assert_allclose(e.sensitivity, moved, rtol=1e-4, atol=1e-6)


def test_the_average_information_is_the_mean_of_observed_and_expected():
    rng = np.random.default_rng(3)
    p = problem(rng, over=0)
    x = 0.3 * rng.standard_normal(len(p.priors))
    left = dense(p, x)[2]
    z = p.x[:, p.flat :]
    parts = [np.exp(2 * x[f]) * z[:, p.family == f] @ z[:, p.family == f].T for f in range(2)]
    y = left @ p.y
    for i in range(2):
        for j in range(2):
            expected = 2.0 * y @ parts[i] @ left @ parts[j] @ y
            assert equations(p, x).information[i, j] == pytest.approx(expected, rel=1e-8)


def drawn(rng, stds, noise, groups, prior=FLAT, *, turned=False):
    """A problem with families of known standard deviations, fresh rows, and what they truly are."""
    rows = rng.standard_normal((3 * groups + 40, 27))
    rows[:, 3] = rows[:, 0] + rows[:, 1]
    both = (family("a", 4, 3, prior), family("b", 7, 20, prior))
    families = Families(np.arange(4), both[::-1] if turned else both)
    u = 5.0 * rng.standard_normal(27)
    for f, s in zip(both, stds, strict=True):
        u[f.parameters] = s * f.magnitude * rng.standard_normal(len(f.parameters))
    true = rows @ u
    measured, fresh = rows[:-40], rows[-40:, None]
    y = true[:-40] + noise * rng.standard_normal(len(measured))
    made = mixed_problem(y, measured, families, [instrument(len(y))])
    return made, fresh, true[-40:, None]


def test_standard_deviations_are_found_where_the_rows_tell_them():
    rng = np.random.default_rng(4)
    log_std = np.array(
        [estimate_variances(drawn(rng, (1.0, 0.5), 0.3, 60)[0]).log_std for _ in range(40)]
    )
    true = np.log([1.0, 0.5, 0.3])
    spread = log_std.std(axis=0) / np.sqrt(len(log_std))
    assert np.all(np.abs(log_std.mean(axis=0) - true) < 4 * spread + 0.1 * np.array([3, 1, 0]))
    # the family of three is skewed downwards: half a third of a χ² with three degrees of freedom


def predict(variances, jacobian):
    """The best linear unbiased prediction of rows that were not measured, and its covariance."""
    x = variances.equations.problem.coordinates(jacobian)
    covariance = coordinates_covariance(variances)
    return x @ variances.equations.coordinates, x @ covariance @ np.swapaxes(x, -1, -2)


@pytest.mark.parametrize("groups", [8, 12])
def test_bands_hold_what_they_say_with_few_rows(groups):
    rng = np.random.default_rng(5)
    inside = total = 0
    for _ in range(60):
        made, fresh, true = drawn(rng, (1.0, 0.3), 0.3, groups)
        mean, covariance = predict(estimate_variances(made), fresh)
        off = np.abs(mean - true) / np.sqrt(covariance[..., 0, 0])[:, None]
        inside, total = inside + int(np.sum(off < 1.96)), total + off.size
    assert 0.92 < inside / total < 0.98


@pytest.mark.long
def test_p_values_are_uniform_where_nothing_is_there_and_small_where_it_is():
    rng = np.random.default_rng(6)
    null = [evidence(drawn(rng, (1.0, 0.0), 0.3, 20)[0], 1, rng).p_value for _ in range(100)]
    there = [evidence(drawn(rng, (1.0, 0.5), 0.3, 20)[0], 1, rng).p_value for _ in range(5)]
    assert max(there) < 0.01
    below = np.array([p for p in null if p < 0.4])  # above it there is the mass at ratio zero
    assert kstest(below / 0.4, "uniform").pvalue > 0.01
    assert abs(len(below) / len(null) - 0.4) < 0.13


def test_what_only_an_implausible_size_would_explain_is_not_likely():
    made = drawn(np.random.default_rng(6), (1.0, 0.5), 0.3, 20)[0]
    assert evidence(made, 1, np.random.default_rng(0)).p_value < 0.01
    assert evidence(made, 1, np.random.default_rng(0), largest=1e-3).p_value > 0.1


def test_a_family_that_others_span_has_no_evidence_of_its_own():
    rng = np.random.default_rng(7)
    p = problem(rng, scatter=False)
    jacobian = np.hstack([p.x, p.x[:, :2]])
    families = Families(np.arange(2), (family("a", 2, 9), family("same as frames", 11, 2)))
    again = mixed_problem(p.y, jacobian, families, p.noise)
    assert evidence(again, 1, rng) == evidence(again, 1, rng)
    assert (evidence(again, 1, rng).ratio, evidence(again, 1, rng).rank) == (0.0, 0)


def test_the_outcome_does_not_depend_on_the_order_of_families():
    (one, fresh, _), (two, _, _) = (
        drawn(np.random.default_rng(8), (1.0, 0.5), 0.3, 15, turned=t) for t in (False, True)
    )
    first, second = estimate_variances(one), estimate_variances(two)
    np.testing.assert_allclose(first.log_std[[1, 0, 2]], second.log_std, atol=0.01)
    for mean, other in zip(predict(first, fresh), predict(second, fresh), strict=True):
        np.testing.assert_allclose(mean, other, rtol=0.01, atol=0.01)


@pytest.mark.parametrize("over", [0, 60])
def test_the_likelihood_of_one_size_is_exact(over):
    rng = np.random.default_rng(9)
    p = problem(rng, scatter=True, over=over)
    at = 0.3 * rng.standard_normal(len(p.priors))
    sizes = np.linspace(-6.0, 4.0, 9)
    for family in range(2):
        gain = equations(p, at).profile(family, sizes)
        there = np.tile(at, (9, 1))
        there[:, family] = sizes
        exact = [equations(p, x).log_likelihood for x in there]
        np.testing.assert_allclose(
            gain, np.array(exact) - equations(p, at).log_likelihood, rtol=1e-6, atol=1e-6
        )


@pytest.mark.parametrize("over", [0, 60])
def test_rows_left_out_are_predicted_by_the_others(over):
    """Against the equations of the other rows, at the same variances."""
    rng = np.random.default_rng(12)
    p = problem(rng, scatter=True, over=over)
    at, fold = 0.3 * rng.standard_normal(len(p.priors)), rng.integers(0, 4, len(p.y))
    off, variance = left_out(equations(p, at), fold)
    for f in range(4):
        rows, others = fold == f, fold != f
        noise = tuple(replace(n, variance=n.variance[others]) for n in p.noise)
        e = equations(replace(p, y=p.y[others], x=p.x[others], noise=noise), at)
        np.testing.assert_allclose(off[rows], p.y[rows] - p.x[rows] @ e.coordinates, rtol=1e-6)
        noise_variance = equations(p, at).noise_std[rows] ** 2
        spread = np.einsum("ri,ij,rj->r", p.x[rows], e.covariance, p.x[rows])
        np.testing.assert_allclose(variance[rows], noise_variance + spread, rtol=1e-6)


def test_a_family_does_not_stay_small_where_the_iteration_began():
    """At a size of e⁻⁷ the likelihood has hardly a slope."""
    made, *_ = drawn(np.random.default_rng(10), (1.0, 0.5), 0.3, 60)
    usual = estimate_variances(made)
    begun = np.array([-7.0, -7.0, 0.5])
    assert np.abs(equations(made, begun).slope[:2]).max() < 0.1
    variances = estimate_variances(made, begun, search=True)
    np.testing.assert_allclose(variances.log_std, usual.log_std, atol=0.05)


def test_no_size_is_sought_beyond_the_plausible_ones():
    """A direction that the rows hardly show fits a misfit with a size that no arm has."""
    rng = np.random.default_rng(12)
    rows = 300
    jacobian = np.hstack([np.ones((rows, 1)), rng.standard_normal((rows, 6))])
    jacobian[:, 6] *= 1e-3
    sizes = np.array([1.0, 1.2, -0.9, 0.8, -1.1, 1e4])
    y = jacobian[:, 1:] @ sizes + 0.5 * rng.standard_normal(rows)
    stated = {}
    for largest in (np.inf, 6.0):
        one = replace(family("a", 1, 6), magnitude=np.ones(6), largest=largest)
        made = mixed_problem(y, jacobian, Families(np.arange(1), (one,)), [instrument(rows)])
        stated[largest] = estimate_variances(made, np.array([0.0, 0.0]), search=True).std("a")
    assert stated[np.inf] > 1000.0
    assert 0.5 < stated[6.0] < 6.0


def test_rows_are_turned_so_that_blocks_of_noise_are_diagonal():
    rng = np.random.default_rng(11)
    half = rng.standard_normal((4, 5, 2))  # of a rank below that of the rows
    half[1, 3:] = half[2, :1] = 0.0
    observed = np.ones((4, 5), dtype=np.bool_)
    observed[1, 3:] = observed[2, :1] = False
    covariance = half @ np.swapaxes(half, 1, 2)
    u, variance = independent_rows(covariance, observed)
    turned = np.swapaxes(u, 1, 2) @ covariance @ u
    expected = np.einsum("gs,st->gst", np.where(variance < -0.5, 0.0, variance), np.eye(5))
    np.testing.assert_allclose(turned, expected, atol=1e-12)
    for g in range(4):  # a row that is not seen is none of a sum of others
        apart = np.abs(u[g][:, variance[g] < -0.5])
        np.testing.assert_allclose(np.sort(apart.max(axis=0, initial=0.0)), 1.0)
        assert apart[observed[g]].max(initial=0.0) < 1e-12


def test_compressed_rows_of_white_noise_say_the_same():
    p = problem(np.random.default_rng(3), scatter=False)
    unmeasured = Noise("instrument", np.append(p.noise[0].variance, 0.0), p.noise[0].prior)
    p = replace(p, y=np.append(p.y, 0.0), x=np.vstack([p.x, np.zeros(p.x.shape[1])]))
    p = replace(p, noise=(unmeasured,))
    small = p.compressed()
    assert small.x.shape == (p.x.shape[1] + 1, p.x.shape[1])
    x = np.array([0.3, -0.8, 0.4])
    a, b = equations(p, x), equations(small, x)
    for quantity in ("log_likelihood", "slope", "information", "coordinates", "sensitivity"):
        np.testing.assert_allclose(getattr(b, quantity), getattr(a, quantity), rtol=1e-7)
    whole, compressed = estimate_variances(p), estimate_variances(small)
    np.testing.assert_allclose(compressed.log_std, whole.log_std, atol=1e-6)
    np.testing.assert_allclose(
        evidence(small, 0, np.random.default_rng(0)).ratio,
        evidence(p, 0, np.random.default_rng(0)).ratio,
        rtol=1e-5,
    )


def test_rows_with_two_kinds_of_noise_are_not_compressed():
    p = problem(np.random.default_rng(3))
    assert p.compressed() is p
