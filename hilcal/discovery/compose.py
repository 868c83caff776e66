"""Candidates beyond the screening: functions of composed quantities, more factors, other numbers.

f(u) with u = φ₁ + Σ w_i φ_i, where φ_i are products of functions of at most two quantities, is a
single-index model, one step of projection pursuit (Friedman and Stuetzle 1981, JASA 76, 817).

1. All bends and steps of single products are screened at all sites; see `bends`.
2. The arguments of the best ones are extended by a further product: f(u + w φ) ≈ f(u) + w φ f'(u).
   The gain of φ f'(u) beside f(u) and f'(u) ranks all φ; its coefficient gives w (Gauss-Newton).
3. Levels, weights and an exponent of the `REFINED` best are refined together, with the coefficient
   projected out.

The price of such a candidate is that of all arguments of its complexity and of the levels, and
½ ln ν for each weight and exponent.

The best candidates of the screening are also multiplied by functions of other quantities, and their
free numbers are varied (`grown`). The price is that of all such products, or of all tried values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Factor, composed, different
from hilcal.discovery.screen import INDEPENDENT, LEAST_MOTION, LOG2, VISIBLE, unit_rows
from hilcal.discovery.shapes import Shape
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.discovery.problem import CandidateTerms
    from hilcal.discovery.screen import LawTerm, ScreenedTerm

BEST, EXTENDED = 10, 3  # Bends that are extended, and further products of each; a choice, by time
LARGEST_SUM = 3  # Products of a sum at most; a choice
QUANTITIES = 2  # Recorded quantities of an argument at most; a choice, by the number of sums
REFINED = 2  # Functions of single products, and of sums, that are refined; a choice, by time
QUANTILES = tuple(k / 20 for k in range(1, 20))  # Levels that are tried, as quantiles
WEIGHT_FACTORS = (0.4, 0.7, 1.0, 1.5, 2.2)
"""Weights that are tried, over the linearised one; a choice."""
EVALUATIONS = 60  # Evaluations of the sum of squares per refined number; a choice
DIGITS = 3
REJECTED = 1e12
POWERS = {"above": shapes.ABOVE_POWER, "below": shapes.BELOW_POWER}
LEAST_POWER, MOST_POWER = 0.5, 4.0  # of a bend; at least 1 under wrenches; a choice


@dataclass(frozen=True, slots=True, eq=False)
class _Bent:
    """A function of a composed quantity at a site."""

    s: int  # index of the site
    which: tuple[int, ...]  # products of the argument, by index in the grammar
    weights: tuple[float, ...]  # of the products; the first is 1
    shape: Shape
    numbers: tuple[float, ...]  # of the shape
    evidence: float  # log evidence, without the price of the search
    price: float  # of the choice of the argument

    @property
    def odds(self) -> float:
        return self.evidence - self.price


class SiteSums:
    """Products of any amplitude at one site, beside the model and chosen terms."""

    def __init__(self, candidates: CandidateTerms, s: int) -> None:
        """Project the chosen terms out."""
        screen = candidates.problem.screen
        form = screen.form[s]
        self.evidence = candidates.evidence
        self.slope: Floats = form.T @ candidates.problem.screening_residual
        self.free: Floats = np.float32(candidates.problem.share) * screen.free[s]
        for along, unit in candidates.directions():
            products = form.T @ unit
            self.slope = self.slope - np.float32(along) * products
            self.free = self.free - np.outer(products, products)
        self.whitened_square: Floats = np.sum(form**2, axis=0)
        self.ones: Floats = self.free.sum(axis=1)
        self.one = float(self.ones.sum())
        self.constant = self.one > VISIBLE * float(self.whitened_square.sum()) + LEAST_MOTION
        self.slope_one = float(self.slope.sum())

    def odds(self, values: Floats, constant: bool = True) -> Floats:
        """(C,) log evidence of amplitudes (C, K), the larger of without and with a constant."""
        square = np.einsum("ck,ck->c", values @ self.free, values)
        visible = square > VISIBLE * (values**2 @ self.whitened_square) + LEAST_MOTION
        slope, across = values @ self.slope, values @ self.ones
        return _better(self.evidence, slope, np.where(visible, square, 0.0), across,
                       self.slope_one, self.one if constant and self.constant else 0.0)  # fmt: skip


def _better(
    evidence: Any, slope: Floats, square: Floats, across: Floats, slope_one: Any, one: Any
) -> Floats:
    """Log evidence of columns without or with a constant at the site, whichever is larger."""
    visible = square > 0
    gain = np.where(visible, slope**2 / np.where(visible, square, 1.0), 0.0)
    alone = np.where(visible, evidence(gain, 1), -np.inf)
    nonzero = np.asarray(one) > 0
    safe = np.where(nonzero, one, 1.0)
    remainder = square - across**2 / safe
    both = visible & nonzero & (remainder > INDEPENDENT * square)
    partial = slope - across * slope_one / safe
    gain = np.where(both, partial**2 / np.where(both, remainder, 1.0) + slope_one**2 / safe, 0.0)
    return np.maximum(alone, np.where(both, evidence(gain, 2) - LOG2, -np.inf))


def composed_terms(candidates: CandidateTerms) -> list[LawTerm]:
    """Return terms of functions of composed quantities."""
    single = _screened(candidates)
    sums_of = {s: SiteSums(candidates, s) for s in {b.s for b in single}}
    sums: list[_Bent] = []
    frontier = single
    for _ in range(LARGEST_SUM - 1):
        frontier = [e for b in frontier[:BEST] for e in _extended(candidates, sums_of[b.s], b)]
        frontier.sort(key=lambda b: -b.odds)
        sums += frontier
    out: list[LawTerm] = []
    for b in (*_best_of_argument(single)[:REFINED], *_best_of_argument(sums)[:REFINED]):
        out += _terms(candidates, sums_of[b.s], b)
    return out


def _best_of_argument(bent: list[_Bent]) -> list[_Bent]:
    """Return the best function of each argument at each site, best first."""
    bent = sorted(bent, key=lambda b: -b.odds)
    out: dict[tuple[int, frozenset[int]], _Bent] = {}
    for b in bent:
        out.setdefault((b.s, frozenset(b.which)), b)
    return list(out.values())


def _screened(candidates: CandidateTerms) -> list[_Bent]:
    """Return the best bends of single products."""
    p = candidates.problem
    screen, bends = p.screen, p.screen.bends
    if not len(bends.argument):
        return []

    def by_site(v: Floats) -> Floats:
        return np.asarray(np.einsum("srk,r->sk", screen.form, v))

    one = screen.constant
    share = np.float32(p.share)
    moved = by_site(p.screening_residual)
    slope, slope_one = moved @ bends.values.T, moved.sum(axis=1)
    square, across = share * bends.square, share * bends.across_constant
    square_one = share * screen.square[:, one]
    for along, unit in candidates.directions():
        by_unit = by_site(unit)
        along_unit, along_one = by_unit @ bends.values.T, by_unit.sum(axis=1)
        slope, slope_one = slope - np.float32(along) * along_unit, slope_one - along * along_one
        square = np.where(square > 0, square - along_unit**2, 0.0)
        across, square_one = across - along_one[:, None] * along_unit, square_one - along_one**2
    square = np.where(square > INDEPENDENT * share * bends.square, square, 0.0)
    square_one = np.where(square_one > INDEPENDENT * share * screen.square[:, one], square_one, 0.0)
    odds = _better(
        candidates.evidence, slope, square, across, slope_one[:, None], square_one[:, None]
    )
    price = screen.grammar.price_of_argument[screen.grammar.cost[bends.argument]]
    odds = odds - price
    out: dict[tuple[int, int], _Bent] = {}
    for index in np.argsort(-odds, axis=None)[: 20 * BEST].tolist():
        s, c = divmod(index, odds.shape[1])
        k = int(bends.argument[c])
        if not np.isfinite(odds[s, c]):
            break
        b = _Bent(
            s, (k,), (1.0,), bends.shape[c], bends.numbers[c],
            float(odds[s, c] + price[c]), float(price[c]),
        )  # fmt: skip
        out.setdefault((screen.alias[s], k), b)
        if len(out) == BEST:
            break
    return list(out.values())


def _values(candidates: CandidateTerms, which: tuple[int, ...]) -> Floats:
    """(P, K) products at the readings of the screening, in their own units."""
    screen = candidates.problem.screen
    indices = list(which)
    values = screen.grammar.values[indices][:, screen.readings] * screen.grammar.size[indices, None]
    return np.asarray(values, dtype=float)


def _extended(candidates: CandidateTerms, site: SiteSums, b: _Bent) -> list[_Bent]:
    """Return the argument extended by the best further products, each at the best level."""
    grammar = candidates.problem.screen.grammar
    quantities = frozenset[str]().union(*(grammar.depends[k] for k in b.which))
    unit = grammar.unit_of_smooth
    further = [
        k
        for k in grammar.smooth.tolist()
        if unit[k] == unit[b.which[0]]
        and k not in b.which
        and len(quantities | grammar.depends[k]) <= QUANTITIES
    ]
    if not further:
        return []
    u = np.asarray(b.weights) @ _values(candidates, b.which)
    phi = _values(candidates, tuple(further))
    slope = b.shape.slope(u, b.numbers)
    columns = np.vstack([b.shape.value(u, b.numbers), slope, phi * slope])
    size = np.sqrt(np.mean(columns**2, axis=1))
    x = unit_rows(columns)
    gain, fitted = _gains(site, x)
    out = []
    for j in np.argsort(-gain)[:EXTENDED].tolist():
        if not np.isfinite(gain[j]) or fitted[0, j] == 0:
            continue
        weight = float(fitted[1, j] / size[j + 2] / (fitted[0, j] / size[0]))
        if not np.isfinite(weight) or weight == 0:
            continue
        out.append(_leveled(candidates, site, b, int(further[j]), weight, len(further)))
    return out


def _gains(site: SiteSums, x: Floats) -> tuple[Floats, Floats]:
    """Gain (P,) of each further row beside two, −inf if dependent; (2, P) first and last factor."""
    free = (x @ site.free).astype(float)
    slope = (x @ site.slope).astype(float)
    gram = free @ x.T.astype(float)[:, :2]
    square = np.einsum("pk,pk->p", free, x)
    gram_first = gram[:2] + 1e-6 * np.diag(np.diag(gram[:2])) + 1e-12 * np.eye(2)
    step = np.linalg.solve(gram_first, slope[:2])
    lift = np.linalg.solve(gram_first, gram[2:].T)
    remainder = square[2:] - np.einsum("ip,pi->p", lift, gram[2:])
    slope_beside = slope[2:] - gram[2:] @ step
    visible = remainder > INDEPENDENT * square[2:] + LEAST_MOTION
    last = slope_beside / np.where(visible, remainder, 1.0)
    gain = np.where(visible, slope_beside * last, -np.inf)
    return gain, np.vstack([step[0] - lift[0] * last, last])


def _leveled(
    candidates: CandidateTerms, site: SiteSums, b: _Bent, further: int, weight: float, choices: int
) -> _Bent:
    """Return the argument with a further product, at the best of some weights and levels."""
    grammar = candidates.problem.screen.grammar
    which = (*b.which, further)
    a = _values(candidates, which)
    tried: list[tuple[float, tuple[float, ...], tuple[float, ...]]] = []
    for times in WEIGHT_FACTORS:
        weights = (*b.weights, times * weight)
        u = np.asarray(weights) @ a
        levels = np.quantile(u, QUANTILES)
        constants = [np.full(len(levels), n) for n in b.numbers[1:]]
        grid: list[Any] = [levels[:, None], *(n[:, None] for n in constants)]
        odds = site.odds(unit_rows(b.shape.value(u, tuple(grid))))
        k = int(np.argmax(odds))
        tried.append((float(odds[k]), weights, (float(levels[k]), *b.numbers[1:])))
    evidence, weights, numbers = max(tried)
    price = float(np.log(choices)) + LOG2 * (int(grammar.cost[further]) + 1)
    price += 0.5 * float(np.log(candidates.dof))
    return replace(
        b, which=which, weights=weights, numbers=numbers, evidence=evidence, price=b.price + price
    )


def _terms(candidates: CandidateTerms, site: SiteSums, b: _Bent) -> list[LawTerm]:
    """Return terms with refined numbers, also with an exponent, without and with a constant."""
    screen = candidates.problem.screen
    price_of_number = 0.5 * float(np.log(candidates.dof))
    grid = float(np.log(len(QUANTILES) * len(b.numbers)))
    grammar = screen.grammar
    sums = b.price - float(grammar.price_of_argument[grammar.cost[b.which[0]]])
    variants = [(b, grid + sums)]
    if b.shape.name in POWERS:
        bent = replace(b, shape=POWERS[b.shape.name], numbers=(*b.numbers, 1.0))
        variants.append((bent, grid + sums + price_of_number))
    out = []
    for x, price in variants:
        k = grammar.index(_refined(candidates, site, x))
        if k is None:
            continue
        out.append(candidates.term(((b.s, k),), price))
        if screen.visible(b.s, screen.constant):
            out.append(candidates.term(((b.s, k), (b.s, screen.constant)), price + LOG2))
    return out


def _refined(candidates: CandidateTerms, site: SiteSums, b: _Bent) -> Amplitude:
    """Return the amplitude with the weights, levels and exponent of the largest evidence."""
    from scipy.optimize import minimize  # slow to import

    a = _values(candidates, b.which)
    count = len(b.weights) - 1
    spread = float(np.std(np.asarray(b.weights) @ a))
    scale = [abs(w) for w in b.weights[1:]]
    scale += [spread if k in b.shape.places else abs(n) for k, n in enumerate(b.numbers)]
    begin = np.array([*b.weights[1:], *b.numbers])
    grammar = candidates.problem.screen.grammar
    low, high = float(np.finfo(float).tiny), np.inf
    if b.shape in POWERS.values():
        elastic = any(grammar.amplitude(k).elastic for k in b.which)
        low, high = 1.0 if elastic else LEAST_POWER, MOST_POWER

    def parts(x: Floats) -> tuple[tuple[float, ...], tuple[float, ...]]:
        values = [float(f"{v:.{DIGITS}g}") for v in begin + np.asarray(scale) * x]
        return (1.0, *values[:count]), tuple(values[count:])

    def objective(x: Floats) -> float:
        weights, numbers = parts(x)
        if not all(low <= n <= high for k, n in enumerate(numbers) if k not in b.shape.places):
            return REJECTED
        values = b.shape.value(np.asarray(weights) @ a, numbers)
        return min(-float(site.odds(unit_rows(values[None]))[0]), REJECTED)

    start = np.zeros(len(begin))
    result = minimize(
        objective, start, method="Nelder-Mead",
        options={"maxfev": EVALUATIONS * len(begin), "xatol": 1e-3, "fatol": 1e-2,
                 "initial_simplex": np.vstack([start, 0.15 * np.eye(len(begin))])},
    )  # fmt: skip
    weights, numbers = parts(result.x if result.fun < objective(start) else start)
    terms = tuple((w, grammar.amplitude(k)) for w, k in zip(weights, b.which, strict=True))
    factors = terms[0][1].factors
    recorded = len(terms) == 1 and len(factors) == 1 and factors[0].shape is shapes.LINEAR
    quantity = factors[0].variable if recorded else composed(terms)
    return Amplitude((Factor(quantity, b.shape, numbers),))


MOST_COMPLEXITY = 4  # Complexity of a product; a choice
MOST_FACTORS = 3  # Factors of a product; a choice
GROWN, VARIED = 12, 24  # Candidates that are multiplied, or varied; a choice, by time
RETAINED = 24  # Best results of either that are scored in full; a choice
NUMBER_FACTORS = (0.35, 0.5, 0.7, 0.85, 1.2, 1.4, 2.0, 2.8)  # by which numbers are varied; a choice


def grown(candidates: CandidateTerms, best: list[ScreenedTerm]) -> list[LawTerm]:
    """Return terms of the best screened candidates with further factors, or other numbers."""
    distinct = list({(x.s, x.f): x for x in best}.values())
    products = [(x.s, a, 0.0) for x in distinct[:GROWN] for a in _products(candidates, x.s, x.f)]
    numbers = [(x.s, a, price) for x in distinct[:VARIED] for a, price in _numbers(candidates, x.f)]
    return [*_best_terms(candidates, products), *_best_terms(candidates, numbers)]


def _products(candidates: CandidateTerms, s: int, f: int) -> list[Amplitude]:
    screen = candidates.problem.screen
    a = screen.grammar.amplitude(f)
    if not a.factors or len(a.factors) >= MOST_FACTORS:
        return []
    out = []
    for further in screen.grammar.single_factors:
        if a.cost + further.cost > MOST_COMPLEXITY or not all(
            different(further, x) for x in a.factors
        ):
            continue
        product = Amplitude((*a.factors, further))
        index = screen.grammar.place(product)
        if index is not None and index < len(screen.grammar.amplitudes):
            continue  # already screened
        if screen.sites[s].takes(product.elastic, product.sensed):
            out.append(product)
    return out


def _numbers(candidates: CandidateTerms, f: int) -> list[tuple[Amplitude, float]]:
    grammar = candidates.problem.screen.grammar
    a = grammar.amplitude(f)
    out = []
    for i, factor in enumerate(a.factors):
        for n in factor.shape.free:
            old = factor.numbers[n]
            if n in factor.shape.places:
                tried = np.quantile(grammar.read(factor.variable), QUANTILES).tolist()
            else:
                tried = [old * k for k in NUMBER_FACTORS]
            values = sorted({float(f"{v:.2g}") for v in tried} - {old})
            price = float(np.log(len(values) + 1))
            for value in values:
                numbers = (*factor.numbers[:n], value, *factor.numbers[n + 1 :])
                varied = replace(factor, numbers=numbers)
                out.append((Amplitude((*a.factors[:i], varied, *a.factors[i + 1 :])), price))
    return out


def _best_terms(
    candidates: CandidateTerms, pool: list[tuple[int, Amplitude, float]]
) -> list[LawTerm]:
    screen = candidates.problem.screen
    ranked: list[tuple[float, int, Amplitude, float]] = []
    for s in dict.fromkeys(s for s, _, _ in pool):
        of_site = [(a, price) for site, a, price in pool if site == s]
        values = np.array([screen.grammar.values_of(a)[screen.readings] for a, _ in of_site])
        size = np.sqrt(np.mean(values**2, axis=1, keepdims=True))
        good = np.isfinite(size[:, 0]) & (size[:, 0] > 0)
        values = (values[good] / size[good]).astype(np.float32)
        usable = [m for m, ok in zip(of_site, good.tolist(), strict=True) if ok]
        odds = SiteSums(candidates, s).odds(values, constant=False)
        ranked += [
            (float(x) - price, s, a, price)
            for x, (a, price) in zip(odds, usable, strict=True)
            if np.isfinite(x)
        ]
    ranked.sort(key=lambda r: -r[0])
    out: list[LawTerm] = []
    for _, s, a, price in ranked[:RETAINED]:
        k = screen.grammar.index(a)
        if k is None:
            continue
        out.append(candidates.term(((s, k),), price))
        partner = screen.grammar.with_sine(k)
        if partner is not None:
            out.append(candidates.term(((s, k), (s, partner)), price + LOG2))
    return out
