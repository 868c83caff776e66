"""Prices of units and the certified bound of all plans within a budget."""

import numpy as np

from hilcal.design.candidate_set import CandidateSet
from hilcal.design.criterion import Smooth
from hilcal.types import Floats, Ints

_CHUNK = 2048


def prices(rows: Floats, matrix: Floats) -> Floats:
    """Return (K,) tr(G A_kᵀA_k) of (K, R, P) rows, for a symmetric (P, P) matrix G.

    G = L Lᵀ where it is positive definite, else V diag(s) Vᵀ: sums of squares do not cancel.
    """
    try:
        root, minus = np.linalg.cholesky(matrix), None
    except np.linalg.LinAlgError:
        values, vectors = np.linalg.eigh(matrix)
        kept = np.abs(values) > 1e-15 * float(np.abs(values).max(initial=0.0))
        root = vectors[:, kept] * np.sqrt(np.abs(values[kept]))
        minus = np.flatnonzero(values[kept] < 0.0)
    count, size = rows.shape[:2]
    out = np.empty(count)
    for start in range(0, count, _CHUNK):
        part = rows[start : start + _CHUNK].reshape(-1, rows.shape[2]) @ root
        total = np.einsum("ij,ij->i", part, part)
        if minus is not None and len(minus):
            total -= 2.0 * np.einsum("ij,ij->i", part[:, minus], part[:, minus])
        out[start : start + _CHUNK] = total.reshape(-1, size).sum(axis=1)
    return out


def total_information(units: CandidateSet, weight: Floats) -> Floats:
    """Return (P, P) Σ w_k A_kᵀA_k over all units, in chunks."""
    out = np.zeros((units.size, units.size))
    for start in range(0, len(units), _CHUNK):
        part = slice(start, start + _CHUNK)
        root = units.rows[part] * np.sqrt(weight[part])[:, None, None]
        root = root.reshape(-1, units.size)
        out += root.T @ root
    return out


def upper_bound(
    smooth: Smooth,  # with Z and Y
    prior: Floats,  # (P, P) M0
    gains: Floats,  # (K,) tr(Z H_k)
    cost: Floats,  # (K,) c
    budget: float,  # B
    most: float,  # how often a unit may be taken
    below: Floats | None = None,  # (K,) tr(Y H_k)
) -> float:
    """Return what φ of no plan within the budget exceeds, whole or not.

    φ(M0 + Σ n_k H_k) ≤ tr(Z M0) + max of Σ n_k tr(Z H_k) over n ≥ 0, Σ n_k c_k ≤ B: the budget
    goes to the best prices per cost, each at most `most` times. Kiefer & Wolfowitz (1960),
    Canadian J. Math. 12; Pukelsheim (1993), Optimal Design of Experiments, ch. 7. Of a ratio
    tr(Z N)/tr(Y N) of eigenvalues, the largest value over the same plans (Dinkelbach 1967), at
    most 1.
    """
    known = float(np.sum(smooth.above * prior))
    if below is None or smooth.below is None:
        return known + float(gains @ spend(gains, cost, budget, most))
    known_below = float(np.sum(smooth.below * prior))
    if known_below <= 0.0:  # the best unit alone
        return min(1.0, float(np.max(gains / np.maximum(below, np.finfo(float).tiny))))
    ratio = known / known_below
    for _ in range(100):
        weight = spend(gains - ratio * below, cost, budget, most)
        new = (known + float(gains @ weight)) / (known_below + float(below @ weight))
        if new <= ratio * (1.0 + 1e-13):
            break
        ratio = new
    return min(1.0, ratio)


def spend(gains: Floats, cost: Floats, budget: float, most: float) -> Floats:
    """Return the weights (K,) of the fractional knapsack: best gain per cost first."""
    rate = gains / cost
    # no more than so many of the best are reached by the budget
    best = best_first(rate, int(np.ceil(budget / (most * float(cost.min())))) + 1)
    before = np.concatenate([[0.0], np.cumsum(most * cost[best[:-1]])])
    taken = np.clip((budget - before) / cost[best], 0.0, most)
    weight = np.zeros(len(gains))
    weight[best] = np.where(rate[best] > 0.0, taken, 0.0)
    return weight


def best_first(rate: Floats, count: int) -> Ints:
    """Return the indices of the `count` largest, best first."""
    count = min(count, len(rate))
    chosen = np.argpartition(-rate, count - 1)[:count] if count < len(rate) else np.arange(count)
    return np.asarray(chosen[np.argsort(-rate[chosen], kind="stable")])
