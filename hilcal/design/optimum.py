"""Exact designs with a certified lower bound of their efficiency."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import scipy.linalg as sl

from hilcal.design.approximate_design import KINKED_TOLERANCE, ApproximateDesign, checked, relax
from hilcal.design.criterion import Objective, best_first
from hilcal.errors import CannotAnswerError
from hilcal.types import Floats, Ints

TOLERANCE = 1e-3  # relative gap of the continuous optimum: whole numbers lose 1 to 5 % anyway


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """A plan as counts of units, its value, and a bound of the value."""

    counts: Ints  # (K,) of units
    value: float  # φ of the plan
    bound: float  # upper bound of φ of all plans within the budget
    information: Floats  # (P, P) of the plan, with the prior
    cost: float  # Σ n_k c_k
    relaxed: ApproximateDesign

    @property
    def efficiency(self) -> float:
        """Certified lower bound of φ over the largest φ, at most 1."""
        return min(1.0, self.value / self.bound)


def best_design(
    objective: Objective,
    budget: float,  # B, in the units of the cost
    rng: np.random.Generator | None = None,  # the only source of randomness
    *,
    max_count: int | None = None,  # largest count of a unit; unlimited by default
    effort: int | None = None,  # number of units added in the search; `EFFORT` by default
    relaxed: ApproximateDesign | None = None,  # the continuous optimum, or a start near it
) -> Design:
    """Return a plan with Σ n_k c_k ≤ B whose φ(M0 + Σ n_k A_kᵀA_k) is nearly the largest.

    The integer parts of the continuous weights are completed unit by unit: the next unit is the one
    with which the plan is best if the continuous optimum spends the remaining budget. Then each
    unit is removed in turn and its budget spent again (Fedorov 1972). Where this stops improving,
    a few random units are removed at once, and slightly worse plans are accepted for a while.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    units, criterion = objective.units, objective.criterion
    tolerance = KINKED_TOLERANCE if criterion.kinked else TOLERANCE
    if relaxed is None or relaxed.gap > tolerance:
        relaxed = relax(objective, budget, max_weight=max_count, tolerance=tolerance, start=relaxed)
    objective = checked(objective, budget)
    relevant = criterion.relevant(units, objective.prior, budget)
    search = _Search(replace(objective, criterion=relevant), budget, relaxed, max_count)
    usual, enough = (KINKED_EFFORT, KINKED_ENOUGH) if relevant.kinked else (EFFORT, ENOUGH)
    counts = search.counts(rng, usual if effort is None else effort, relaxed.bound, enough)
    used = np.flatnonzero(counts)
    information = objective.information(counts[used].astype(float), used)
    value = float(criterion.value(information))
    cost = float(counts @ units.cost)
    try:
        criterion.require(information, objective.names)
        determined = value > 0.0
    except CannotAnswerError:
        determined = False
    if not determined:
        raise CannotAnswerError(
            f"{budget:g} readings or poses are too few to determine all parameters, as criterion "
            f"{criterion.name} needs; ask for more"
        )
    return Design(counts, value, max(relaxed.bound, value), information, cost, relaxed)


EFFORT = 6000  # units added in the search at most, fewer for small plans; a choice
KINKED_EFFORT = 1500  # the same for criteria with kinks, whose values cost more
ENOUGH, KINKED_ENOUGH = 1.0 - 1e-6, 0.99  # share of the bound that ends the search; a choice

# Choices for speed; the certificate does not depend on them.
_POOL = 4000  # units of the best prices, in which a plan is sought
_TABLE = 10_000_000  # numbers in the pool's table
_TRIED = 8  # units of the best prices whose φ is computed
_SLACK = 1e-9
_ORDER = 0.02  # of the surrogate whose prices guide the search
_BETTER = 1e-9  # relative improvement that counts
_EACH = 150  # effort for each unit of a plan, at most
_VARIED = 0.1  # share of plans that are completed at random; larger for small plans
_WORSE = 0.12  # accepted loss, as a share of the distance to the bound


