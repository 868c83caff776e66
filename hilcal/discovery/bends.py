"""Bends and steps of composed quantities, screened in bulk at all sites.

What happens beyond a level that two quantities make together, as a hose that is taut beyond the
length that two joints give it, is no product of functions of each. So products φ of two quantities
are arguments themselves: max(φ − φ0, 0), max(φ0 − φ, 0) and tanh((φ − φ0)/w), at some levels φ0.
Their sums of squares at every site are formed once, as those of the products (see `screen`).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.grammar import Grammar
from hilcal.discovery.shapes import Shape
from hilcal.discovery.sites import Site
from hilcal.types import Floats, Ints

LEVELS = (0.2, 0.35, 0.5, 0.65, 0.8)
STEPS = (0.25, 0.5, 0.75)
"""Shares of the readings below a bend, and a step, to begin with; a choice, by time."""
WIDTH = 0.3
"""Of a step, by the standard deviation of the argument; a choice."""
MOST_ARGUMENTS = 4000
"""Arguments at most, the simplest first; a choice, by memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Bends:
    """Functions of composed quantities, and their sums of squares.

    Attributes:
        argument: (C,) index of the product in the grammar.
        shape: function of each.
        numbers: of it.
        values: (C, K) at the readings of the screening, with root mean square 1.
        square: (S, C) xᵀ M x; zero where a site does not take it.
        across_one: (S, C) xᵀ M x' with a constant at the site.
    """

    argument: Ints
    shape: tuple[Shape, ...]
    numbers: tuple[tuple[float, ...], ...]
    values: Floats
    square: Floats
    across_one: Floats


def bends(
    grammar: Grammar, sites: tuple[Site, ...], readings: Ints, form: Floats, free: Floats,
    seen: tuple[float, float],
) -> Bends:  # fmt: skip
    """Form all of them.

    Args:
        readings: (K,) those of the screening.
        form: (S, R', K) whitened motion of each site; see `screen`.
        free: (S, K, K) its products, the model projected out.
        seen: share of a column's square, and square, that must be left.
    """
    which = grammar.smooth[:MOST_ARGUMENTS]
    argument, made, numbers, rows = [], [], [], []
    for k in which.tolist():
        u = grammar.values[k][readings].astype(float) * grammar.size[k]
        for shape, each in _starts(u):
            of: list[Any] = [n[:, None] for n in each]
            argument += [k] * len(each[0])
            made += [shape] * len(each[0])
            numbers += list(zip(*(n.tolist() for n in each), strict=True))
            rows.append(unit_rows(shape.value(u, tuple(of))))
    values: Floats = np.vstack(rows) if rows else np.zeros((0, len(readings)), dtype=np.float32)
    elastic = np.array([grammar.at(k).elastic for k in which.tolist()], dtype=np.bool_)
    bent = np.repeat(elastic, len(values) // max(len(which), 1))
    square: Floats = np.empty((len(sites), len(values)), dtype=np.float32)
    across: Floats = np.empty_like(square)
    squares = values**2
    for s, site in enumerate(sites):
        lifted = values @ free[s]
        across[s] = lifted.sum(axis=1)
        square[s] = np.einsum("ck,ck->c", lifted, values)
        moved = squares @ np.sum(form[s] ** 2, axis=0)
        square[s, square[s] < seen[0] * moved + seen[1]] = 0.0
        for kind in (False, True):
            if not site.takes(kind):
                square[s, bent == kind] = 0.0
    return Bends(
        np.array(argument, dtype=np.int_), tuple(made), tuple(numbers), values, square, across
    )


def _starts(u: Floats) -> list[tuple[Shape, tuple[Floats, ...]]]:
    levels, steps = np.quantile(u, LEVELS), np.quantile(u, STEPS)
    width = np.full(len(STEPS), max(WIDTH * float(np.std(u)), 1e-300))
    return [(shapes.ABOVE, (levels,)), (shapes.BELOW, (levels,)), (shapes.STEP, (steps, width))]


def unit_rows(values: Floats) -> Floats:
    """Rows with root mean square 1, single precision; zero where they are not finite."""
    size = np.sqrt(np.mean(values**2, axis=-1, keepdims=True))
    good = np.isfinite(size) & (size > 0)
    return np.where(good, values / np.where(good, size, 1.0), 0.0).astype(np.float32)
