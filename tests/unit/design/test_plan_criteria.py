"""Criteria of plans: derivatives, concavity, bounds, and what they mean."""

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilcal.design.approximate_design import BarrierProgram, relax
from hilcal.design.criteria import D, E, K, MeanVariance, Separate
from hilcal.design.criterion import CandidateSet, Objective, Pair
from hilcal.design.optimum import best_design
from hilcal.errors import CannotAnswerError
from tests.support.refusals import refusal, refusal_of

P = 6


def few_poses():
    """Of rank 2, as that of few test poses is."""
    root = np.random.default_rng(5).normal(size=(2, P))
    return root.T @ root


def pairs():
    return (
        Pair(np.array([0, 1]), np.array([1.0, -0.5]), np.array([2, 3, 4])),
        Pair(np.array([4]), np.array([2.0]), np.array([2, 3, 0, 1])),
        Pair(np.array([5]), np.array([1.0]), np.array([2, 3])),
    )


def compound_variance():
    """Of prediction poses at which the first four of the parameters count."""
    root = np.random.default_rng(6).normal(size=(2, 4))
    c = np.zeros((P, P))
    c[:4, :4] = root.T @ root
    return MeanVariance(0.7 * c, "A", 1.9 * c[:4, :4])


CRITERIA = {
    "D": D(),
    "A": MeanVariance(np.eye(P) / P, "A"),
    "A of some": MeanVariance(np.diag([1.0, 0.0, 1.0, 0.0, 0.0, 1.0]) / 3, "A"),
    "I": MeanVariance(few_poses()),
    "E": E(),
    "K": K(),
    "E of some": E(np.array([0, 2, 5])),
    "separate": Separate(pairs()),
    "compound variance": compound_variance(),
    "compound determinant": D(4),
}
seeds = st.integers(0, 10**6)
every = pytest.mark.parametrize("name", CRITERIA)


def information(rng, rows=12):
    """A regular information matrix of parameters of different size."""
    a = rng.normal(size=(rows, P)) * np.exp(rng.uniform(-1, 1, P))
    return np.asarray(a.T @ a)


def test_compound_criteria_are_means_of_both_efficiencies():
    m = information(np.random.default_rng(4))
    volume = np.sqrt(np.linalg.det(m) ** (1 / P) * np.linalg.det(m[:4, :4]) ** (1 / 4))
    assert float(D(4).value(m)) == pytest.approx(volume)
    both = compound_variance()
    c = both.c / 0.7
    q = 0.7 * np.trace(c @ np.linalg.inv(m))
    q += 1.9 * np.trace(c[:4, :4] @ np.linalg.inv(m[:4, :4]))
    assert float(both.value(m)) == pytest.approx(1 / q)


@pytest.mark.parametrize("name", CRITERIA)
@given(seeds, st.floats(1e-4, 1.0))
def test_bound_holds_for_any_information(name, seed, order):
    """Also for singular matrices, whatever the surrogate's order."""
    criterion = CRITERIA[name]
    rng = np.random.default_rng(seed)
    m = information(rng)
    s = criterion.surrogate(m, order)(m)
    for rows in (3, 7, 30):
        n = information(rng, rows)
        bound = np.sum(s.above * n)
        if s.below is not None:
            bound /= np.sum(s.below * n)
        assert float(criterion.value(n)) <= bound * (1 + 1e-9)
    if name in ("D", "A", "I"):  # exact at M itself
        assert np.sum(s.above * m) == pytest.approx(float(criterion.value(m)), rel=1e-9)


