"""Exact designs with a certified lower bound of their efficiency."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl
from numpy.typing import NDArray

from hilcal.design.approximate_design import KINKED_TOLERANCE, ApproximateDesign, checked, relax
from hilcal.design.criterion import CandidateSet, Criterion, best_first
from hilcal.errors import CannotAnswerError
from hilcal.types import Floats, Ints

TOLERANCE = 1e-4
"""Relative gap of the continuous optimum: whole numbers lose 1 to 5 % anyway. Study: the demo's
plan and the benchmark's 40 of 100,000 states keep their certified efficiency to 0.01 %."""


@dataclass(frozen=True, slots=True, eq=False)
class Design:
    """What is taken, and how good it is."""

    counts: Ints  # (K,) how often each unit is taken
    value: float  # φ of it
    bound: float  # φ of no plan within the budget exceeds it
    information: Floats  # (P, P) of it, with what was known before
    cost: float  # Σ n_k c_k
    relaxed: ApproximateDesign

    @property
    def efficiency(self) -> float:
        """Share of the best possible that is certainly reached, at most 1."""
        return min(1.0, self.value / self.bound)


def best(
    units: CandidateSet,
    criterion: Criterion,  # φ
    budget: float,  # B, in the units of the cost
    # (P, P) M0: what is known before, and units that are in the plan in any case
    prior: Floats | None = None,
    # generator; the plan depends on nothing else that is random
    rng: np.random.Generator | None = None,
    *,
    most: int | None = None,  # how often a unit may be taken; any number of times by default
    names: Sequence[str] | None = None,
    # relative gap of the continuous optimum; `TOLERANCE` by default
    tolerance: float | None = None,
    effort: int | None = None,  # of the search for whole numbers; see `exact`
    relaxed: ApproximateDesign | None = None,  # the continuous optimum, where it is known
) -> Design:
    """Return a plan with Σ n_k c_k ≤ B whose φ(M0 + Σ n_k A_kᵀA_k) is nearly the largest."""
    rng = np.random.default_rng(0) if rng is None else rng
    if tolerance is None:
        tolerance = KINKED_TOLERANCE if criterion.kinked else TOLERANCE
    if relaxed is None or relaxed.gap > tolerance:
        relaxed = relax(
            units, criterion, budget, prior, most=most, names=names, tolerance=tolerance
        )
    known = checked(units, budget, prior, most)
    felt = criterion.relevant(units, known, budget)
    counts = exact(units, felt, budget, prior, relaxed, rng, most=most, effort=effort)
    used = np.flatnonzero(counts)
    information = known + units.information(counts[used].astype(float), used)
    value = float(criterion.value(information))
    cost = float(counts @ units.cost)
    try:
        criterion.require(information, names)
        enough = value > 0.0
    except CannotAnswerError:
        enough = False
    if not enough:
        raise CannotAnswerError(
            f"a budget of {budget:g} takes {int(counts.sum())} units, too few to determine "
            f"{units.size} parameters by criterion {criterion.name}; raise the budget"
        )
    return Design(counts, value, max(relaxed.bound, value), information, cost, relaxed)


EFFORT = 6000
"""Units that are put into a plan before the search ends, at most; fewer of small plans.
A choice: the 40 of 100,000 states of the benchmark are certified at 98 % within it."""
KINKED_EFFORT = 1500  # The same for criteria with kinks, whose values cost more
ENOUGH, KINKED_ENOUGH = 1.0 - 1e-6, 0.99
"""Share of the bound at which the search ends; for criteria with kinks. A choice: a percent of what
separates two effects is a percent of the readings, and to find it takes as long as the rest."""

# Choices for speed; the certificate does not depend on them.
_POOL = 4000  # units of the best prices, among which a plan is sought
_TABLE = 10_000_000  # numbers in the pool's table
_TRIED = 8  # units whose value is worked out, of those of the best price
_SLACK = 1e-9
_ORDER = 0.02  # of the surrogate whose prices lead the search
_BETTER = 1e-9  # relative improvement that counts
_EACH = 150  # of the effort, for each unit of a plan
_VARIED = 0.1  # share of the plans that vary at random; more of small ones
_WORSE = 0.12  # of the distance to the bound, by which a plan may be worse and be gone on from


