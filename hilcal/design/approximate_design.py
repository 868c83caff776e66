"""The approximate design: optimal weights of units, with a certified bound of φ."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl

from hilcal.design.criterion import (
    CandidateSet,
    Criterion,
    Smooth,
    best_first,
    prices,
    upper_bound,
)
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Bools, Floats, Ints

# Choices, usual in interior-point methods (Wright 1997); none has a study of its own.
_STEPS = 80
_BACK = 0.995  # share of the way to the boundary
_CENTRAL = 1.0  # square of Newton's decrement at which μ may fall
_CLAMP = 1e4  # how far a dual may be from μ / w


@dataclass(frozen=True, eq=False)
class BarrierProgram:
    """Maximise φ(M0 + Σ w_k A_kᵀA_k) over w with Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most."""

    criterion: Criterion  # φ
    units: CandidateSet  # n of them
    budget: float  # B
    most: float  # bound of each weight; infinity for none
    prior: Floats  # (P, P) M0

    def information(self, weight: Floats) -> Floats:
        """Return (P, P) M."""
        return np.asarray(self.prior + self.change(weight))

    def change(self, weight: Floats) -> Floats:
        """Return (P, P) Σ w_k A_kᵀA_k; weights of either sign."""
        rows = self.units.rows
        flat = rows.reshape(-1, rows.shape[2])
        return np.asarray((flat * np.repeat(weight, rows.shape[1])[:, None]).T @ flat)

    def scan(self, smooth: Smooth) -> tuple[Floats, float]:
        """Return tr(Z A_kᵀA_k) of all units, and the bound of φ over them."""
        rows = self.units.rows
        above = prices(rows, smooth.above)
        below = None if smooth.below is None else prices(rows, smooth.below)
        cost = self.units.cost
        return above, upper_bound(smooth, self.prior, above, cost, self.budget, self.most, below)

    def curvature(self, smooth: Smooth) -> Floats:
        """Return (n, n) −∂²f/∂w_k∂w_l, positive semidefinite."""
        rows = self.units.rows
        n, size, p = rows.shape
        flat = rows.reshape(-1, p)
        out = np.zeros((n, n))
        for c, x, y in smooth.products:
            out -= c * _product(rows, x, y)
        for factor, v in smooth.squares:
            each = np.sum((flat @ v).reshape(n, size, -1) ** 2, axis=1)
            out -= each @ factor @ each.T
        return np.asarray(0.5 * (out + out.T))


def _product(rows: Floats, x: Floats, y: Floats) -> Floats:
    """Return (n, n) tr(X H_k Y H_l) of (n, R, P) rows, for X and Y by their roots (P, r)."""
    left = rows @ x
    right = left if y is x else rows @ y
    size = rows.shape[1]
    if 2 * size * size <= min(left.shape[2], right.shape[2]):  # by the rows
        out = np.zeros((len(rows), len(rows)))
        for i in range(size):
            for j in range(i + 1):
                seen = left[:, i] @ left[:, j].T
                seen *= seen if y is x else right[:, i] @ right[:, j].T
                out += seen if i == j else seen + seen.T
        return out
    # By the matrices T_k = L_xᵀ H_k L_y: the sum of T_k ∘ T_l.
    n, t = len(rows), np.matmul(left.transpose(0, 2, 1), right)
    if y is x:  # symmetric: half of each does
        up, across = np.triu_indices(t.shape[1])
        half = np.take(t.reshape(n, -1), up * t.shape[1] + across, axis=1)
        half *= np.where(up == across, 1.0, np.sqrt(2.0))
        return _gram(half)
    return _gram(t.reshape(n, -1))


def _gram(t: Floats) -> Floats:
    upper = np.asarray(sl.blas.dsyrk(1.0, t.T, trans=1))
    return upper + np.triu(upper, 1).T


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """A continuous optimum."""

    weight: Floats  # (n,) w
    smooth: Smooth  # f there, with the matrices of the bound
    value: float  # φ
    bound: float  # of φ over these units
    order: float

    @property
    def gap(self) -> float:
        """How far φ may be below the optimum, relative."""
        return self.bound / self.value - 1.0 if self.value > 0.0 else np.inf


def solve(program: BarrierProgram, start: Floats, tolerance: float, order: float = 1.0) -> Optimum:
    """Return the optimum to a relative gap, from (n,) weights over 0, under `most`, that spend B.

    Newton's method on the barrier problem f(w) + μ Σ log w_k + μ Σ log(most − w_k), with the duals
    z of the bounds as variables of their own (Wright 1997, Primal-Dual Interior-Point Methods), μ
    falling to 0 from `order` / n. Criteria with a kink have a surrogate of order μ.
    """
    w, n = start, len(start)
    capped = np.isfinite(program.most)
    m = program.information(w)
    mu = max(min(order, 1.0), tolerance) / n
    z = mu / w
    y = mu / (program.most - w) if capped else np.zeros(n)
    best: Optimum | None = None
    central = False
    for step in range(_STEPS):
        surrogate = program.criterion.surrogate(m, mu)
        smooth = surrogate(m)
        if smooth is None:
            break
        value = float(program.criterion.value(m))
        found = Optimum(w, smooth, value, program.scan(smooth)[1], mu)
        if best is None or found.gap < best.gap:
            best = found
        if found.gap <= tolerance or step == _STEPS - 1:
            break
        if central:
            mu = max(0.2 * mu, 0.1 * tolerance / n)
            central, z, y = False, 0.2 * z, 0.2 * y
            surrogate = program.criterion.surrogate(m, mu)
            smooth = surrogate(m) or smooth
        slope = prices(program.units.rows, smooth.gradient)
        top = program.most - w if capped else np.ones(n)
        lean = slope + mu / w - (mu / top if capped else 0.0)
        move = _newton(program, program.curvature(smooth) + np.diag(z / w + y / top), lean, w)
        if move is None:
            break
        length = min(1.0, _BACK * _room(w, move))
        if capped:
            length = min(length, _BACK * _room(top, -move))
        push = float(lean @ move)
        moved = program.change(move)
        length = _search(program, surrogate, smooth, (w, m), (move, moved), length, mu, push)
        if length == 0.0 and (program.criterion.kinked or mu <= tolerance / (10 * n)):
            break
        z = _dual(z, mu / w - z - z / w * move)
        if capped:
            y = _dual(y, mu / top - y + y / top * move)
        w = w + length * move
        m = program.information(w)
        z = np.clip(z, mu / (_CLAMP * w), _CLAMP * mu / w)
        complement = float(z @ w) / n
        if capped:
            top = program.most - w
            y = np.clip(y, mu / (_CLAMP * top), _CLAMP * mu / top)
            complement = 0.5 * (complement + float(y @ top) / n)
        if program.criterion.kinked:  # μ is also the width of the kink: it falls only where central
            central = push <= _CENTRAL * mu
        else:
            fall = 0.1 if length > 0.9 else 0.3 if length > 0.5 else 0.8
            mu = max(min(fall * complement, mu), 0.05 * tolerance / n)
    if best is None:
        smooth_none = Smooth(0.0, m * 0.0, (), (), m * 0.0)
        return Optimum(w, smooth_none, 0.0, np.inf, mu)
    return best


def _newton(program: BarrierProgram, matrix: Floats, lean: Floats, w: Floats) -> Floats | None:
    """Return the step that spends the budget: K dw + λ c = lean, c·dw = B − c·w."""
    diagonal = np.diag(matrix).copy()
    for ridge in (1e-14, 1e-10, 1e-6):
        matrix[np.diag_indices_from(matrix)] = diagonal * (1.0 + ridge)
        try:
            factor = sl.cho_factor(matrix, lower=True, check_finite=False)
        except (np.linalg.LinAlgError, ValueError):
            continue
        both = sl.cho_solve(factor, np.column_stack([lean, program.units.cost]), check_finite=False)
        if np.isfinite(both).all():
            short = program.budget - float(program.units.cost @ w)
            price = (float(program.units.cost @ both[:, 0]) - short) / float(
                program.units.cost @ both[:, 1]
            )
            return np.asarray(both[:, 0] - price * both[:, 1])
    return None


def _room(x: Floats, move: Floats) -> float:
    with np.errstate(divide="ignore"):
        return float(np.min(np.where(move < 0.0, -x / move, np.inf), initial=np.inf))


def _dual(z: Floats, move: Floats) -> Floats:
    return np.asarray(z + min(1.0, _BACK * _room(z, move)) * move)


def _search(
    program: BarrierProgram, surrogate: Callable[[Floats], Smooth | None], here: Smooth,
    at: tuple[Floats, Floats], step: tuple[Floats, Floats], length: float, mu: float,
    slope: float,
) -> float:  # fmt: skip
    """Return the length of a step of weights and information: halved until it helps; 0 if never."""
    capped = np.isfinite(program.most)
    (w, m), (move, moved) = at, step

    def barrier(x: Floats) -> float:
        out = float(np.log(x).sum())
        return out + (float(np.log(program.most - x).sum()) if capped else 0.0)

    start = barrier(w)
    noise = 1e-13 * (1.0 + abs(here.value))
    for _ in range(30):
        x = w + length * move
        there = surrogate(m + length * moved)
        if there is not None:
            gain = there.value - here.value + mu * (barrier(x) - start)
            if gain >= 1e-4 * length * slope - noise:
                return length
        length *= 0.5
    return 0.0


TOLERANCE = 1e-7  # Relative gap between the continuous optimum and its bound
KINKED_TOLERANCE = 1e-3  # the same with kinks, where the bound closes slowly; a choice

_ROUNDS = 200
_STALE = 4  # rounds in which the gap must fall; this and the next two are choices
_SHORT = 2000  # units among which the first ones are sought
_LEFT = 0.9  # share of the weight with which an optimum is worth starting from; a choice
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
        """Return the same over some (K,) of the units; None where too much weight is lost."""
        place, whole = np.cumsum(kept) - 1, kept[self.index]
        if float(self.weight[whole].sum()) < _LEFT * float(self.weight.sum()):
            return None
        return replace(
            self, index=place[self.index[whole]], weight=self.weight[whole], price=self.price[kept],
            value=self.value if whole.all() else 0.0,
        )  # fmt: skip


def relax(
    units: CandidateSet,
    criterion: Criterion,  # φ
    budget: float,  # B, in the units of the cost
    prior: Floats | None = None,  # (P, P) M0, what is known before; zero by default
    *,
    most: int | None = None,  # how often a unit may be taken; any number of times by default
    names: Sequence[str] | None = None,
    tolerance: float | None = None,  # relative gap to stop at; by default 1e-7, of kinks 1e-3
    start: ApproximateDesign | None = None,  # optimum of a similar problem over the same units
) -> ApproximateDesign:
    """Return the continuous optimum of φ(M0 + Σ w_k A_kᵀA_k), Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most.

    Column generation: the optimum over few units, then a scan of all for units whose price exceeds
    those in use, until none is left (equivalence theorem). The bound is of the scan of all units.
    """
    if tolerance is None:
        tolerance = KINKED_TOLERANCE if criterion.kinked else TOLERANCE
    cap = np.inf if most is None else float(most)
    prior = given_prior(units, budget, prior)
    share = min(budget / float(units.cost.sum()), cap)
    spread = prior + units.information(np.full(len(units), share))
    criterion.require(spread, names)
    criterion = criterion.relevant(units, prior, budget)
    if share == cap and criterion.monotone:
        value = float(criterion.value(spread))  # all there is
        all_of_them = np.arange(len(units))
        return ApproximateDesign(
            all_of_them, np.full(len(units), cap), value, value, np.ones(len(units)), spread
        )
    most_spent = (1.0 - 1e-9) * cap * float(units.cost.sum())
    whole = BarrierProgram(criterion, units, min(budget, most_spent), cap, prior)
    if start is None or not criterion.value(
        prior + units.information(start.weight, start.index)
    ) > 0.0:  # fmt: skip
        active, weight = _first(whole, spread)
        order = 0.3
    else:
        active, weight, order = start.index, start.weight, 0.03
    best, top = np.inf, None
    gaps: list[float] = []
    for _ in range(_ROUNDS):
        last = len(active) == len(units)
        goal = 0.3 * tolerance if last else max(0.3 * tolerance, 0.1 * order)
        found = _solved(whole, active, weight, goal, order)
        price, bound = whole.scan(found.smooth)
        if found.smooth.below is not None:
            price = prices(units.rows, found.smooth.gradient)
        best = min(best, bound)
        if top is None or found.value > top[0].value:
            top = found, active
        gap = best / top[0].value - 1.0 if top[0].value > 0.0 else np.inf
        gaps.append(gap)
        if gap <= tolerance or last or (len(gaps) > _STALE and gap > 0.8 * min(gaps[:-_STALE])):
            break
        active, weight = _exchanged(whole, active, found.weight, price / units.cost)
        order = max(min(0.5 * gap, order), tolerance)
    if top is None or not top[0].value > 0.0:
        raise CannotAnswerError("the candidates determine too little: the criterion stays 0")
    return _pruned(whole, top[1], top[0].weight, best)


def given_prior(units: CandidateSet, budget: float, prior: Floats | None) -> Floats:
    """Return the prior information (P, P); refuse a budget that no unit fits into."""
    least = float(units.cost.min())
    if budget < least * (1.0 - 1e-12):
        raise InputError(f"a budget of {budget:g}; valid: at least {least:g}, the least cost")
    return np.zeros((units.size, units.size)) if prior is None else 0.5 * (prior + prior.T)


def _solved(
    whole: BarrierProgram, active: Ints, weight: Floats, goal: float, order: float
) -> Optimum:
    """Return the optimum over some units; what is not monotone may leave budget."""
    rows, cost = whole.units.rows[active], whole.units.cost[active]
    start = _feasible(weight, cost, whole.budget, whole.most)
    if not whole.criterion.monotone:  # one more unit without information
        rows = np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])
        cost = np.append(cost, whole.budget)
        left = min(max(1.0 - float(weight @ cost[:-1]) / whole.budget, 0.01), 0.99)
        start = np.append((1.0 - left) * start, left)
    found = solve(replace(whole, units=CandidateSet(rows, cost)), start, goal, order)
    return replace(found, weight=found.weight[: len(active)])


def _feasible(weight: Floats, cost: Floats, budget: float, cap: float) -> Floats:
    """Return weights over 0 and under the cap that spend the budget."""
    w = np.clip(weight, 1e-2 * budget / float(cost.sum()), 0.95 * cap)
    spent = float(w @ cost)
    if spent >= budget or not np.isfinite(cap):
        return np.asarray(w * (budget / spent))
    return np.asarray(w + (budget - spent) / float((cap - w) @ cost) * (cap - w))


def _first(whole: BarrierProgram, spread: Floats) -> tuple[Ints, Floats]:
    """Return units that a few multiplicative steps give the most weight.

    w_k <- w_k (price_k / mean price)^(2/3). Silvey, Titterington & Torsney (1978), Comm. Statistics
    A7.
    """
    units, budget = whole.units, whole.budget
    count = min(len(units), max(_SHORT, int(4 * budget / (whole.most * float(units.cost.min())))))
    smooth = whole.criterion.surrogate(spread, 0.1)(spread)
    if smooth is None or count == len(units):
        some = np.arange(len(units))
    else:
        rate = prices(units.rows, smooth.gradient) / units.cost
        even = np.linspace(0, len(units) - 1, count // 4).astype(np.int64)
        some = np.union1d(best_first(rate, count - len(even)), even)
    rows, cost = units.rows[some], units.cost[some]
    program = replace(whole, units=CandidateSet(rows, cost))
    w = np.full(len(some), budget / float(cost.sum()))
    for _ in range(_WARM):
        m = program.information(w)
        smooth = whole.criterion.surrogate(m, 0.1)(m)
        if smooth is None:
            break
        rate = np.maximum(prices(rows, smooth.gradient) / cost, 0.0)
        w = w * (rate + 1e-3 * float(rate.max())) ** (2 / 3)
        w *= budget / float(w @ cost)
    needed = budget / whole.most
    order = np.argsort(-w * cost, kind="stable")
    size = max(units.size, int(np.searchsorted(np.cumsum(cost[order]), 2 * needed)) + 1)
    while size < len(some):
        chosen = order[:size]
        m = program.information(np.where(np.isin(np.arange(len(w)), chosen), w, 0.0))
        smooth = whole.criterion.surrogate(m, 0.1)(m)
        if smooth is not None and float(whole.criterion.value(m)) > 0.0:
            break
        size *= 2
    chosen = np.sort(order[:size])
    return some[chosen], w[chosen]


def _exchanged(
    whole: BarrierProgram, active: Ints, weight: Floats, rate: Floats
) -> tuple[Ints, Floats]:
    """Return the units without those of no weight, with those of the best prices, and weights."""
    cost = whole.units.cost
    inner = (
        weight < 0.99 * whole.most if np.isfinite(whole.most) else np.ones(len(weight), np.bool_)
    )
    price = float(rate[active[inner]].max()) if inner.any() else float(rate[active].min())
    share = weight * cost[active] / whole.budget
    kept = (share > 1e-5 / len(active)) | (rate[active] > 0.999 * price)
    outside = rate.copy()
    outside[active] = -np.inf
    new = best_first(outside, 2 * whole.units.size)
    new = new[outside[new] > price * (1.0 + 1e-12)]
    little = 0.02 * whole.budget / (cost[new] * max(len(new), 1))
    index = np.concatenate([active[kept], new])
    order = np.argsort(index)
    return index[order], np.concatenate([weight[kept], little])[order]


def _pruned(whole: BarrierProgram, active: Ints, weight: Floats, bound: float) -> ApproximateDesign:
    """Return the optimum without weights that change nothing."""
    units, criterion = whole.units, whole.criterion
    share = weight * units.cost[active] / whole.budget
    kept = share > 1e-8 * float(share.max())
    index, w = active[kept], weight[kept]
    if criterion.monotone:
        w = np.minimum(w * (whole.budget / float(w @ units.cost[index])), whole.most)
    m = whole.prior + units.information(w, index)
    smooth = criterion.surrogate(m, 1e-3)(m)
    value = float(criterion.value(m))
    price = np.ones(len(units)) if smooth is None else prices(units.rows, smooth.gradient)
    return ApproximateDesign(index, w, value, max(bound, value), price, m)
