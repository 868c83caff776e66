"""The approximate design: optimal real weights of units, with a certified bound of φ."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy.linalg as sl

from hilcal.design.criterion import CandidateSet, Objective, Smooth, best_first, prices, upper_bound
from hilcal.errors import CannotAnswerError, InputError
from hilcal.types import Bools, Floats, Ints

# choices, usual in interior-point methods (Wright 1997), without a study
_STEPS = 80
_BACK = 0.995  # share of the way to the boundary
_CENTRAL = 1.0  # squared Newton decrement, over μ, below which μ may fall
_CLAMP = 1e4  # largest ratio of a dual and μ / w


@dataclass(frozen=True, eq=False)
class BarrierProgram:
    """Maximise φ(M0 + Σ w_k A_kᵀA_k) over w with Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most."""

    objective: Objective  # φ and M0, of n units
    budget: float  # B
    max_weight: float  # upper bound of each weight; may be infinite

    def information(self, weight: Floats) -> Floats:
        """Return (P, P) M."""
        return np.asarray(self.objective.prior + self.change(weight))

    def change(self, weight: Floats) -> Floats:
        """Return (P, P) Σ w_k A_kᵀA_k; weights may be negative."""
        rows = self.objective.units.rows
        flat = rows.reshape(-1, rows.shape[2])
        return np.asarray((flat * np.repeat(weight, rows.shape[1])[:, None]).T @ flat)

    def scan(self, smooth: Smooth) -> tuple[Floats, float]:
        """Return tr(Z A_kᵀA_k) of all units, and the bound of φ over them."""
        units, prior = self.objective.units, self.objective.prior
        above = prices(units.rows, smooth.above)
        below = None if smooth.below is None else prices(units.rows, smooth.below)
        return above, upper_bound(
            smooth, prior, above, units.cost, self.budget, self.max_weight, below
        )

    def curvature(self, smooth: Smooth) -> Floats:
        """Return (n, n) −∂²f/∂w_k∂w_l, positive semidefinite."""
        rows = self.objective.units.rows
        n, size, p = rows.shape
        flat = rows.reshape(-1, p)
        out = np.zeros((n, n))
        for c, x, y in smooth.products:
            out -= c * _product(rows, x, y)
        for factor, v in smooth.squares:
            squares = np.sum((flat @ v).reshape(n, size, -1) ** 2, axis=1)
            out -= squares @ factor @ squares.T
        return np.asarray(0.5 * (out + out.T))


def _product(rows: Floats, x: Floats, y: Floats) -> Floats:
    """Return (n, n) tr(X H_k Y H_l) of (n, R, P) rows; x and y are roots (P, r) of X and Y."""
    left = rows @ x
    right = left if y is x else rows @ y
    size = rows.shape[1]
    if 2 * size * size <= min(left.shape[2], right.shape[2]):  # by the rows
        out = np.zeros((len(rows), len(rows)))
        for i in range(size):
            for j in range(i + 1):
                products = left[:, i] @ left[:, j].T
                products *= products if y is x else right[:, i] @ right[:, j].T
                out += products if i == j else products + products.T
        return out
    # by the matrices T_k = L_xᵀ H_k L_y: the sum of T_k ∘ T_l
    t = np.matmul(left.transpose(0, 2, 1), right).reshape(len(rows), -1)
    return np.asarray(t @ t.T)


@dataclass(frozen=True, slots=True, eq=False)
class Optimum:
    """A continuous optimum."""

    weight: Floats  # (n,) w
    smooth: Smooth  # f at w, with the matrices of the bound
    value: float  # φ
    bound: float  # of φ over these units

    @property
    def gap(self) -> float:
        """Largest relative distance of φ from the optimum."""
        return self.bound / self.value - 1.0 if self.value > 0.0 else np.inf


def solve(program: BarrierProgram, start: Floats, tolerance: float, order: float = 1.0) -> Optimum:
    """Return the optimum to a relative gap, from weights (n,) in (0, most) that spend B.

    Newton's method on the barrier problem f(w) + μ Σ log w_k + μ Σ log(most − w_k), with the duals
    z of the bounds as separate variables (Wright 1997, Primal-Dual Interior-Point Methods); μ falls
    to 0 from `order` / n. Criteria with a kink have a surrogate of order μ.
    """
    w, n, criterion = start, len(start), program.objective.criterion
    capped = np.isfinite(program.max_weight)
    m = program.information(w)
    mu = max(min(order, 1.0), tolerance) / n
    z, y = mu / w, mu / (program.max_weight - w)
    best: Optimum | None = None
    central = False
    for step in range(_STEPS):
        surrogate = criterion.surrogate(m, mu)
        smooth = surrogate(m)
        if smooth is None:
            break
        iterate = Optimum(w, smooth, float(criterion.value(m)), program.scan(smooth)[1])
        if best is None or iterate.gap < best.gap:
            best = iterate
        if iterate.gap <= tolerance or step == _STEPS - 1:
            break
        if central:
            mu = max(0.2 * mu, 0.1 * tolerance / n)
            central, z, y = False, 0.2 * z, 0.2 * y
            surrogate = criterion.surrogate(m, mu)
            smooth = surrogate(m) or smooth
        slope = prices(program.objective.units.rows, smooth.gradient)
        top = program.max_weight - w
        rise = slope + mu / w - mu / top
        move = _newton(program, program.curvature(smooth) + np.diag(z / w + y / top), rise, w)
        if move is None:
            break
        length = min(1.0, _BACK * _room(w, move), _BACK * _room(top, -move))
        push = float(rise @ move)
        moved = program.change(move)
        length = _search(program, surrogate, smooth, (w, m), (move, moved), length, mu, push)
        if length == 0.0 and (criterion.kinked or mu <= tolerance / (10 * n)):
            break
        z = _dual(z, mu / w - z - z / w * move)
        y = _dual(y, mu / top - y + y / top * move)
        w = w + length * move
        m, top = program.information(w), program.max_weight - w
        z = np.clip(z, mu / (_CLAMP * w), _CLAMP * mu / w)
        y = np.clip(y, mu / (_CLAMP * top), _CLAMP * mu / top)
        complement = float(z @ w) / n
        if capped:
            complement = 0.5 * (complement + float(y @ top) / n)
        if criterion.kinked:  # μ, also the width of the kink, falls at central points only
            central = push <= _CENTRAL * mu
        else:
            fall = 0.1 if length > 0.9 else 0.3 if length > 0.5 else 0.8
            mu = max(min(fall * complement, mu), 0.05 * tolerance / n)
    if best is None:
        return Optimum(w, Smooth(0.0, m * 0.0, (), (), m * 0.0), 0.0, np.inf)
    return best


def _newton(program: BarrierProgram, matrix: Floats, rise: Floats, w: Floats) -> Floats | None:
    """Return the step that spends the budget: K dw + λ c = rise, c·dw = B − c·w."""
    diagonal = np.diag(matrix).copy()
    for ridge in (1e-14, 1e-10, 1e-6):
        matrix[np.diag_indices_from(matrix)] = diagonal * (1.0 + ridge)
        try:
            factor = sl.cho_factor(matrix, lower=True, check_finite=False)
        except (np.linalg.LinAlgError, ValueError):
            continue
        cost = program.objective.units.cost
        solved = sl.cho_solve(factor, np.column_stack([rise, cost]), check_finite=False)
        if np.isfinite(solved).all():
            unspent = program.budget - float(cost @ w)
            price = (float(cost @ solved[:, 0]) - unspent) / float(cost @ solved[:, 1])
            return np.asarray(solved[:, 0] - price * solved[:, 1])
    return None


def _room(x: Floats, move: Floats) -> float:
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.min(np.where(move < 0.0, -x / move, np.inf), initial=np.inf))


def _dual(z: Floats, move: Floats) -> Floats:
    return np.asarray(z + min(1.0, _BACK * _room(z, move)) * move)


def _search(
    program: BarrierProgram, surrogate: Callable[[Floats], Smooth | None], current: Smooth,
    point: tuple[Floats, Floats], step: tuple[Floats, Floats], length: float, mu: float,
    slope: float,
) -> float:  # fmt: skip
    """Return the step length, halved until the barrier function rises; 0 if it never does."""
    capped = np.isfinite(program.max_weight)
    (w, m), (move, moved) = point, step

    def barrier(x: Floats) -> float:
        out = float(np.log(x).sum())
        return out + (float(np.log(program.max_weight - x).sum()) if capped else 0.0)

    start = barrier(w)
    noise = 1e-13 * (1.0 + abs(current.value))
    for _ in range(30):
        x = w + length * move
        trial = surrogate(m + length * moved)
        if trial is not None:
            gain = trial.value - current.value + mu * (barrier(x) - start)
            if gain >= 1e-4 * length * slope - noise:
                return length
        length *= 0.5
    return 0.0


TOLERANCE = 1e-7  # relative gap between the continuous optimum and its bound
KINKED_TOLERANCE = 1e-3  # the same with kinks, where the bound closes slowly; a choice

_ROUNDS = 200
_STALE = 4  # rounds in which the gap must fall; a choice
_SHORT = 2000  # units among which the first active units are chosen; a choice
_LEAST_SHARE = 0.9  # least share of an optimum's weight on a subset to start from it; a choice
_WARM = 12  # multiplicative steps that choose the first active units


@dataclass(frozen=True, slots=True, eq=False)
class ApproximateDesign:
    """A continuous optimum with its certificate."""

    index: Ints  # (S,) ascending indices of the units of positive weight
    weight: Floats  # (S,) their weights w; Σ w c ≤ B
    value: float  # φ of these weights
    bound: float  # upper bound of φ of all plans within the budget
    price: Floats  # (K,) marginal value ∂f/∂w_k of each unit
    information: Floats  # (P, P) M0 + Σ w_k A_kᵀA_k

    @property
    def gap(self) -> float:
        """Relative distance between value and bound."""
        return self.bound / self.value - 1.0 if self.value > 0.0 else np.inf

    def among(self, subset: Bools) -> "ApproximateDesign | None":
        """Return the design on a subset (K,) of the units; None if too much weight is lost."""
        place, inside = np.cumsum(subset) - 1, subset[self.index]
        if float(self.weight[inside].sum()) < _LEAST_SHARE * float(self.weight.sum()):
            return None
        return replace(
            self, index=place[self.index[inside]], weight=self.weight[inside],
            price=self.price[subset], value=self.value if inside.all() else 0.0,
        )  # fmt: skip


def relax(
    objective: Objective,
    budget: float,  # B, in the units of the cost
    *,
    max_weight: int | None = None,  # largest weight of a unit; unlimited by default
    tolerance: float | None = None,  # relative gap to stop at; by default 1e-7, with kinks 1e-3
    start: ApproximateDesign | None = None,  # optimum of a similar problem over the same units
) -> ApproximateDesign:
    """Return the continuous optimum of φ(M0 + Σ w_k A_kᵀA_k), Σ w_k c_k ≤ B, 0 ≤ w_k ≤ most.

    Column generation: find the optimum over few active units, then scan all units for prices above
    the active ones, until there are none (equivalence theorem). The bound is over all units.
    """
    objective = checked(objective, budget)
    units, criterion = objective.units, objective.criterion
    if tolerance is None:
        tolerance = KINKED_TOLERANCE if criterion.kinked else TOLERANCE
    cap = np.inf if max_weight is None else float(max_weight)
    share = min(budget / float(units.cost.sum()), cap)
    spread = objective.information(np.full(len(units), share))
    criterion.require(spread, objective.names)
    criterion = criterion.relevant(units, objective.prior, budget)
    if share == cap and criterion.monotone:
        value = float(criterion.value(spread))
        index, weight, price = np.arange(len(units)), np.full(len(units), cap), np.ones(len(units))
        return ApproximateDesign(index, weight, value, value, price, spread)
    most_spent = (1.0 - 1e-9) * cap * float(units.cost.sum())
    objective = replace(objective, criterion=criterion)
    program = BarrierProgram(objective, min(budget, most_spent), cap)
    at_start = spread if start is None else objective.information(start.weight, start.index)
    if start is None or not criterion.value(at_start) > 0.0:
        (active, weight), order = _first_active(program, spread), 0.3
    else:
        active, weight, order = start.index, start.weight, 0.03
    best, top = np.inf, None
    gaps: list[float] = []
    for _ in range(_ROUNDS):
        last = len(active) == len(units)
        goal = 0.3 * tolerance if last else max(0.3 * tolerance, 0.1 * order)
        optimum = _solved(program, active, weight, goal, order)
        price, bound = program.scan(optimum.smooth)
        if optimum.smooth.below is not None:
            price = prices(units.rows, optimum.smooth.gradient)
        best = min(best, bound)
        if top is None or optimum.value > top[0].value:
            top = optimum, active
        gap = best / top[0].value - 1.0 if top[0].value > 0.0 else np.inf
        gaps.append(gap)
        if gap <= tolerance or last or (len(gaps) > _STALE and gap > 0.8 * min(gaps[:-_STALE])):
            break
        active, weight = _exchanged(program, active, optimum.weight, price / units.cost)
        order = max(min(0.5 * gap, order), tolerance)
    if top is None or not top[0].value > 0.0:
        raise CannotAnswerError("the candidates determine too little: the criterion stays 0")
    return _pruned(program, top[1], top[0].weight, best)


def checked(objective: Objective, budget: float) -> Objective:
    """Return the objective with a symmetric prior; refuse a budget below the least cost."""
    least = float(objective.units.cost.min())
    if budget < least * (1.0 - 1e-12):
        raise InputError(f"a budget of {budget:g}; valid: at least {least:g}, the least cost")
    return replace(objective, prior=0.5 * (objective.prior + objective.prior.T))


def _solved(
    program: BarrierProgram, active: Ints, weight: Floats, goal: float, order: float
) -> Optimum:
    """Return the optimum over active units; a criterion that is not monotone may spend less."""
    units = program.objective.units[active]
    rows, cost = units.rows, units.cost
    start = _feasible(weight, cost, program.budget, program.max_weight)
    if not program.objective.criterion.monotone:  # one more unit without information
        rows = np.concatenate([rows, np.zeros((1, *rows.shape[1:]))])
        cost = np.append(cost, program.budget)
        unspent = min(max(1.0 - float(weight @ cost[:-1]) / program.budget, 0.01), 0.99)
        start = np.append((1.0 - unspent) * start, unspent)
    objective = replace(program.objective, units=CandidateSet(rows, cost))
    optimum = solve(replace(program, objective=objective), start, goal, order)
    return replace(optimum, weight=optimum.weight[: len(active)])


def _feasible(weight: Floats, cost: Floats, budget: float, cap: float) -> Floats:
    """Return weights in (0, cap) that spend the budget."""
    w = np.clip(weight, 1e-2 * budget / float(cost.sum()), 0.95 * cap)
    spent = float(w @ cost)
    if spent >= budget or not np.isfinite(cap):
        return np.asarray(w * (budget / spent))
    return np.asarray(w + (budget - spent) / float((cap - w) @ cost) * (cap - w))


def _first_active(program: BarrierProgram, spread: Floats) -> tuple[Ints, Floats]:
    """Return the units, and weights, that are largest after a few multiplicative steps.

    w_k <- w_k (price_k / mean price)^(2/3). Silvey, Titterington & Torsney (1978), Comm. Statistics
    A7.
    """
    units, criterion = program.objective.units, program.objective.criterion
    budget = program.budget
    count = min(
        len(units), max(_SHORT, int(4 * budget / (program.max_weight * float(units.cost.min()))))
    )
    smooth = criterion.surrogate(spread, 0.1)(spread)
    if smooth is None or count == len(units):
        short = np.arange(len(units))
    else:
        rate = prices(units.rows, smooth.gradient) / units.cost
        spaced = np.linspace(0, len(units) - 1, count // 4).astype(np.int64)
        short = np.union1d(best_first(rate, count - len(spaced)), spaced)
    shortened = replace(program, objective=program.objective.among(short))
    rows, cost = shortened.objective.units.rows, units.cost[short]
    w = np.full(len(short), budget / float(cost.sum()))
    for _ in range(_WARM):
        m = shortened.information(w)
        smooth = criterion.surrogate(m, 0.1)(m)
        if smooth is None:
            break
        rate = np.maximum(prices(rows, smooth.gradient) / cost, 0.0)
        w = w * (rate + 1e-3 * float(rate.max())) ** (2 / 3)
        w *= budget / float(w @ cost)
    needed = budget / program.max_weight
    order = np.argsort(-w * cost, kind="stable")
    size = max(units.size, int(np.searchsorted(np.cumsum(cost[order]), 2 * needed)) + 1)
    while size < len(short):
        chosen = order[:size]
        m = shortened.information(np.where(np.isin(np.arange(len(w)), chosen), w, 0.0))
        smooth = criterion.surrogate(m, 0.1)(m)
        if smooth is not None and float(criterion.value(m)) > 0.0:
            break
        size *= 2
    chosen = np.sort(order[:size])
    return short[chosen], w[chosen]


def _exchanged(
    program: BarrierProgram, active: Ints, weight: Floats, rate: Floats
) -> tuple[Ints, Floats]:
    """Return the active units and weights: drop units of no weight, add units of best prices."""
    units = program.objective.units
    cost, inner = units.cost, weight < 0.99 * program.max_weight
    price = float(rate[active[inner]].max()) if inner.any() else float(rate[active].min())
    share = weight * cost[active] / program.budget
    retained = (share > 1e-5 / len(active)) | (rate[active] > 0.999 * price)
    outside = rate.copy()
    outside[active] = -np.inf
    entering = best_first(outside, 2 * units.size)
    entering = entering[outside[entering] > price * (1.0 + 1e-12)]
    small = 0.02 * program.budget / (cost[entering] * max(len(entering), 1))
    index = np.concatenate([active[retained], entering])
    order = np.argsort(index)
    return index[order], np.concatenate([weight[retained], small])[order]


def _pruned(
    program: BarrierProgram, active: Ints, weight: Floats, bound: float
) -> ApproximateDesign:
    """Return the optimum without negligible weights."""
    units, criterion = program.objective.units, program.objective.criterion
    share = weight * units.cost[active] / program.budget
    retained = share > 1e-8 * float(share.max())
    index, w = active[retained], weight[retained]
    if criterion.monotone:
        w = np.minimum(w * (program.budget / float(w @ units.cost[index])), program.max_weight)
    m = program.objective.information(w, index)
    smooth = criterion.surrogate(m, 1e-3)(m)
    value = float(criterion.value(m))
    price = np.ones(len(units)) if smooth is None else prices(units.rows, smooth.gradient)
    return ApproximateDesign(index, w, value, max(bound, value), price, m)
