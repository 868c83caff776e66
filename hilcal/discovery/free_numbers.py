"""The numbers in a law's functions that a refinement may change: exponents, levels, weights."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Factor
from hilcal.discovery.composed import Composed, composed
from hilcal.discovery.law import Form, with_factors
from hilcal.effects.protocol import Situation
from hilcal.types import Floats

FACTOR = 30.0
"""Factor by which a positive number may change at most; a choice."""
SPREADS = 3.0
"""Standard deviations of its quantity by which a level may move at most; a choice."""


@dataclass(frozen=True, slots=True)
class FreeNumber:
    """A number, wherever it is in a law.

    Attributes:
        places: (part, factor) of each function that has it.
        index: of it among the function's numbers, or among the weights of its quantity.
        weight: whether it is a weight.
        begin: its value.
        scale: one unit of its change; 0 where it changes by factors instead, eˣ.
        least: value that it has at least.
    """

    places: tuple[tuple[int, int], ...]
    index: int
    weight: bool
    begin: float
    scale: float
    least: float = -np.inf

    def at(self, x: float) -> float:
        """Return its value after a change; infinite where that is too large."""
        if abs(x) > (SPREADS if self.scale else np.log(FACTOR)):
            return float("inf")
        value = self.begin + self.scale * x if self.scale else self.begin * float(np.exp(x))
        return value if value >= self.least else float("inf")

    def put(self, factor: Factor, value: float) -> Factor:
        """Return a function with another value of it."""
        if not self.weight:
            n = factor.numbers
            return replace(factor, numbers=(*n[: self.index], value, *n[self.index + 1 :]))
        terms = [*_terms(factor)]
        terms[self.index] = value, terms[self.index][1]
        return replace(factor, variable=composed(tuple(terms)))


def _terms(factor: Factor) -> tuple[tuple[float, Amplitude], ...]:
    return factor.variable.terms if isinstance(factor.variable, Composed) else ()


def free_numbers(form: Form, s: Situation) -> list[FreeNumber]:
    """Return the free numbers of a law.

    The same function of the same quantity in several products has one number.

    Args:
        form: the law.
        s: the situation of the readings.
    """
    groups: dict[tuple[str, str, tuple[float, ...]], list[tuple[int, int]]] = {}
    for k, p in enumerate(form.parts):
        for i, f in enumerate(p.amplitude.factors):
            key = f.variable.symbol, f.shape.name, f.numbers
            groups.setdefault(key, []).append((k, i))
    out = []
    for found in groups.values():
        places = tuple(found)
        f = form.parts[places[0][0]].amplitude.factors[places[0][1]]
        made = isinstance(f.variable, Composed)
        # Below an exponent of 1 the slope at a bend would have no limit, nor an equilibrium.
        steep = f.shape.name.endswith("_power") and f.variable.slot is not None
        for n in f.shape.free:
            level = n in f.shape.places and (made or f.numbers[n] <= 0)
            scale = float(np.std(f.variable.read(s))) if level else 0.0
            if scale or f.numbers[n] > 0:
                least = 1.0 if steep and n not in f.shape.places else -np.inf
                out.append(FreeNumber(places, n, False, f.numbers[n], scale, least))
        for n, (weight, _) in enumerate(_terms(f)[1:], start=1):
            if weight:
                out.append(FreeNumber(places, n, True, weight, abs(weight)))
    return out


def with_values(form: Form, free: Sequence[FreeNumber], values: Sequence[float] | Floats) -> Form:
    """Return a law with other values of its free numbers."""
    changed: dict[tuple[int, int], Factor] = {}
    for number, value in zip(free, values, strict=True):
        for k, i in number.places:
            old = changed.get((k, i), form.parts[k].amplitude.factors[i])
            changed[k, i] = number.put(old, float(value))
    return with_factors(form, changed)
