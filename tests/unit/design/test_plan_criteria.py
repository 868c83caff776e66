"""Criteria of plans: derivatives, concavity, bounds, and what they mean."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.design.criteria import D, E, K, MeanVariance, Pair, Separate
from hilcal.design.criterion import Criterion, require_determined
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Floats

P = 6


def few_poses() -> Floats:
    """Of rank 2, as that of few test poses is."""
    root = np.random.default_rng(5).normal(size=(2, P))
    return root.T @ root


def pairs() -> tuple[Pair, ...]:
    return (
        Pair(np.array([0, 1]), np.array([1.0, -0.5]), np.array([2, 3, 4])),
        Pair(np.array([4]), np.array([2.0]), np.array([2, 3, 0, 1])),
        Pair(np.array([5]), np.array([1.0]), np.array([2, 3])),
    )


def compound_variance() -> MeanVariance:
    """Of prediction poses at which the first four of the parameters count."""
    root = np.random.default_rng(6).normal(size=(2, 4))
    c = np.zeros((P, P))
    c[:4, :4] = root.T @ root
    return MeanVariance(0.7 * c, "A", 1.9 * c[:4, :4])


CRITERIA: dict[str, Callable[[], Criterion]] = {
    "D": D,
    "A": lambda: MeanVariance(np.eye(P) / P, "A"),
    "A of some": lambda: MeanVariance(np.diag([1.0, 0.0, 1.0, 0.0, 0.0, 1.0]) / 3, "A"),
    "I": lambda: MeanVariance(few_poses()),
    "E": E,
    "K": K,
    "E of some": lambda: E(np.array([0, 2, 5])),
    "separate": lambda: Separate(pairs()),
    "compound variance": compound_variance,
    "compound determinant": lambda: D(4),
}
seeds = st.integers(0, 10**6)
every = pytest.mark.parametrize("name", CRITERIA)


def information(rng: np.random.Generator, rows: int = 12) -> Floats:
    """A regular information matrix of parameters of different size."""
    a = rng.normal(size=(rows, P)) * np.exp(rng.uniform(-1, 1, P))
    return np.asarray(a.T @ a)


def test_compound_criteria_are_means_of_both_efficiencies() -> None:
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
def test_bound_holds_for_any_information(name: str, seed: int, order: float) -> None:
    """Also for singular matrices, whatever the surrogate's order."""
    criterion = CRITERIA[name]()
    rng = np.random.default_rng(seed)
    m = information(rng)
    s = criterion.surrogate(m, order)(m)
    assert s is not None
    for rows in (3, 7, 30):
        n = information(rng, rows)
        bound = np.sum(s.above * n)
        if s.below is not None:
            bound /= np.sum(s.below * n)
        assert float(criterion.value(n)) <= bound * (1 + 1e-9)
    if name in ("D", "A", "I"):  # exact at M itself
        assert np.sum(s.above * m) == pytest.approx(float(criterion.value(m)), rel=1e-9)


@every
def test_values_of_many_are_the_values_of_each(name: str) -> None:
    criterion = CRITERIA[name]()
    rng = np.random.default_rng(2)
    stack = np.array([information(rng) for _ in range(5)] + [information(rng, 3)])
    single = [float(criterion.value(m)) for m in stack]
    assert criterion.value(stack) == pytest.approx(single, rel=1e-9)
    assert criterion.value(stack.reshape(2, 3, P, P)).shape == (2, 3)
    if name != "separate":  # some pairs are separated by three rows
        assert abs(single[-1]) <= 1e-12 * min(single[:-1])


def test_a_is_the_inverse_of_the_mean_variance() -> None:
    m = information(np.random.default_rng(4))
    variance = np.diag(np.linalg.inv(m))
    assert float(MeanVariance(np.eye(P) / P).value(m)) == pytest.approx(1 / variance.mean())
    some = np.array([1.0, 0.0, 1.0, 0.0, 0.0, 1.0])
    mean = float(some @ variance) / 3
    assert float(MeanVariance(np.diag(some) / 3).value(m)) == pytest.approx(1 / mean)


def test_test_poses_give_the_variance_of_their_position() -> None:
    rng = np.random.default_rng(4)
    m = information(rng)
    v = rng.normal(size=(7, 3, P))  # Jacobians of the position at 7 poses
    c = np.mean(np.swapaxes(v, 1, 2) @ v, axis=0)
    variances = [np.trace(one @ np.linalg.inv(m) @ one.T) for one in v]
    assert float(MeanVariance(c).value(m)) == pytest.approx(1 / np.mean(variances))


@pytest.mark.parametrize("twice", [False, True])
def test_separation_is_what_a_fit_leaves(twice: bool) -> None:
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


def test_says_which_parameters_nothing_determines() -> None:
    rng = np.random.default_rng(0)
    a = rng.normal(size=(30, 3)) * [1.0, 1e3, 1e-3]
    names = ("j1", "j2", "offset")
    require_determined(a.T @ a, names)  # differences in size are no matter
    blind = a * [1, 0, 1]
    with pytest.raises(CannotAnswerError, match="changes with j2;"):
        require_determined(blind.T @ blind, names)
    same = a.copy()
    same[:, 2] = 1e-4 * same[:, 0]
    with pytest.raises(CannotAnswerError, match=r"separates (j1, offset|offset, j1);"):
        require_determined(same.T @ same, names)
    with pytest.raises(CannotAnswerError, match="parameter 2"):
        require_determined(blind.T @ blind)
    alike = Separate((Pair(np.array([0]), np.ones(1), np.array([1, 2]), "backlash from drift"),))
    with pytest.raises(CannotAnswerError, match="separates backlash from drift"):
        alike.require(same.T @ same, names)
    alike.require(a.T @ a, names)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MeanVariance(np.ones((2, 3))), r"\(3, 3\) matrix"),
        (lambda: MeanVariance(np.diag([1.0, -1.0])), "semidefinite"),
        (lambda: MeanVariance(np.array([[1.0, 1.0], [0.0, 1.0]])), "not symmetric"),
        (lambda: MeanVariance(np.zeros((2, 2))), "zero"),
        (lambda: Separate(()), "no pair"),
        (lambda: Pair(np.array([0]), np.zeros(1), np.array([1])), "not all zero"),
        (lambda: Pair(np.array([0]), np.ones(1), np.array([0, 1])), "both sides"),
    ],
)
def test_refusals(make: Callable[[], object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()