def exact(
    units: CandidateSet,
    criterion: Criterion,  # φ
    budget: float,  # B
    prior: Floats | None,  # (P, P) what is known before, and units that are in any case in the plan
    relaxed: ApproximateDesign,
    rng: np.random.Generator,
    *,
    most: int | None = None,  # how often a unit may be taken; any number of times by default
    effort: int | None = None,  # units put into a plan before the search ends; `EFFORT` by default
) -> Ints:
    """Return (K,) whole numbers n of units with Σ n_k c_k ≤ B that nearly maximise φ.

    The whole parts of the continuous weights are completed unit by unit: the next one is that with
    which the plan, ideally completed by the continuous optimum, is best. Then each unit is taken
    out in turn and its budget spent anew (Fedorov 1972); where this no longer helps, a few random
    ones are taken out at once, and what is a little worse is gone on from for a while.
    """
    prior = checked(units, budget, prior, most)
    if effort is None:
        effort = KINKED_EFFORT if criterion.kinked else EFFORT
    enough = KINKED_ENOUGH if criterion.kinked else ENOUGH
    search = _search(units, criterion, budget, prior, relaxed, most)
    floor = np.floor(search.ideal_weight + 1e-6).astype(np.int64)
    plan = search.refilled(np.minimum(floor, search.most))
    goal = enough * relaxed.bound
    left = min(effort, _EACH * int(plan.counts.sum()))
    plan, left = search.polished(plan, rng, left, goal)
    best, left = search.wandered(plan, rng, left, relaxed.bound, goal)
    best, left = search.polished(best, rng, max(left, 0) + int(best.counts.sum()), goal)
    out = np.zeros(len(units), dtype=np.int64)
    out[search.index] = best.counts
    return out


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """Whole numbers (S,) of the pool's units, their information and value."""

    counts: Ints
    information: Floats
    value: float


@dataclass(frozen=True, slots=True, eq=False)
class _Search:
    """The pool of units in which a plan is sought."""

    criterion: Criterion  # φ
    index: Ints  # (S,) the pool's units among all
    rows: Floats  # (S, R, P) of the pool
    cost: Floats  # (S,) of the pool
    budget: float  # B
    most: int  # how often a unit may be taken
    prior: Floats  # (P, P) M0
    ideal: Floats  # (P, P) information per cost of the continuous optimum, without M0
    ideal_weight: Floats  # (S,) its weights
    # (S, P (P + 1) / 2) upper triangles of L⁻¹ A_kᵀA_k L⁻ᵀ, off the diagonal doubled: tr(G A_kᵀA_k)
    # of all units is one product with the triangle of Lᵀ G L. In these coordinates single precision
    # is enough for an order of prices.
    table: NDArray[np.float32]
    triangle: tuple[Ints, Ints]  # indices of the upper triangle
    root: Floats  # (P, P) L with L Lᵀ the information of the continuous optimum

    def _information(self, counts: Ints) -> Floats:
        """Return (P, P) M of whole numbers."""
        used = np.flatnonzero(counts)
        root = self.rows[used] * np.sqrt(counts[used])[:, None, None]
        root = root.reshape(-1, self.rows.shape[2])
        return np.asarray(self.prior + root.T @ root)

    def _plan(self, counts: Ints) -> _Plan:
        """Return a plan with its information worked out anew."""
        m = self._information(counts)
        return _Plan(counts, m, float(self.criterion.value(m)))

    def _prices(self, gradient: Floats) -> Floats:
        """Return (S,) tr(G A_kᵀA_k), in single precision."""
        turned = (self.root.T @ gradient @ self.root)[self.triangle]
        scale = float(np.abs(turned).max(initial=0.0)) or 1.0
        return (self.table @ (turned / scale).astype(np.float32)).astype(float) * scale

    def refilled(
        self, counts: Ints, banned: int = -1, rng: np.random.Generator | None = None
    ) -> _Plan:
        """Return the plan after its free budget is spent unit by unit, `banned` not first.

        The best unit is taken; with `rng`, some are passed over at random.
        """
        counts = counts.copy()
        m = self._information(counts)
        slack = self.budget - float(counts @ self.cost)
        tiny = _SLACK * self.budget
        least = float(self.cost.min())
        while slack >= least - tiny:
            fits = (self.cost <= slack + tiny) & (counts < self.most)
            if banned >= 0:
                fits[banned], banned = False, -1
            allowed = np.flatnonzero(fits)
            if not len(allowed):
                break
            base = m + slack * self.ideal
            smooth = self.criterion.surrogate(base, _ORDER)(base)
            if smooth is None:
                break
            rest = slack - self.cost
            rest = np.where(rest >= least - tiny, rest, 0.0)
            gain = self._prices(smooth.gradient)
            gain += rest * float(np.sum(smooth.gradient * self.ideal))
            tried = allowed[best_first(gain[allowed], _TRIED)]
            ends = m + np.matmul(self.rows[tried].transpose(0, 2, 1), self.rows[tried])
            values = self.criterion.value(ends + rest[tried, None, None] * self.ideal)
            if rng is not None:
                values = np.where(rng.random(len(values)) < rng.random(), -1.0, values)
            k = int(np.argmax(values))
            if not self.criterion.monotone and values[k] <= float(self.criterion.value(m)) > 0.0:
                break
            counts[tried[k]] += 1
            slack -= float(self.cost[tried[k]])
            m = ends[k]
        return self._plan(counts)

    def polished(
        self, plan: _Plan, rng: np.random.Generator, left: int, goal: float
    ) -> tuple[_Plan, int]:
        """Return the plan after exchanges of single units, and the effort that is left."""
        stale = 0
        queue = rng.permutation(np.flatnonzero(plan.counts))
        while len(queue) and stale < len(queue) and left > 0 and plan.value < goal:
            for unit in queue:
                if plan.counts[unit] == 0:
                    continue
                counts = plan.counts.copy()
                counts[unit] -= 1
                new = self.refilled(counts, int(unit))
                left -= max(1, int(new.counts.sum() - counts.sum()))
                stale += 1
                if new.value > plan.value * (1.0 + _BETTER):
                    plan, stale = new, 0
                if left <= 0 or plan.value >= goal or stale >= len(queue):
                    break
            queue = rng.permutation(np.flatnonzero(plan.counts))
        return plan, left

    def wandered(
        self, plan: _Plan, rng: np.random.Generator, left: int, bound: float, goal: float
    ) -> tuple[_Plan, int]:
        """Return the best of plans in which a few random units give way to others, again and again.

        Record-to-record travel, Dueck (1993), J. Computational Physics 104(1).
        """
        best, whole = plan, left
        while left > 0 and 0.0 < best.value < goal:
            worse = _WORSE * (1.0 - best.value / bound) * left / whole
            every = np.repeat(np.arange(len(plan.counts)), plan.counts)
            out = rng.choice(every, min(int(rng.integers(1, 4)), len(every)), replace=False)
            counts = plan.counts.copy()
            np.subtract.at(counts, out, 1)
            varied = rng.random() < max(_VARIED, 2.0 / len(every))
            new = self.refilled(counts, int(out[0]), rng if varied else None)
            left -= max(1, int(new.counts.sum() - counts.sum()))
            if new.value > best.value * (1.0 - worse):
                plan = new
            if new.value > best.value * (1.0 + _BETTER):
                best = new
        return best, left


