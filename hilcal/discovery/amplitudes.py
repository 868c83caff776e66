"""The amplitude of a law: a product of functions of recorded quantities.

A function of one quantity has the complexity of its shape, a sum of two joints one more; a product
has the sum of its factors'.

Functions of u are what sums of products do not reach: a hose that pulls beyond some length, which
two joints make together, is max(u − u0, 0) with u = cos q_5·cos q_6. A function f(u) depends on the
transmitted wrenches W by the chain rule, ∂f/∂W = f'(u) Σ w_i ∂φ_i/∂W.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from hilcal.discovery.shapes import Numbers, Shape
from hilcal.discovery.variables import Variable
from hilcal.effects.protocol import Situation
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class Factor:
    """A function of one quantity."""

    variable: Variable
    shape: Shape
    numbers: Numbers = ()

    @property
    def cost(self) -> int:
        """Complexity."""
        return self.shape.cost + self.variable.cost

    def values(self, s: Situation) -> Floats:
        """(N,) of the states."""
        return self.shape.value(self.variable.read(s), self.numbers)

    @property
    def power(self) -> float:
        """Power of the variable's unit that the factor has."""
        return self.shape.power(self.numbers)

    def text(self) -> str:
        """Return it as text."""
        return self.shape.text(self.variable.symbol, [f"{x:g}" for x in self.numbers])

    def latex(self) -> str:
        """Return it in LaTeX."""
        return self.shape.latex(self.variable.latex, [f"{x:g}" for x in self.numbers])

    def code(self) -> str:
        """Return it as Python, of a situation s."""
        return self.shape.code(self.variable.code, [repr(x) for x in self.numbers])

    def slope_code(self) -> str:
        """Return its derivative by the variable likewise."""
        return self.shape.slope_code(self.variable.code, [repr(x) for x in self.numbers])


@dataclass(frozen=True)
class Amplitude:
    """A product of factors; the empty product is 1."""

    factors: tuple[Factor, ...]

    @cached_property
    def cost(self) -> int:
        """Complexity."""
        return sum(f.cost for f in self.factors)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the quantities that it depends on."""
        return tuple(dict.fromkeys(n for f in self.factors for n in f.variable.names))

    @property
    def elastic(self) -> bool:
        """Whether it depends on transmitted wrenches."""
        return any(f.variable.slot is not None for f in self.factors)

    @property
    def sensed(self) -> bool:
        """Whether it depends on what the force sensor reads in its own axes."""
        return any(f.variable.kind == "sensor" for f in self.factors)

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return tuple(dict.fromkeys(n for f in self.factors for n in f.variable.needs))

    def values(self, s: Situation) -> Floats:
        """(N,) of the states."""
        out = np.ones(len(s.angle))
        for f in self.factors:
            out = out * f.values(s)
        return out

    @property
    def powers(self) -> dict[str, float]:
        """Powers of the units that the product has."""
        powers: dict[str, float] = {}
        for f in self.factors:
            if f.power and f.variable.unit != "1":
                powers[f.variable.unit] = powers.get(f.variable.unit, 0.0) + f.power
        return powers

    def text(self) -> str:
        """Return the product as text."""
        return "·".join(f.text() for f in self.factors)

    def latex(self) -> str:
        """Return the product in LaTeX."""
        return r"\,".join(f.latex() for f in self.factors)

    def code(self) -> str:
        """Return the product as Python, of a situation s."""
        parts = [f.code() for f in self.factors] or ["np.ones(len(s.angle))"]
        return parts[0] if len(parts) == 1 else " * ".join(f"({part})" for part in parts)

    def slopes(self) -> Iterator[tuple[tuple[int, int], str]]:
        """Yield slots and components of transmitted wrenches, and its derivative by each."""
        for i, f in enumerate(self.factors):
            others = Amplitude((*self.factors[:i], *self.factors[i + 1 :]))
            for slot, inner in f.variable.slopes():
                parts = [f.slope_code(), *([inner] if inner else [])]
                parts += [others.code()] if others.factors else []
                yield slot, " * ".join(f"({part})" for part in parts)

    def unit(self) -> str:
        """Unit of the product; "1" where it has none."""
        return unit_of(self.powers)

    def of_joint(self, old: int, new: int, known: list[Variable]) -> "Amplitude | None":
        """Return the same law of another joint's own quantities; None where it has none."""
        out = []
        for f in self.factors:
            v = f.variable
            if v.joint == old and v.kind != "sum":
                same = [w for w in known if w.kind == v.kind and w.joint == new and _alike(w, v)]
                if not same:
                    return None
                f = replace(f, variable=same[0])
            out.append(f)
        return Amplitude(tuple(out))

    def of_axis(self, old: int, new: int, known: list[Variable]) -> "Amplitude | None":
        """Return the same law of another axis: vectors' components along both change places."""
        swap, out = {old: new, new: old}, []
        for f in self.factors:
            v = f.variable
            if v.vector and v.axis in swap:
                same = [w for w in known if w.vector == v.vector and w.axis == swap[v.axis]]
                if not same:
                    return None
                f = replace(f, variable=same[0])
            out.append(f)
        return Amplitude(tuple(out))