@every
def test_gradient_and_curvature_are_differences_of_the_surrogate(name):
    units = random_units(3, 6, P)
    program = BarrierProgram(asked(units, CRITERIA[name], np.eye(P)), 9.0, np.inf)
    w, step = np.linspace(0.5, 1.5, 6), 1e-5
    surrogate = CRITERIA[name].surrogate(program.information(w), 0.2)

    def slopes(weight):
        smooth = surrogate(program.information(weight))
        return smooth.value, np.sum(units.rows @ smooth.gradient * units.rows, axis=(1, 2))

    here = surrogate(program.information(w))
    gradient, curvature = slopes(w)[1], program.curvature(here)
    for k, change in enumerate(step * np.eye(6)):
        (a, up), (b, down) = slopes(w + change), slopes(w - change)
        assert (a - b) / (2 * step) == pytest.approx(gradient[k], rel=1e-5, abs=1e-8)
        largest = np.abs(curvature).max()
        assert (down - up) / (2 * step) == pytest.approx(curvature[k], abs=1e-5 * largest)


@pytest.mark.parametrize("twice", [False, True])
def test_separation_is_what_a_fit_leaves(twice):
    """The sum of squares that a fit of the nuisance leaves; also where it is not unique."""
    rng = np.random.default_rng(8)
    a = rng.normal(size=(20, P))
    if twice:
        a[:, 3] = 2 * a[:, 2]
    criterion = Separate(pairs())
    left = []
    for pair in criterion.pairs:
        signal = a[:, pair.effect] @ pair.beta
        fit = np.linalg.lstsq(a[:, pair.nuisance], signal, rcond=None)[0]
        left.append(np.sum((signal - a[:, pair.nuisance] @ fit) ** 2))
    assert criterion.parts(a.T @ a) == pytest.approx(left, rel=1e-8)
    assert float(criterion.value(a.T @ a)) == pytest.approx(min(left), rel=1e-8)
    for pair, expected in zip(criterion.pairs, left, strict=True):
        u = pair.residual(a.T @ a)
        assert np.sum((a @ u) ** 2) == pytest.approx(expected, rel=1e-8)


def test_says_which_parameters_nothing_determines():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(30, 3)) * [1.0, 1e3, 1e-3]
    names = ("j1", "j2", "offset")
    require = D().require
    require(a.T @ a, names)  # differences in size are no matter
    blind = a * [1, 0, 1]
    refusal_of(CannotAnswerError, "changes with j2;", require, blind.T @ blind, names)
    same = a.copy()
    same[:, 2] = 1e-4 * same[:, 0]
    with pytest.raises(CannotAnswerError, match=r"separates (j1, offset|offset, j1);"):
        require(same.T @ same, names)
    refusal_of(CannotAnswerError, "parameter 2", require, blind.T @ blind, None)
    alike = Separate((Pair(np.array([0]), np.ones(1), np.array([1, 2]), ("backlash", "drift")),))
    message = "separates backlash from drift"
    refusal_of(CannotAnswerError, message, alike.require, same.T @ same, names)
    alike.require(a.T @ a, names)


OF_TWO = np.array([[2.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.0]])
"""Of two parameters, with a third that may be there."""
OF_THREE = {
    "D": D(),
    "A": MeanVariance(np.eye(3) / 3, "A"),
    "A of some": MeanVariance(np.diag([0.5, 0.5, 0.0]), "A"),
    "I": MeanVariance(np.outer([1.0, 2.0, -1.0], [1.0, 2.0, -1.0])),
    "compound variance": MeanVariance(OF_TWO, "A", 2.0 * OF_TWO[:2, :2]),
    "compound determinant": D(2),
    "E": E(),
    "K": K(),
    "E of some": E(np.array([0, 1])),
    "separate": Separate(
        (
            Pair(np.array([0]), np.ones(1), np.array([1])),
            Pair(np.array([1]), np.ones(1), np.array([2])),
            Pair(np.array([2]), np.full(1, 2.0), np.array([0, 1])),
        )
    ),
}
QUICK = {"D of some", "I", "compound determinant", "E"}
"""One of each kind; the others are long."""
every_of_three = pytest.mark.parametrize(
    "name", [pytest.param(c, marks=() if c in QUICK else pytest.mark.long) for c in OF_THREE]
)


def polynomial(degree, points):
    """Readings of a polynomial at points, one row each."""
    rows = np.vander(points, degree + 1, increasing=True)
    return CandidateSet(rows[:, None, :], np.ones(len(points)))


