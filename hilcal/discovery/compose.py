"""Candidates beyond the screening: functions of composed quantities, more factors, other numbers.

f(u) with u = φ₁ + Σ w_i φ_i, the φ products of functions of two quantities at most, is a
single-index model, one step of projection pursuit (Friedman and Stuetzle 1981, JASA 76, 817).

1. All bends and steps of single products are screened at all sites; see `bends`.
2. Of the best, u is extended by a further product: f(u + w φ) ≈ f(u) + w φ f'(u), so that what
   φ f'(u) explains beside f(u) and its level f'(u) ranks all φ, and gives w (Gauss-Newton).
3. Of the best of all, levels, weights and an exponent are refined together, the coefficient
   projected out.

What is found pays for all arguments of its complexity, for the levels, and for each weight and
exponent ½ ln ν.

Of the best candidates of the screening, too, each is multiplied by every function of another
quantity, up to the complexity `MOST`, and each number that is free is varied (`grown`). What is
found pays as if all products of its kind had been tried, or for the values that were.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, composed, different
from hilcal.discovery.screen import LEAST_MOTION, SEEN, unit_rows
from hilcal.discovery.shapes import Shape
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.discovery.problem import Beside
    from hilcal.discovery.screen import LawTerm, ScreenedTerm

BEST, EXTENDED = 10, 3  # bends, and further products of each, that are extended; a choice, by time
LARGEST_SUM = 3  # Products of a sum at most; a choice
QUANTITIES = 2  # Recorded quantities of an argument at most; a choice: sums of more are too many
REFINED = 2  # Functions of single products, and of sums, that are refined; a choice, by time
QUANTILES = tuple(k / 20 for k in range(1, 20))  # Levels tried, shares of the readings below
TIMES = (0.4, 0.7, 1.0, 1.5, 2.2)  # weights tried, by that of the linearisation; a choice
EVALUATIONS = 60  # Of the sum of squares, for each number that is refined; a choice
DIGITS = 3
LEFT = 1e-3  # Share of a column's square that others must leave; a choice
WORST = 1e12
POWERS = {"above": shapes.ABOVE_POWER, "below": shapes.BELOW_POWER}
LEAST_POWER, MOST_POWER = 0.5, 4.0  # exponents of a bend, from 1 on under wrenches; a choice
LOG2 = float(np.log(2.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Bent:
    """A function of a composed quantity at a site."""

    s: int  # the site
    which: tuple[int, ...]  # products of the argument, by index in the grammar
    weights: tuple[float, ...]  # of these; the first is 1
    shape: Shape  # the function
    numbers: tuple[float, ...]  # of it
    evidence: float  # logarithm, without what the search costs
    price: float  # what the choice of the argument costs

    @property
    def odds(self) -> float:
        return self.evidence - self.price


class SiteSums:
    """Sums of squares of one site beside the model and chosen terms, for any amplitude."""

    def __init__(self, beside: Beside, s: int) -> None:
        """Project the chosen terms out."""
        screen = beside.problem.screen
        form = screen.form[s]
        self.evidence = beside.evidence
        self.slope: Floats = form.T @ beside.problem.thin
        self.free: Floats = np.float32(beside.problem.share) * screen.free[s]
        for told, unit in beside.taken():
            own = form.T @ unit
            self.slope = self.slope - np.float32(told) * own
            self.free = self.free - np.outer(own, own)
        self.moved: Floats = np.sum(form**2, axis=0)
        self.ones: Floats = self.free.sum(axis=1)
        self.one = float(self.ones.sum())
        self.constant = self.one > SEEN * float(self.moved.sum()) + LEAST_MOTION
        self.told = float(self.slope.sum())

    def odds(self, values: Floats, constant: bool = True) -> Floats:
        """(C,) evidence of amplitudes (C, K), the better of without and with a constant."""
        square = np.einsum("ck,ck->c", values @ self.free, values)
        seen = square > SEEN * (values**2 @ self.moved) + LEAST_MOTION
        slope, across = values @ self.slope, values @ self.ones
        return _better(self.evidence, slope, np.where(seen, square, 0.0), across,
                       self.told, self.one if constant and self.constant else 0.0)  # fmt: skip


def _better(
    evidence: Any, slope: Floats, square: Floats, across: Floats, told: Any, one: Any
) -> Floats:
    """Evidence of columns, the better of without and with a constant beside them."""
    seen = square > 0
    gain = np.where(seen, slope**2 / np.where(seen, square, 1.0), 0.0)
    alone = np.where(seen, evidence(gain, 1), -np.inf)
    has = np.asarray(one) > 0
    safe = np.where(has, one, 1.0)
    left = square - across**2 / safe
    both = seen & has & (left > LEFT * square)
    rest = slope - across * told / safe
    gain = np.where(both, rest**2 / np.where(both, left, 1.0) + told**2 / safe, 0.0)
    return np.maximum(alone, np.where(both, evidence(gain, 2) - LOG2, -np.inf))


def composed_terms(beside: Beside) -> list[LawTerm]:
    """Return terms of functions of composed quantities."""
    found = _screened(beside)
    at = {s: SiteSums(beside, s) for s in {b.s for b in found}}
    sums: list[_Bent] = []
    frontier = found
    for _ in range(LARGEST_SUM - 1):
        frontier = [e for b in frontier[:BEST] for e in _extended(beside, at[b.s], b)]
        frontier.sort(key=lambda b: -b.odds)
        sums += frontier
    out: list[LawTerm] = []
    for b in (*_apart(found)[:REFINED], *_apart(sums)[:REFINED]):
        out += _terms(beside, at[b.s], b)
    return out


def _apart(found: list[_Bent]) -> list[_Bent]:
    """The best of each argument at each site, the best first."""
    found = sorted(found, key=lambda b: -b.odds)
    out: dict[tuple[int, frozenset[int]], _Bent] = {}
    for b in found:
        out.setdefault((b.s, frozenset(b.which)), b)
    return list(out.values())


def _screened(beside: Beside) -> list[_Bent]:
    """Return the best bends of single products."""
    p = beside.problem
    screen, all_ = p.screen, p.screen.bends
    if not len(all_.argument):
        return []

    def by_site(v: Floats) -> Floats:
        return np.asarray(np.einsum("srk,r->sk", screen.form, v))

    one = screen.one
    share = np.float32(p.share)
    moved = by_site(p.thin)
    slope, told = moved @ all_.values.T, moved.sum(axis=1)
    square, across = share * all_.square, share * all_.across_one
    size = share * screen.square[:, one]
    for along, unit in beside.taken():
        own = by_site(unit)
        mine, ones = own @ all_.values.T, own.sum(axis=1)
        slope, told = slope - np.float32(along) * mine, told - along * ones
        square = np.where(square > 0, square - mine**2, 0.0)
        across, size = across - ones[:, None] * mine, size - ones**2
    square = np.where(square > LEFT * share * all_.square, square, 0.0)
    size = np.where(size > LEFT * share * screen.square[:, one], size, 0.0)
    odds = _better(beside.evidence, slope, square, across, told[:, None], size[:, None])
    cost = screen.grammar.cost[all_.argument]
    price = screen.grammar.price_of_argument(cost)
    odds = odds - price
    out: dict[tuple[int, int], _Bent] = {}
    for at in np.argsort(-odds, axis=None)[: 20 * BEST].tolist():
        s, c = divmod(at, odds.shape[1])
        k = int(all_.argument[c])
        if not np.isfinite(odds[s, c]):
            break
        b = _Bent(
            s, (k,), (1.0,), all_.shape[c], all_.numbers[c],
            float(odds[s, c] + price[c]), float(price[c]),
        )  # fmt: skip
        out.setdefault((screen.alias[s], k), b)
        if len(out) == BEST:
            break
    return list(out.values())


def _values(beside: Beside, which: tuple[int, ...]) -> Floats:
    """(P, K) products at the readings of the screening, in their own units."""
    screen = beside.problem.screen
    some = list(which)
    values = screen.grammar.values[some][:, screen.readings] * screen.grammar.size[some, None]
    return np.asarray(values, dtype=float)


def _extended(beside: Beside, site: SiteSums, b: _Bent) -> list[_Bent]:
    """Return the argument with the best of further products added, at the best level."""
    grammar = beside.problem.screen.grammar
    own = frozenset[str]().union(*(grammar.depends[k] for k in b.which))
    unit = grammar.unit_of_smooth
    more = [
        k
        for k in grammar.smooth.tolist()
        if unit[k] == unit[b.which[0]]
        and k not in b.which
        and len(own | grammar.depends[k]) <= QUANTITIES
    ]
    if not more:
        return []
    u = np.asarray(b.weights) @ _values(beside, b.which)
    phi = _values(beside, tuple(more))
    slope = b.shape.slope(u, b.numbers)
    columns = np.vstack([b.shape.value(u, b.numbers), slope, phi * slope])
    size = np.sqrt(np.mean(columns**2, axis=1))
    x = unit_rows(columns)
    gain, beside_first = _gains(site, x)
    out = []
    for j in np.argsort(-gain)[:EXTENDED].tolist():
        if not np.isfinite(gain[j]) or beside_first[0, j] == 0:
            continue
        weight = float(beside_first[1, j] / size[j + 2] / (beside_first[0, j] / size[0]))
        if not np.isfinite(weight) or weight == 0:
            continue
        out.append(_leveled(beside, site, b, int(more[j]), weight, len(more)))
    return out


def _gains(site: SiteSums, x: Floats) -> tuple[Floats, Floats]:
    """Gain (P,) of each further column of X (2 + P, K) beside the first two, −inf if no other.

    Also (2, P) coefficients of the first column and of the further one, fitted together.
    """
    free = (x @ site.free).astype(float)
    slope = (x @ site.slope).astype(float)
    gram = free @ x.T.astype(float)[:, :2]
    square = np.einsum("pk,pk->p", free, x)
    own = gram[:2] + 1e-6 * np.diag(np.diag(gram[:2])) + 1e-12 * np.eye(2)
    step = np.linalg.solve(own, slope[:2])
    lift = np.linalg.solve(own, gram[2:].T)
    left = square[2:] - np.einsum("ip,pi->p", lift, gram[2:])
    rest = slope[2:] - gram[2:] @ step
    seen = left > LEFT * square[2:] + LEAST_MOTION
    last = rest / np.where(seen, left, 1.0)
    gain = np.where(seen, rest * last, -np.inf)
    return gain, np.vstack([step[0] - lift[0] * last, last])


def _leveled(
    beside: Beside, site: SiteSums, b: _Bent, more: int, weight: float, choices: int
) -> _Bent:
    """Return the sum with a further product, its weight and level the best of some."""
    grammar = beside.problem.screen.grammar
    which = (*b.which, more)
    a = _values(beside, which)
    tried: list[tuple[float, tuple[float, ...], tuple[float, ...]]] = []
    for times in TIMES:
        weights = (*b.weights, times * weight)
        u = np.asarray(weights) @ a
        levels = np.quantile(u, QUANTILES)
        rest = [np.full(len(levels), n) for n in b.numbers[1:]]
        own: list[Any] = [levels[:, None], *(n[:, None] for n in rest)]
        odds = site.odds(unit_rows(b.shape.value(u, tuple(own))))
        k = int(np.argmax(odds))
        tried.append((float(odds[k]), weights, (float(levels[k]), *b.numbers[1:])))
    evidence, weights, numbers = max(tried)
    price = float(np.log(choices)) + LOG2 * (int(grammar.cost[more]) + 1)
    price += 0.5 * float(np.log(beside.dof))
    return replace(
        b, which=which, weights=weights, numbers=numbers, evidence=evidence, price=b.price + price
    )


def _terms(beside: Beside, site: SiteSums, b: _Bent) -> list[LawTerm]:
    """Return a function with its numbers refined, and with an exponent, each with a constant."""
    screen = beside.problem.screen
    each = 0.5 * float(np.log(beside.dof))
    grid = float(np.log(len(QUANTILES) * len(b.numbers)))
    sums = b.price - float(screen.grammar.price_of_argument(screen.grammar.cost[b.which[0]]))
    made = [(b, grid + sums)]
    if b.shape.name in POWERS:
        bent = replace(b, shape=POWERS[b.shape.name], numbers=(*b.numbers, 1.0))
        made.append((bent, grid + sums + each))
    out = []
    for x, price in made:
        k = screen.grammar.index(_refined(beside, site, x))
        if k is None:
            continue
        out.append(beside.term(((b.s, k),), price))
        if screen.visible(b.s, screen.one):
            out.append(beside.term(((b.s, k), (b.s, screen.one)), price + LOG2))
    return out


def _refined(beside: Beside, site: SiteSums, b: _Bent) -> Amplitude:
    """Return the amplitude with weights, levels and exponent where it explains most."""
    from scipy.optimize import minimize  # slow to import

    a = _values(beside, b.which)
    more = len(b.weights) - 1
    spread = float(np.std(np.asarray(b.weights) @ a))
    scale = [abs(w) for w in b.weights[1:]]
    scale += [spread if k in b.shape.places else abs(n) for k, n in enumerate(b.numbers)]
    begin = np.array([*b.weights[1:], *b.numbers])
    grammar = beside.problem.screen.grammar
    low, high = float(np.finfo(float).tiny), np.inf
    if b.shape in POWERS.values():
        elastic = any(grammar.at(k).elastic for k in b.which)
        low, high = 1.0 if elastic else LEAST_POWER, MOST_POWER

    def parts(x: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
        now = [float(f"{v:.{DIGITS}g}") for v in begin + np.asarray(scale) * x]
        return (1.0, *now[:more]), tuple(now[more:])

    def objective(x: Floats) -> float:
        weights, own = parts(x)
        if not all(low <= n <= high for k, n in enumerate(own) if k not in b.shape.places):
            return WORST
        values = b.shape.value(np.asarray(weights) @ a, own)
        return min(-float(site.odds(unit_rows(values[None]))[0]), WORST)

    start = np.zeros(len(begin))
    found = minimize(
        objective, start, method="Nelder-Mead",
        options={"maxfev": EVALUATIONS * len(begin), "xatol": 1e-3, "fatol": 1e-2,
                 "initial_simplex": np.vstack([start, 0.15 * np.eye(len(begin))])},
    )  # fmt: skip
    weights, own = parts(found.x if found.fun < objective(start) else start)
    terms = tuple((w, grammar.at(k)) for w, k in zip(weights, b.which, strict=True))
    factors = terms[0][1].factors
    recorded = len(terms) == 1 and len(factors) == 1 and factors[0].shape is shapes.LINEAR
    quantity = factors[0].variable if recorded else composed(terms)
    return Amplitude((Factor(quantity, b.shape, own),))


MOST = 4  # Complexity of a product; a choice
MOST_FACTORS = 3  # Factors of a product; a choice
GROWN, VARIED = 12, 24  # candidates that are multiplied, and varied; a choice, by time
KEPT = 24  # Of either the best that are scored in full; a choice
FACTORS = (0.35, 0.5, 0.7, 0.85, 1.2, 1.4, 2.0, 2.8)  # of numbers of the grid; a choice


def grown(beside: Beside, best: list[ScreenedTerm]) -> list[LawTerm]:
    """Return terms of further factors and other numbers, of the best of the screening."""
    found = list({(x.s, x.f): x for x in best}.values())
    products = [(x.s, a, 0.0) for x in found[:GROWN] for a in _products(beside, x.s, x.f)]
    numbers = [(x.s, a, price) for x in found[:VARIED] for a, price in _numbers(beside, x.f)]
    return [*_best_terms(beside, products), *_best_terms(beside, numbers)]


def _products(beside: Beside, s: int, f: int) -> list[Amplitude]:
    screen = beside.problem.screen
    a = screen.grammar.at(f)
    if not a.factors or len(a.factors) >= MOST_FACTORS:
        return []
    out = []
    for more in screen.grammar.singles:
        if a.cost + more.cost > MOST or not all(different(more, x) for x in a.factors):
            continue
        product = Amplitude((*a.factors, more))
        known = screen.grammar.place(product)
        if known is not None and known < len(screen.grammar.amplitudes):
            continue  # it is screened
        if screen.sites[s].takes(product.elastic, product.sensed):
            out.append(product)
    return out


def _numbers(beside: Beside, f: int) -> list[tuple[Amplitude, float]]:
    grammar = beside.problem.screen.grammar
    a = grammar.at(f)
    out = []
    for i, factor in enumerate(a.factors):
        for n in factor.shape.free:
            values = _other_values(factor, n, grammar.read(factor.variable))
            price = float(np.log(len(values) + 1))
            for value in values:
                numbers = (*factor.numbers[:n], value, *factor.numbers[n + 1 :])
                other = replace(factor, numbers=numbers)
                out.append((Amplitude((*a.factors[:i], other, *a.factors[i + 1 :])), price))
    return out


def _other_values(factor: Factor, n: int, x: Floats) -> list[float]:
    if n in factor.shape.places:
        values = np.quantile(x, QUANTILES).tolist()
    else:
        values = [factor.numbers[n] * k for k in FACTORS]
    return sorted({float(f"{v:.2g}") for v in values} - {factor.numbers[n]})


def _best_terms(beside: Beside, made: list[tuple[int, Amplitude, float]]) -> list[LawTerm]:
    screen = beside.problem.screen
    ranked: list[tuple[float, int, Amplitude, float]] = []
    for s in dict.fromkeys(s for s, _, _ in made):
        mine = [(a, price) for at, a, price in made if at == s]
        values = np.array([screen.grammar.values_of(a)[screen.readings] for a, _ in mine])
        size = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
        good = np.isfinite(size[:, 0]) & (size[:, 0] > 0)
        values = (values[good] / size[good]).astype(np.float32)
        some = [m for m, ok in zip(mine, good.tolist(), strict=True) if ok]
        odds = SiteSums(beside, s).odds(values, constant=False)
        ranked += [
            (float(x) - price, s, a, price)
            for x, (a, price) in zip(odds, some, strict=True)
            if np.isfinite(x)
        ]
    ranked.sort(key=lambda r: -r[0])
    out: list[LawTerm] = []
    for _, s, a, price in ranked[:KEPT]:
        k = screen.grammar.index(a)
        if k is None:
            continue
        out.append(beside.term(((s, k),), price))
        other = screen.grammar.turned(k)
        if other is not None:
            out.append(beside.term(((s, k), (s, other)), price + LOG2))
    return out
