"""The approximate design: optimal weights of units, with a certified bound of φ."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.design import barrier as interior
from hilcal.design.barrier import BarrierProgram, Optimum
from hilcal.design.bound import best_first, prices, total_information, upper_bound
from hilcal.design.candidate_set import CandidateSet
from hilcal.design.criterion import Criterion, Smooth, square
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Bools, Floats, Ints

TOLERANCE = 1e-7  # Relative gap between the continuous optimum and its bound
KINKED_TOLERANCE = 1e-3
"""The same for criteria with kinks. A choice: the bound closes slowly there."""

_ROUNDS = 200
_STALE = 4  # rounds in which the gap must fall; this and the next two are choices
_SHORT = 2000  # units among which the first ones are sought
_WARM = 12  # multiplicative steps that find where the weight goes


@dataclass(frozen=True, slots=True, eq=False)
class ApproximateDesign:
    """A continuous optimum with its certificate."""

    index: Ints  # (S,) ascending indices of the units that have weight
    weight: Floats  # (S,) their weights w; Σ w c ≤ B
    value: float  # φ of these weights
    bound: float  # φ of no plan within the budget exceeds it
    price: Floats  # (K,) marginal value of each unit, ∂f/∂w_k: units with little are never taken
    information: Floats  # (P, P) M0 + Σ w_k A_kᵀA_k

    @property
    def gap(self) -> float:
        """Relative distance of value and bound."""
        return self.bound / self.value - 1.0 if self.value > 0.0 else np.inf

    def among(self, kept: Bools) -> "ApproximateDesign | None":
        """Return the same optimum over some (K,) of the units; None where one of weight is lost."""
        if not kept[self.index].all():
            return None
        place = np.cumsum(kept) - 1
        return replace(self, index=place[self.index], price=self.price[kept])


def relax(
    units: CandidateSet,
    criterion: Criterion,  # φ
    budget: float,  # B, in the units of the cost
    prior: Floats | None = None,  # (P, P) M0, what is known before; zero by default
    *,
    most: int | None = None,  # how often a unit may be taken; any number of times by default
    names: Sequence[str] | None = None,
    # relative gap at which to stop; 1e-7, or 1e-3 of criteria with kinks
    tolerance: float | None = None,
    start: ApproximateDesign | None = None,  # optimum of a similar problem over the same units
) -> ApproximateDesign:
    """Return the continuous optimum of φ(M0 + Σ w_k A_kᵀA_k), Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most.

    Column generation: the optimum over few units by an interior-point method, then a scan of
    all for units whose price exceeds those in use, until none is left (equivalence theorem).
    The bound is of the scan of all units.
    """
    if tolerance is None:
        tolerance = KINKED_TOLERANCE if criterion.kinked else TOLERANCE
    cap = np.inf if most is None else float(most)
    prior = checked(units, budget, prior, most)
    share = min(budget / float(units.cost.sum()), cap)
    spread = prior + total_information(units, np.full(len(units), share))
    criterion.require(spread, names)
    criterion = criterion.relevant(units, prior, budget)
    if share == cap and criterion.monotone:
        value = float(criterion.value(spread))  # all there is
        all_of_them = np.arange(len(units))
        return ApproximateDesign(
            all_of_them, np.full(len(units), cap), value, value, np.ones(len(units)), spread
        )
    most_spent = (1.0 - 1e-9) * cap * float(units.cost.sum())
    scan = _Scan(units, criterion, min(budget, most_spent), cap, prior)
    if start is None:
        active, weight = _first(scan, spread)
        order = 0.3
    else:
        active, weight, order = start.index, start.weight, 0.03
    best, top = np.inf, None
    gaps: list[float] = []
    for _ in range(_ROUNDS):
        last = len(active) == len(units)
        goal = 0.3 * tolerance if last else max(0.3 * tolerance, 0.1 * order)
        found = scan.solve(active, weight, goal, order)
        rate, bound = scan.all(found.smooth)
        best = min(best, bound)
        if top is None or found.value > top[0].value:
            top = found, active
        gap = best / top[0].value - 1.0 if top[0].value > 0.0 else np.inf
        gaps.append(gap)
        if gap <= tolerance or last or (len(gaps) > _STALE and gap > 0.8 * min(gaps[:-_STALE])):
            break
        active, weight = _exchanged(scan, active, found.weight, rate)
        order = max(min(0.5 * gap, order), tolerance)
    if top is None or not top[0].value > 0.0:
        raise CannotAnswerError("the candidates determine too little: the criterion stays 0")
    return _pruned(scan, top[1], top[0].weight, best)


def checked(units: CandidateSet, budget: float, prior: Floats | None, most: int | None) -> Floats:
    """Return the prior information after a check of what a plan is made of."""
    rows, cost = units.rows, units.cost
    if rows.ndim != 3 or cost.shape != (len(rows),) or not len(rows) or not rows.shape[2]:
        raise InputError(f"rows of shape {rows.shape} with costs of shape {cost.shape}")
    if not np.isfinite(rows).all() or not np.isfinite(cost).all() or not np.all(cost > 0.0):
        raise InputError("rows or costs of units are not finite, or a cost is not over 0")
    if not np.isfinite(budget) or budget < float(cost.min()) * (1.0 - 1e-12):
        raise InputError(f"a budget of {budget:g}; valid: at least {cost.min():g}, the least cost")
    if most is not None and most < 1:
        raise InputError(f"a unit at most {most} times; valid: 1 or more")
    if prior is None:
        return np.zeros((units.size, units.size))
    prior = square(prior, "the prior information", units.size)
    values = np.linalg.eigvalsh(prior)
    if values[0] < -1e-9 * max(float(values[-1]), 0.0) or values[-1] < 0.0:
        raise InputError("the prior information is not positive semidefinite")
    return prior


@dataclass(frozen=True, slots=True, eq=False)
class _Scan:
    """All units of a relaxation."""

    units: CandidateSet
    criterion: Criterion
    budget: float
    cap: float
    prior: Floats

    def all(self, smooth: Smooth) -> tuple[Floats, float]:
        """Return the price per cost (K,) of all units, up to a factor, and the bound."""
        u = self.units
        above = prices(u.rows, smooth.above)
        below = None if smooth.below is None else prices(u.rows, smooth.below)
        bound = upper_bound(smooth, self.prior, above, u.cost, self.budget, self.cap, below)
        net = above if below is None else prices(u.rows, smooth.gradient)
        return net / u.cost, bound

    def solve(self, active: Ints, weight: Floats, goal: float, order: float) -> Optimum:
        """Return the optimum over some units; what is not monotone may leave budget."""
        rows, cost = self.units.rows[active], self.units.cost[active]
        start = _feasible(weight, cost, self.budget, self.cap)
        if not self.criterion.monotone:  # one more unit without information
            rows = np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])
            cost = np.append(cost, self.budget)
            left = min(max(1.0 - float(weight @ cost[:-1]) / self.budget, 0.01), 0.99)
            start = np.append((1.0 - left) * start, left)
        program = BarrierProgram(self.criterion, rows, cost, self.budget, self.cap, self.prior)
        found = interior.solve(program, start, goal, order)
        return replace(found, weight=found.weight[: len(active)])


def _feasible(weight: Floats, cost: Floats, budget: float, cap: float) -> Floats:
    """Return weights over 0 and under the cap that spend the budget."""
    w = np.clip(weight, 1e-9 * budget / float(cost.sum()), 0.95 * cap)
    spent = float(w @ cost)
    if spent >= budget or not np.isfinite(cap):
        return np.asarray(w * (budget / spent))
    return np.asarray(w + (budget - spent) / float((cap - w) @ cost) * (cap - w))


def _first(scan: _Scan, spread: Floats) -> tuple[Ints, Floats]:
    """Return units that a few multiplicative steps give the most weight.

    w_k <- w_k (price_k / mean price)^(2/3), over the units of the best prices at the uniform
    plan and some of all. Silvey, Titterington & Torsney (1978), Comm. Statistics A7.
    """
    units, budget = scan.units, scan.budget
    count = min(len(units), max(_SHORT, int(4 * budget / (scan.cap * float(units.cost.min())))))
    smooth = scan.criterion.surrogate(spread, 0.1)(spread)
    if smooth is None or count == len(units):
        some = np.arange(len(units))
    else:
        rate = prices(units.rows, smooth.gradient) / units.cost
        even = np.linspace(0, len(units) - 1, count // 4).astype(np.int64)
        some = np.union1d(best_first(rate, count - len(even)), even)
    rows, cost = units.rows[some], units.cost[some]
    program = BarrierProgram(scan.criterion, rows, cost, budget, scan.cap, scan.prior)
    w = np.full(len(some), budget / float(cost.sum()))
    for _ in range(_WARM):
        m = program.information(w)
        smooth = scan.criterion.surrogate(m, 0.1)(m)
        if smooth is None:
            break
        rate = np.maximum(prices(rows, smooth.gradient) / cost, 0.0)
        w = w * (rate + 1e-3 * float(rate.max())) ** (2 / 3)
        w *= budget / float(w @ cost)
    needed = budget / scan.cap
    order = np.argsort(-w * cost, kind="stable")
    size = max(units.size, int(np.searchsorted(np.cumsum(cost[order]), 2 * needed)) + 1)
    while size < len(some):
        chosen = order[:size]
        m = program.information(np.where(np.isin(np.arange(len(w)), chosen), w, 0.0))
        smooth = scan.criterion.surrogate(m, 0.1)(m)
        if smooth is not None and float(scan.criterion.value(m)) > 0.0:
            break
        size *= 2
    chosen = np.sort(order[:size])
    return some[chosen], w[chosen]


def _exchanged(scan: _Scan, active: Ints, weight: Floats, rate: Floats) -> tuple[Ints, Floats]:
    """Return the units without those of no weight, with those of the best prices, and weights."""
    cost = scan.units.cost
    inner = weight < 0.99 * scan.cap if np.isfinite(scan.cap) else np.ones(len(weight), np.bool_)
    price = float(rate[active[inner]].max()) if inner.any() else float(rate[active].min())
    share = weight * cost[active] / scan.budget
    kept = (share > 1e-5 / len(active)) | (rate[active] > 0.999 * price)
    outside = rate.copy()
    outside[active] = -np.inf
    new = best_first(outside, 2 * scan.units.size)
    new = new[outside[new] > price * (1.0 + 1e-12)]
    little = 0.02 * scan.budget / (cost[new] * max(len(new), 1))
    index = np.concatenate([active[kept], new])
    order = np.argsort(index)
    return index[order], np.concatenate([weight[kept], little])[order]


def _pruned(scan: _Scan, active: Ints, weight: Floats, bound: float) -> ApproximateDesign:
    """Return the optimum without weights that change nothing."""
    units, criterion = scan.units, scan.criterion
    share = weight * units.cost[active] / scan.budget
    kept = share > 1e-8 * float(share.max())
    index, w = active[kept], weight[kept]
    if criterion.monotone:
        w = np.minimum(w * (scan.budget / float(w @ units.cost[index])), scan.cap)
    m = scan.prior + units.information(w, index)
    smooth = criterion.surrogate(m, 1e-3)(m)
    value = float(criterion.value(m))
    price = np.ones(len(units)) if smooth is None else prices(units.rows, smooth.gradient)
    return ApproximateDesign(index, w, value, max(bound, value), price, m)