def random_units(seed, count, size=3, costs=False):
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(count, 2, size))
    rows[rng.random(count) < 0.3, 1] = 0.0  # units of fewer rows
    return CandidateSet(rows, rng.integers(1, 4, count).astype(float) if costs else np.ones(count))


def asked(units, criterion, prior=None):
    return Objective(units, criterion, np.zeros((units.size,) * 2) if prior is None else prior)


def at(points, found):
    """Shares of the weight by point, without what is near 0."""
    total = found.weight.sum()
    shares = {float(points[k]): w / total for k, w in zip(found.index, found.weight, strict=True)}
    return {x: w for x, w in shares.items() if w > 1e-3}


def prior_of(seed, size=3):
    root = np.random.default_rng(seed + 1).normal(size=(2, size))
    return root.T @ root


def largest(criterion, units, weights, prior):
    """The best of many plans (N, K)."""
    each = np.swapaxes(units.rows, 1, 2) @ units.rows
    return float(criterion.value(prior + np.tensordot(weights, each, axes=1)).max())


AT_2 = [1.0, 2.0, 4.0]
BEYOND_A_LINE = Pair(np.array([2]), np.ones(1), np.array([0, 1]))
GRID = np.linspace(-1, 1, 201)
LEGENDRE = np.sort(np.concatenate([GRID, [-np.sqrt(0.2), np.sqrt(0.2)]]))


@pytest.mark.parametrize(
    ("criterion", "degree", "expected"),
    [
        (D(), 2, {-1: 1 / 3, 0: 1 / 3, 1: 1 / 3}),
        (D(), 3, {-1: 1 / 4, -np.sqrt(0.2): 1 / 4, np.sqrt(0.2): 1 / 4, 1: 1 / 4}),
        (MeanVariance(np.eye(3) / 3), 2, {-1: 1 / 4, 0: 1 / 2, 1: 1 / 4}),
        (E(), 2, {-1: 1 / 5, 0: 3 / 5, 1: 1 / 5}),
        # the highest coefficient: Chebyshev points (Kiefer & Wolfowitz 1959)
        (MeanVariance(np.diag([0.0, 0.0, 1.0])), 2, {-1: 1 / 4, 0: 1 / 2, 1: 1 / 4}),
        # the value at 2: Chebyshev points, in proportion to Lagrange's polynomials there
        (MeanVariance(np.outer(AT_2, AT_2)), 2, {-1: 1 / 7, 0: 3 / 7, 1: 3 / 7}),
        # a parabola beyond a straight line: the highest coefficient again
        (Separate((BEYOND_A_LINE,)), 2, {-1: 1 / 4, 0: 1 / 2, 1: 1 / 4}),
    ],
)
def test_known_optima(criterion, degree, expected):
    """Pukelsheim (1993), ch. 9; Fedorov (1972)."""
    relaxed = relax(asked(polynomial(degree, LEGENDRE), criterion), 10.0, tolerance=1e-8)
    shares = at(LEGENDRE, relaxed)
    assert sorted(shares) == pytest.approx(sorted(expected), abs=1e-9)
    for x, share in expected.items():
        near = min(shares, key=lambda y, x=x: abs(y - x))
        assert shares[near] == pytest.approx(share, abs=2e-3)
    points, exact = (np.array(list(x)) for x in (expected, expected.values()))
    m = 10.0 * polynomial(degree, points).information(exact)
    assert relaxed.value == pytest.approx(float(criterion.value(m)), rel=1e-6)
    assert relaxed.value * (1 - 1e-9) <= relaxed.bound <= relaxed.value * (1 + 1e-6)


