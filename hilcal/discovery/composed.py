"""A quantity that is composed of recorded ones: u = φ₁ + Σ w_i φ_i, each φ a product of functions.

Functions of u are what sums of products do not reach: a hose that pulls beyond some length, which
two joints make together, is max(u − u0, 0) with u = cos q_5·cos q_6. A function f(u) depends on the
transmitted wrenches W by the chain rule, ∂f/∂W = f'(u) Σ w_i ∂φ_i/∂W.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.discovery.amplitudes import Amplitude
from hilcal.discovery.variables import Variable
from hilcal.effects.protocol import Situation
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Composed(Variable):
    """A weighted sum of products, as a quantity.

    Attributes:
        terms: (weight, product); the first weight is 1, and all products have one unit.
    """

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

    Args:
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