class _Plan(NamedTuple):
    """Counts (S,) of the pool's units, and their φ."""

    counts: Ints
    value: float


class _Search:
    """The search for a plan in a pool: the units of positive weight or of the best prices."""

    def __init__(
        self, objective: Objective, budget: float, relaxed: ApproximateDesign, max_count: int | None
    ) -> None:
        units, prior = objective.units, objective.prior
        most_of_one = budget / float(units.cost.min())
        fits = 2 * _TABLE // (units.size * (units.size + 1))
        count = max(min(_POOL, fits), 3 * int(np.ceil(most_of_one)))
        index = np.union1d(best_first(relaxed.price / units.cost, count), relaxed.index)
        weight = np.zeros(len(units))
        weight[relaxed.index] = relaxed.weight
        self.criterion, self.budget = objective.criterion, budget
        self.of_pool = objective.among(index)
        self.count, self.index, self.ideal_weight = len(units), index, weight[index]
        self.pool = self.of_pool.units
        self.most = int(np.floor(most_of_one * (1 + _SLACK))) if max_count is None else max_count
        spent = float(units.cost[relaxed.index] @ relaxed.weight)
        # information per cost of the continuous optimum, without M0
        self.ideal = (relaxed.information - prior) / max(spent, _SLACK * budget)
        # L, lower triangular, with L Lᵀ near the information of the continuous optimum
        scale = np.sqrt(np.maximum(np.diag(relaxed.information), np.finfo(float).tiny))
        scaled = relaxed.information / np.outer(scale, scale) + 1e-9 * np.eye(units.size)
        self.root = scale[:, None] * np.linalg.cholesky(scaled)
        self.triangle = first, second = np.triu_indices(units.size)
        # (S, P (P + 1) / 2) upper triangles of L⁻¹ A_kᵀA_k L⁻ᵀ, off-diagonal elements doubled:
        # tr(G A_kᵀA_k) of all units is one product with the triangle of Lᵀ G L; single precision
        # is enough to order the units
        self.table: Floats = np.empty((len(index), len(first)), dtype=np.float32)
        for start in range(0, len(index), 256):
            part = self.pool.rows[start : start + 256]
            flat = sl.solve_triangular(self.root, part.reshape(-1, units.size).T, lower=True)
            part = np.ascontiguousarray(flat.T).reshape(part.shape)
            squares = np.matmul(part.transpose(0, 2, 1), part)[:, first, second]
            squares[:, first != second] *= 2.0
            self.table[start : start + 256] = squares

    def counts(self, rng: np.random.Generator, effort: int, bound: float, enough: float) -> Ints:
        """Return the counts (K,) of all units."""
        floor = np.floor(self.ideal_weight + 1e-6).astype(np.int64)
        plan, goal = self.completed(np.minimum(floor, self.most)), enough * bound
        remaining = min(effort, _EACH * int(plan.counts.sum()))
        plan, remaining = self.exchanged(plan, rng, remaining, goal)
        plan, remaining = self.random_exchanges(plan, rng, remaining, bound, goal)
        plan, remaining = self.exchanged(
            plan, rng, max(remaining, 0) + int(plan.counts.sum()), goal
        )
        out = np.zeros(self.count, dtype=np.int64)
        out[self.index] = plan.counts
        return out

    def _information(self, counts: Ints) -> Floats:
        used = np.flatnonzero(counts)
        return self.of_pool.information(counts[used].astype(float), used)

    def _prices(self, gradient: Floats) -> Floats:
        """Return (S,) tr(G A_kᵀA_k), in single precision."""
        turned = (self.root.T @ gradient @ self.root)[self.triangle]
        scale = float(np.abs(turned).max(initial=0.0)) or 1.0
        return np.asarray((self.table @ (turned / scale).astype(np.float32)).astype(float) * scale)

    def completed(
        self, counts: Ints, banned: int = -1, rng: np.random.Generator | None = None
    ) -> _Plan:
        """Return the plan with its remaining budget spent unit by unit, each time on the best unit.

        The first one is not `banned`; with `rng`, some units are skipped at random.
        """
        counts = counts.copy()
        m = self._information(counts)
        free = self.budget - float(counts @ self.pool.cost)
        slack = _SLACK * self.budget
        least = float(self.pool.cost.min())
        while free >= least - slack:
            fits = (self.pool.cost <= free + slack) & (counts < self.most)
            if banned >= 0:
                fits[banned], banned = False, -1
            allowed = np.flatnonzero(fits)
            if not len(allowed):
                break
            base = m + free * self.ideal
            smooth = self.criterion.surrogate(base, _ORDER)(base)
            if smooth is None:
                break
            remaining = free - self.pool.cost
            remaining = np.where(remaining >= least - slack, remaining, 0.0)
            gain = self._prices(smooth.gradient)
            gain += remaining * float(np.sum(smooth.gradient * self.ideal))
            tried = allowed[best_first(gain[allowed], _TRIED)]
            ends = m + np.matmul(self.pool.rows[tried].transpose(0, 2, 1), self.pool.rows[tried])
            values = self.criterion.value(ends + remaining[tried, None, None] * self.ideal)
            if rng is not None:
                values = np.where(rng.random(len(values)) < rng.random(), -1.0, values)
            k = int(np.argmax(values))
            if not self.criterion.monotone and values[k] <= float(self.criterion.value(m)) > 0.0:
                break
            counts[tried[k]] += 1
            free -= float(self.pool.cost[tried[k]])
            m = ends[k]
        return _Plan(counts, float(self.criterion.value(self._information(counts))))

    def exchanged(
        self, plan: _Plan, rng: np.random.Generator, effort: int, goal: float
    ) -> tuple[_Plan, int]:
        """Return the plan after exchanges of single units, and the remaining effort."""
        stale = 0
        queue = rng.permutation(np.flatnonzero(plan.counts))
        while len(queue) and stale < len(queue) and effort > 0 and plan.value < goal:
            for unit in queue:
                if plan.counts[unit] == 0:
                    continue
                counts = plan.counts.copy()
                counts[unit] -= 1
                varied = self.completed(counts, int(unit))
                effort -= max(1, int(varied.counts.sum() - counts.sum()))
                stale += 1
                if varied.value > plan.value * (1.0 + _BETTER):
                    plan, stale = varied, 0
                if effort <= 0 or plan.value >= goal or stale >= len(queue):
                    break
            queue = rng.permutation(np.flatnonzero(plan.counts))
        return plan, effort

    def random_exchanges(
        self, plan: _Plan, rng: np.random.Generator, effort: int, bound: float, goal: float
    ) -> tuple[_Plan, int]:
        """Return the best plan of random exchanges of a few units, and the remaining effort.

        Record-to-record travel, Dueck (1993), J. Computational Physics 104(1).
        """
        best, total = plan, effort
        while effort > 0 and 0.0 < best.value < goal:
            worse = _WORSE * (1.0 - best.value / bound) * effort / total
            units = np.repeat(np.arange(len(plan.counts)), plan.counts)
            removed = rng.choice(units, min(int(rng.integers(1, 4)), len(units)), replace=False)
            counts = plan.counts.copy()
            np.subtract.at(counts, removed, 1)
            at_random = rng.random() < max(_VARIED, 2.0 / len(units))
            varied = self.completed(counts, int(removed[0]), rng if at_random else None)
            effort -= max(1, int(varied.counts.sum() - counts.sum()))
            if varied.value > best.value * (1.0 - worse):
                plan = varied
            if varied.value > best.value * (1.0 + _BETTER):
                best = varied
        return best, effort