def _alike(a: Variable, b: Variable) -> bool:
    return a.slot is None or b.slot is None or a.slot[1] == b.slot[1]


def unit_of(powers: dict[str, float]) -> str:
    """Return a product of units by their powers; "1" where there is none."""
    return "·".join(_raised(u, p) for u, p in powers.items()) or "1"


def _raised(unit: str, power: float) -> str:
    if power == 1:
        return unit
    return f"({unit})^{power:g}" if "·" in unit else f"{unit}^{power:g}"


def different(a: Factor, b: Factor) -> bool:
    """Whether two factors are of different quantities."""
    return not set(a.variable.names) & set(b.variable.names) or (
        a.variable.kind == "load" and a.variable.symbol != b.variable.symbol
    )


@dataclass(frozen=True, slots=True, eq=False)
class Composed(Variable):
    """A weighted sum of products, as a quantity."""

    # (weight, product); the first weight is 1, and all products have one unit
    terms: tuple[tuple[float, Amplitude], ...] = ()

    def read(self, s: Situation) -> Floats:
        """(N,) it in the states."""
        return np.asarray(sum(w * a.values(s) for w, a in self.terms))

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return tuple(dict.fromkeys(n for _, a in self.terms for n in a.needs))

    @property
    def recorded(self) -> tuple[Variable, ...]:
        """The recorded quantities that it is made of."""
        return tuple(dict.fromkeys(f.variable for _, a in self.terms for f in a.factors))

    def slopes(self) -> tuple[tuple[tuple[int, int], str], ...]:
        """Slots and components of the transmitted wrenches, and ∂u by each as Python."""
        found = [(slot, w, code) for w, a in self.terms for slot, code in a.slopes()]
        return tuple((slot, code if w == 1 else f"{w!r} * {code}") for slot, w, code in found)

    @property
    def cost(self) -> int:
        """Complexity: that of its products, and one for each weight."""
        return sum(a.cost for _, a in self.terms) + len(self.terms) - 1


def composed(terms: tuple[tuple[float, Amplitude], ...]) -> Composed:
    """Return the quantity of a weighted sum of products.

    terms: (weight, product); the first weight is 1, and all products have one unit.
    """
    products = [a for _, a in terms]
    slots = [f.variable.slot for a in products for f in a.factors if f.variable.slot is not None]
    joints = {f.variable.joint for a in products for f in a.factors}
    return Composed(
        "composed",
        tuple(dict.fromkeys(n for a in products for n in a.names)),
        _sum([(w, a.text()) for w, a in terms], "·"),
        _sum([(w, a.latex()) for w, a in terms], r"\,"),
        products[0].unit(),
        _code(terms),
        slot=slots[0] if slots else None,
        joint=joints.pop() if len(joints) == 1 else -1,
        terms=terms,
    )


def _sum(terms: list[tuple[float, str]], times: str) -> str:
    """Weighted sum as text, in brackets where it has several products."""
    out = terms[0][1]
    for w, text in terms[1:]:
        size = "" if abs(w) == 1 else f"{abs(w):g}{times}"
        out += f" {'-' if w < 0 else '+'} {size}{text}"
    return out if len(terms) == 1 else f"({out})"


def _code(terms: tuple[tuple[float, Amplitude], ...]) -> str:
    parts = [f"({a.code()})" if w == 1 else f"{w!r} * ({a.code()})" for w, a in terms]
    return f"({' + '.join(parts)})" if len(parts) > 1 else parts[0]
