"""Candidates beyond the screening: further factors and other numbers for the best of it.

The screening tries products of two factors, with a few values of the numbers in their functions.
Of the best candidates

- each is multiplied by every function of another quantity, up to the complexity `MOST`;
- each number that is free, as a bend, a saturation or an exponent, is varied.

What is found pays as if all products of its kind had been tried, or for the values that were.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Factor, different
from hilcal.discovery.compose import SiteSums
from hilcal.types import Floats

if TYPE_CHECKING:
    from hilcal.discovery.problem import Beside
    from hilcal.discovery.terms import LawTerm, ScreenedTerm

MOST = 4  # Complexity of a product; a choice
MOST_FACTORS = 3  # Factors of a product; a choice
GROWN, VARIED = 12, 24
"""Candidates that are multiplied, and whose numbers are varied; a choice, by time."""
KEPT = 24  # Of either the best that are scored in full; a choice
TIMES = (0.35, 0.5, 0.7, 0.85, 1.2, 1.4, 2.0, 2.8)
"""Values of a number that are tried, by the one of the grid; a choice."""
QUANTILES = tuple(k / 20 for k in range(1, 20))
"""Places of a bend or a step that are tried, as shares of the readings below; a choice."""


def grown(beside: Beside, best: list[ScreenedTerm]) -> list[LawTerm]:
    """Return terms of further factors and other numbers.

    best: the best of the screening, best first.
    """
    found = list({(x.s, x.f): x for x in best}.values())
    products = [(x.s, a, 0.0) for x in found[:GROWN] for a in _products(beside, x.s, x.f)]
    numbers = [(x.s, a, price) for x in found[:VARIED] for a, price in _numbers(beside, x.f)]
    return [*_terms(beside, products), *_terms(beside, numbers)]


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
            values = _values(factor, n, grammar.read(factor.variable))
            price = float(np.log(len(values) + 1))
            for value in values:
                numbers = (*factor.numbers[:n], value, *factor.numbers[n + 1 :])
                other = replace(factor, numbers=numbers)
                out.append((Amplitude((*a.factors[:i], other, *a.factors[i + 1 :])), price))
    return out


def _values(factor: Factor, n: int, x: Floats) -> list[float]:
    if n in factor.shape.places:
        values = np.quantile(x, QUANTILES).tolist()
    else:
        values = [factor.numbers[n] * k for k in TIMES]
    return sorted({float(f"{v:.2g}") for v in values} - {factor.numbers[n]})


def _terms(beside: Beside, made: list[tuple[int, Amplitude, float]]) -> list[LawTerm]:
    """Return the best of products and variants."""
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
            out.append(beside.term(((s, k), (s, other)), price + float(np.log(2.0))))
    return out