@every_of_three
@settings(max_examples=15)
@given(
    seed=st.integers(0, 10**6),
    costs=st.booleans(),
    known=st.booleans(),
    most=st.sampled_from([None, 1, 2]),
)
@pytest.mark.long
def test_no_plan_exceeds_the_bound(name, seed, costs, known, most):
    """Random plans, and the planner's own."""
    criterion = OF_THREE[name]
    units = random_units(seed, 15, costs=costs)
    prior = prior_of(seed) if known else None
    base = np.zeros((3, 3)) if prior is None else prior
    design = best_design(asked(units, criterion, prior), 9.0, max_count=most, effort=40)
    rng = np.random.default_rng(seed)
    for _ in range(20):
        counts = np.zeros(len(units))
        for k in rng.permutation(np.repeat(np.arange(len(units)), 3)):
            fits = (counts @ units.cost) + units.cost[k] <= 9.0
            if fits and (most is None or counts[k] < most):
                counts[k] += 1
        value = float(criterion.value(base + units.information(counts)))
        assert value <= design.bound * (1 + 1e-9)
    assert design.cost == pytest.approx(design.counts @ units.cost)
    assert design.cost <= 9.0 + 1e-9
    assert design.counts.min() >= 0
    assert most is None or design.counts.max() <= most
    assert 0 < design.efficiency <= 1
    of_design = base + units.information(design.counts.astype(float))
    assert design.value == pytest.approx(float(criterion.value(of_design)), rel=1e-9)
    assert design.efficiency == pytest.approx(min(1, design.value / design.bound))
    relaxed = design.relaxed
    assert relaxed.weight @ units.cost[relaxed.index] <= 9.0 * (1 + 1e-9)
    assert relaxed.weight.min() >= 0
    assert most is None or relaxed.weight.max() <= most * (1 + 1e-9)


@cache
def all_plans(most, units, total):
    """(N, units) plans of at most `most` of each unit and `total` of all (a unit costs 1)."""
    plans = np.indices((most + 1,) * units).reshape(units, -1).T
    return plans[plans.sum(axis=1) <= total].astype(float)


@every_of_three
def test_tiny_plans_against_all_plans(name):
    """The exchange finds the best of all plans of whole numbers, or nearly."""
    criterion = OF_THREE[name]
    shares = []
    for seed in range(8):
        units = random_units(seed, 7, costs=seed % 2 == 1)
        prior = prior_of(seed) if seed % 4 > 1 else None
        most = 1 if seed % 3 == 0 else None
        budget = 5.0
        plans = all_plans(1 if most else 5, 7, 5)
        plans = plans[plans @ units.cost <= budget]
        top = largest(criterion, units, plans, np.zeros((3, 3)) if prior is None else prior)
        design = best_design(asked(units, criterion, prior), budget, max_count=most, effort=150)
        assert design.bound >= top * (1 - 1e-9)
        assert design.value <= top * (1 + 1e-9)
        shares.append(design.value / top)
    assert min(shares) > 0.95
    assert np.median(shares) > 1 - 1e-9


@pytest.mark.parametrize("most", [None, 1])
def test_many_units(most):
    """Columns are generated until the equivalence theorem holds for all units."""
    units = random_units(3, 20_000, 8)
    relaxed = relax(asked(units, D()), 40.0, max_weight=most)
    assert relaxed.gap <= 1e-6
    inverse = np.linalg.inv(units.information(relaxed.weight, relaxed.index))
    leverage = np.einsum("krp,pq,krq->k", units.rows, inverse, units.rows)
    if most is None:
        assert leverage.max() <= 8 / 40.0 * (1 + 1e-5)
    else:
        assert relaxed.weight.max() <= 1 + 1e-9
        top = np.sort(leverage)[-40:].sum()  # the 40 best once each
        assert relaxed.value * top / 8 <= relaxed.value * (1 + 1e-5)


def test_budget_too_small_for_the_parameters():
    units, message = random_units(9, 50, 6), "2 readings or poses are too few.*ask for more"
    for criterion in (D(), MeanVariance(np.eye(6) / 6), E(), K()):
        refusal_of(CannotAnswerError, message, best_design, asked(units, criterion), 2.0, effort=50)


def test_a_budget_below_the_least_cost_is_refused():
    refusal("at least 1, the least cost", best_design, asked(random_units(1, 10), D()), 0.5)