def _search(
    units: CandidateSet,
    criterion: Criterion,
    budget: float,
    prior: Floats,
    relaxed: ApproximateDesign,
    most: int | None,
) -> _Search:
    """Return the pool: the units of weight and those of the best prices."""
    limit = int(np.floor(budget / float(units.cost.min()) * (1 + _SLACK))) if most is None else most
    fits = 2 * _TABLE // (units.size * (units.size + 1))
    count = max(min(_POOL, fits), 3 * int(np.ceil(budget / float(units.cost.min()))))
    rate = relaxed.price / units.cost
    index = np.union1d(best_first(rate, count), relaxed.index)
    weight = np.zeros(len(units))
    weight[relaxed.index] = relaxed.weight
    spent = float(units.cost[relaxed.index] @ relaxed.weight)
    root = _root(relaxed.information)
    ideal = (relaxed.information - prior) / max(spent, _SLACK * budget)
    return _Search(
        criterion,
        index,
        units.rows[index],
        units.cost[index],
        budget,
        limit,
        prior,
        ideal,
        weight[index],
        *_triangles(units.rows[index], root),
        root,
    )


def _root(m: Floats) -> Floats:
    """Return L, lower triangular, with L Lᵀ near M, of full rank."""
    scale = np.sqrt(np.maximum(np.diag(m), np.finfo(float).tiny))
    scaled = m / np.outer(scale, scale)
    return np.asarray(scale[:, None] * np.linalg.cholesky(scaled + 1e-9 * np.eye(len(m))))


def _triangles(rows: Floats, root: Floats) -> tuple[NDArray[np.float32], tuple[Ints, Ints]]:
    """Return the table of a pool and the indices of the upper triangle."""
    first, second = np.triu_indices(rows.shape[2])
    table = np.empty((len(rows), len(first)), dtype=np.float32)
    for start in range(0, len(rows), 256):
        part = rows[start : start + 256]
        part = sl.solve_triangular(root, part.reshape(-1, len(root)).T, lower=True)
        part = np.ascontiguousarray(part.T).reshape(-1, *rows.shape[1:])
        whole = np.matmul(part.transpose(0, 2, 1), part)[:, first, second]
        whole[:, first != second] *= 2.0
        table[start : start + 256] = whole
    return table, (first, second)
