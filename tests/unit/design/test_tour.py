"""Tours and loops: how near to the shortest, and how random."""

from collections import Counter
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from hilcal.design import tour
from hilcal.design.run_order import pace
from hilcal.types import Floats
from tests.support.campaigns import configuration

CONFIG = configuration()


def _held_karp(w: Floats) -> float:
    """Return the exact length of the shortest tour (dynamic programming over sets)."""
    count = len(w) - 1
    best = {(1 << k, k): float(w[0, k + 1]) for k in range(count)}
    for size in range(2, count + 1):
        for chosen in combinations(range(count), size):
            bits = sum(1 << k for k in chosen)
            for k in chosen:
                rest = bits ^ (1 << k)
                best[bits, k] = min(best[rest, j] + w[j + 1, k + 1] for j in chosen if j != k)
    full = (1 << count) - 1
    return min(best[full, k] + float(w[k + 1, 0]) for k in range(count))


def _seconds(count: int, seed: int, *, symmetric: bool) -> Floats:
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (count + 1, 6))
    w = pace(CONFIG).legs(q, q)
    blocked = rng.random(w.shape) < 0.2
    blocked = blocked | blocked.T if symmetric else blocked
    around = w[:, :1] + 6.5 + w[:1]
    w[1:, 1:] = np.where(blocked, around, w)[1:, 1:]
    return w


@pytest.mark.parametrize("symmetric", [True, False])
def test_tours_are_the_shortest_or_nearly(symmetric: bool) -> None:
    longer = []
    for seed in range(4):
        for count in range(1, 11):
            w = _seconds(count, seed, symmetric=symmetric)
            order = tour.shortest(w, np.random.default_rng(seed))
            assert sorted(order) == list(range(1, count + 1))
            ratio = tour.length(w, order) / _held_karp(w)
            assert ratio >= 1 - 1e-12
            if count <= 7:
                assert ratio == pytest.approx(1, rel=1e-12)
            longer.append(ratio)
    assert max(longer) < 1.03


def test_local_search_alone_comes_near_the_shortest_tour() -> None:
    """Insertion and exchanges without luck: what large plans rest on."""
    ratio = []
    for seed in range(12):
        w = _seconds(10, 50 + seed, symmetric=seed % 2 == 0)
        rng = np.random.default_rng(seed)
        begun = [int(k) for k in rng.permutation(10) + 1]
        order = tour.improved(w, begun)
        assert sorted(order) == sorted(begun)
        assert tour.length(w, order) <= tour.length(w, begun)
        ratio.append(tour.length(w, order) / _held_karp(w))
    assert np.mean(ratio) < 1.05


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 8), st.integers(0, 10**6), st.floats(15.0, 120.0))
def test_loops_are_cut_in_least_time(count: int, seed: int, limit: float) -> None:
    w = _seconds(count, seed, symmetric=False)
    order = [int(k) for k in np.random.default_rng(seed).permutation(count) + 1]

    def cost(parts: list[list[int]]) -> float:
        total = 0.0
        for part in parts:
            whole = tour.length(w, part) + 6.5 * len(part)
            total += whole + 6.5 if len(part) == 1 or whole <= limit else np.inf
        return total

    tries = []
    for bits in range(2 ** (count - 1)):
        cuts = [0, *(k + 1 for k in range(count - 1) if bits >> k & 1), count]
        tries.append([order[a:b] for a, b in pairwise(cuts)])
    found = tour.loops(w, order, 6.5, limit)
    assert found is not None
    assert [k for part in found for k in part] == order
    assert cost(found) == pytest.approx(min(map(cost, tries)), rel=1e-12)


def test_random_orders_are_uniform_and_within_the_budget() -> None:
    rng = np.random.default_rng(5)
    w = _seconds(4, 1, symmetric=True)
    free = Counter(tuple(tour.shaken(w, [1, 2, 3, 4], 1e6, rng, 40)) for _ in range(2400))
    assert len(free) == 24
    assert stats.chisquare(list(free.values())).pvalue > 1e-3
    for seed in range(10):
        w = _seconds(15, seed, symmetric=seed % 2 == 0)
        short = tour.shortest(w, rng)
        budget = 1.1 * tour.length(w, short)
        order = tour.shaken(w, short, budget, rng, 600)
        assert sorted(order) == sorted(short)
        assert order != short
        assert tour.length(w, order) <= budget + 1e-9
