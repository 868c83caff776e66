"""The amplitude of a law: products of functions of recorded quantities, to a stated complexity.

A function of one quantity has the complexity of its shape, a sum of two joints one more; a product
has the sum of its factors'. All products of at most `MOST_FACTORS` factors of different quantities
up to the complexity `MOST` are tried.

What a law costs for the search that found it is the logarithm of the number of candidates of its
complexity, and log 2 for each unit of complexity: simple laws are few, and pay little.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb, log

import numpy as np

from hilcal.discover import shapes
from hilcal.discover.shapes import Numbers, Shape
from hilcal.discover.variables import Variable
from hilcal.effects.protocol import Situation
from hilcal.types import Floats, Ints

MOST = 3
"""Complexity of a product; a choice, by the number of candidates (about 10⁶ with all sites)."""
MOST_FACTORS = 2
"""Factors of a product; a choice, likewise."""
HARMONICS = 4
"""Multiples of an angle; as in the diagnosis."""
FINEST = 512
"""Highest multiple of a joint's angle, as of encoders and gears; a choice. Not more than there are
poses: each order costs the search, and few poses do not tell hundreds of them apart."""
FLAT = 0.1
"""Factors whose spread is a smaller share of their size are in no product: it would be the other
factor's law to within that share. A choice."""


@dataclass(frozen=True, slots=True)
class Factor:
    """A function of one quantity."""

    variable: Variable
    shape: Shape
    numbers: Numbers = ()

    @property
    def cost(self) -> int:
        """Complexity."""
        return self.shape.cost + (self.variable.kind == "sum")

    def values(self, s: Situation) -> Floats:
        """(N,) of the states."""
        return self.shape.value(self.variable.read(s), self.numbers)

    @property
    def power(self) -> float:
        """Power of the variable's unit that the factor has."""
        return self.shape.power(self.numbers)


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
        return tuple(dict.fromkeys(f.variable.need for f in self.factors if f.variable.need))

    def values(self, s: Situation) -> Floats:
        """(N,) of the states."""
        out = np.ones(len(s.angle))
        for f in self.factors:
            out = out * f.values(s)
        return out

    def unit(self) -> str:
        """Unit of the product; "1" where it has none."""
        powers: dict[str, float] = {}
        for f in self.factors:
            if f.power and f.variable.unit != "1":
                powers[f.variable.unit] = powers.get(f.variable.unit, 0.0) + f.power
        return "·".join(_raised(u, p) for u, p in powers.items()) or "1"

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


def _raised(unit: str, power: float) -> str:
    if power == 1:
        return unit
    return f"({unit})^{power:g}" if "·" in unit else f"{unit}^{power:g}"


@dataclass(frozen=True, eq=False)
class Grammar:
    """All amplitudes that are tried, and their values.

    Attributes:
        known: the quantities.
        amplitudes: the products.
        values: (F, N) their values, single precision, each with root mean square 1.
        size: (F,) what they were divided by.
        cost: (F,) complexities.
        partner: (F,) the amplitude with sine for cosine in its first periodic factor; −1 for none.
        situation: of the readings.
        singles: the functions of one quantity from which products are made.
    """

    known: list[Variable]
    amplitudes: tuple[Amplitude, ...]
    values: Floats
    size: Floats
    cost: Ints
    partner: Ints
    situation: Situation
    singles: tuple[Factor, ...]
    _more: list[tuple[Amplitude, Floats, float]] = field(default_factory=list)
    _read: dict[str, Floats] = field(default_factory=dict)

    def at(self, k: int) -> Amplitude:
        """Return an amplitude by its index."""
        own = len(self.amplitudes)
        return self.amplitudes[k] if k < own else self._more[k - own][0]

    def rows(self, which: list[int]) -> Floats:
        """(P, N) values of amplitudes, each with root mean square 1."""
        own = len(self.amplitudes)
        return np.array([self.values[k] if k < own else self._more[k - own][1] for k in which])

    def index(self, amplitude: Amplitude) -> int | None:
        """Return the index of an amplitude, added where it is new; None where it is zero."""
        known = self.place(amplitude)
        if known is not None:
            return known
        values = self.values_of(amplitude)
        size = float(np.sqrt(np.mean(values**2)))
        if not np.isfinite(size) or size == 0:
            return None
        k = len(self.amplitudes) + len(self._more)
        self._more.append((amplitude, (values / size).astype(np.float32), size))
        self._places[_key(amplitude)] = k
        return k

    def values_of(self, a: Amplitude) -> Floats:
        """(N,) of an amplitude at the readings."""
        out = np.ones(self.values.shape[1])
        for f in a.factors:
            out = out * f.shape.value(self.read(f.variable), f.numbers)
        return out

    def read(self, v: Variable) -> Floats:
        """(N,) of a quantity at the readings."""
        if v.symbol not in self._read:
            self._read[v.symbol] = v.read(self.situation)
        return self._read[v.symbol]

    def turned(self, k: int) -> int | None:
        """Return the amplitude with sine for cosine in its first periodic factor."""
        if k < len(self.amplitudes):
            return int(self.partner[k]) if self.partner[k] >= 0 else None
        factors = list(self.at(k).factors)
        for i, f in enumerate(factors):
            if f.shape.name == "cos":
                factors[i] = replace(f, shape=replace(shapes.SIN, cost=f.shape.cost))
                return self.index(Amplitude(tuple(factors)))
        return None

    def place(self, amplitude: Amplitude) -> int | None:
        """Return the index of an amplitude; None where it is not tried."""
        return self._places.get(_key(amplitude))

    @cached_property
    def _places(self) -> dict[frozenset[tuple[str, str, Numbers]], int]:
        return {_key(a): k for k, a in enumerate(self.amplitudes)}

    def inner(self, k: int) -> list[int]:
        """Return the amplitudes with one factor less."""
        factors = self.at(k).factors
        less = (Amplitude((*factors[:i], *factors[i + 1 :])) for i in range(len(factors)))
        return [at for a in less if (at := self.place(a)) is not None]

    def price(self, sites: int) -> Floats:
        """(F,) log of the number of candidates of the same complexity, and of 2 per unit of it."""
        count = np.bincount(self.cost) * sites
        return np.asarray(np.log(count[self.cost]) + log(2.0) * self.cost)

    def price_of(self, a: Amplitude, sites: int) -> float:
        """Return the same of any product: as if all of its complexity had been tried."""
        kind = a.cost, len(a.factors)
        count = self._counts.get(kind, self._counts.get((a.cost, 0), 1))
        return log(max(count, 1) * sites) + log(2.0) * a.cost

    @cached_property
    def _counts(self) -> dict[tuple[int, int], int]:
        """Number of products by complexity and factors; by complexity, those of `amplitudes`."""
        n = np.bincount([f.cost for f in self.singles], minlength=4).tolist()
        own = np.bincount(self.cost).tolist()
        return {
            (4, 2): comb(n[2], 2) + n[1] * n[3],
            (3, 3): comb(n[1], 3),
            (4, 3): comb(n[1], 2) * n[2],
            **{(cost, 0): count for cost, count in enumerate(own)},
        }

    @cached_property
    def depends(self) -> tuple[frozenset[str], ...]:
        """Names of the quantities that each amplitude depends on."""
        return tuple(frozenset(a.names) for a in self.amplitudes)


def _key(a: Amplitude) -> frozenset[tuple[str, str, Numbers]]:
    return frozenset((f.variable.symbol, f.shape.name, f.numbers) for f in a.factors)


def grammar(known: list[Variable], s: Situation, poses: int = 0) -> Grammar:
    """Return all products of the functions of the quantities.

    Args:
        known: the quantities.
        s: the situation of the readings.
        poses: number of poses, which limits the multiples of an angle; see `FINEST`.
    """
    singles = [f for v in known for f in _factors(v, v.read(s))]
    singles += [f for v in known if v.kind == "angle" for f in _fine(v, min(poses, FINEST))]
    value = np.array([f.values(s) for f in singles]).reshape(len(singles), -1)
    cost = np.array([f.cost for f in singles])
    flat = np.std(value, axis=1) < FLAT * np.sqrt(np.mean(value**2, axis=1))
    pairs: list[tuple[int, int]] = [(-1, -1)] + [
        (i, -1) for i in range(len(singles)) if cost[i] <= MOST
    ]
    curved = np.flatnonzero((cost < MOST) & ~flat).tolist()
    for at, i in enumerate(curved):
        for k in curved[at + 1 :]:
            if cost[i] + cost[k] <= MOST and different(singles[i], singles[k]):
                pairs.append((i, k))
    value = np.vstack([value, np.ones(value.shape[1])])
    index = np.array(pairs)
    products = value[index[:, 0]] * value[index[:, 1]]
    size = np.sqrt(np.mean(products**2, axis=1))
    kept = np.flatnonzero(size > 0)
    amplitudes = tuple(
        Amplitude(tuple(singles[i] for i in pairs[k] if i >= 0)) for k in kept.tolist()
    )
    place = {pairs[k]: at for at, k in enumerate(kept.tolist())}
    turned = _turned(singles)
    partner = np.array([_partner(pairs[k], turned, place) for k in kept.tolist()])
    return Grammar(
        known,
        amplitudes,
        (products[kept] / size[kept, None]).astype(np.float32),
        size[kept],
        np.array([a.cost for a in amplitudes]),
        partner,
        s,
        tuple(
            f
            for f, same in zip(singles, flat.tolist(), strict=True)
            if not same and f.shape not in (shapes.FINE_COS, shapes.FINE_SIN)
        ),
    )


def different(a: Factor, b: Factor) -> bool:
    """Whether two factors are of different quantities."""
    return not set(a.variable.names) & set(b.variable.names) or (
        a.variable.kind == "load" and a.variable.symbol != b.variable.symbol
    )


def _turned(singles: list[Factor]) -> dict[int, int]:
    """Sine by cosine of the same quantity."""
    place = {(id(f.variable), f.shape.name, f.numbers): k for k, f in enumerate(singles)}
    return {
        k: place[id(f.variable), "sin", f.numbers]
        for k, f in enumerate(singles)
        if f.shape.name == "cos"
    }


def _partner(
    pair: tuple[int, int], turned: dict[int, int], place: dict[tuple[int, int], int]
) -> int:
    for at, k in enumerate(pair):
        if k in turned:
            other = [*pair]
            other[at] = turned[k]
            low, high = sorted(other, key=lambda i: (i < 0, i))
            return place.get((low, high), -1)
    return -1


def _fine(v: Variable, finest: int) -> list[Factor]:
    """Return waves of an angle beyond `HARMONICS`; as complex as a product, so in none."""
    return [
        Factor(v, f, (float(k),))
        for k in range(HARMONICS + 1, finest + 1)
        for f in (shapes.FINE_COS, shapes.FINE_SIN)
    ]


def _factors(v: Variable, x: Floats) -> list[Factor]:
    """Return the functions of one quantity, with starting values of their numbers."""
    linear = Factor(v, shapes.LINEAR)
    if v.kind in WAVES:
        waves = [
            Factor(v, f, (float(k),))
            for k in range(1, WAVES[v.kind] + 1)
            for f in (shapes.COS, shapes.SIN)
        ]
        return [linear, *waves, *_bent(v, x)] if v.kind == "angle" else waves
    if v.kind == "side":
        return [linear]
    return [linear, *_CURVED[v.kind](v, x), *_bent(v, x)]


WAVES = {"angle": HARMONICS, "sum": 2, "sight": 2}
"""Multiples of an angle, by the kind of quantity; a choice."""
BENDS = (0.3, 0.7)
"""Shares of the readings below a bend to begin with; a refinement moves it. A choice."""
_Made = Callable[[Variable, Floats], list[Factor]]


def _bent(v: Variable, x: Floats) -> list[Factor]:
    """Return functions that are zero up to some value, by either side, and symmetric ones."""
    alone = v.kind in (
        "force",
        "load",
        "sensor",
        "place",
    )  # many, and rarely with a bend: in no product
    made = [
        Factor(v, replace(f, cost=MOST) if alone else f, (_round(at),))
        for at in np.quantile(x, BENDS).tolist()
        for f in (shapes.ABOVE, shapes.BELOW)
    ]
    if x.min() < 0 < x.max() and v.kind in ("angle", "torque"):
        near = _round(0.01 * _middle(x))
        made.append(Factor(v, shapes.THRESHOLD, (_round(0.5 * _middle(x)),)))
        made.append(Factor(v, shapes.SATURATION, (_round(_middle(x)),)))
        made += [Factor(v, shapes.EVEN, (p, near)) for p in (1.0, 2.0)]
    return list({(f.shape.name, f.numbers): f for f in made}.values())


def _middle(x: Floats) -> float:
    return float(np.median(np.abs(x[x != 0]))) if np.any(x) else 1.0


def _wrench(v: Variable, x: Floats) -> list[Factor]:
    middle = _middle(x)
    near = _round(0.01 * middle)
    if not x.min() < 0 < x.max():
        if v.kind == "load":
            return _grown(v, x)
        return [Factor(v, shapes.EVEN, (2.0, near)), Factor(v, shapes.ODD, (0.5, near))]
    out = [Factor(v, shapes.PLUS), Factor(v, shapes.MINUS)]
    out.append(Factor(v, shapes.SATURATION, (_round(0.05 * middle),)))
    if v.kind == "torque":
        out += [Factor(v, shapes.ODD, (p, near)) for p in (0.5, 2.0, 3.0)]
    return out


def _read_by_sensor(v: Variable, x: Floats) -> list[Factor]:
    """Curvature, and a sensor that is another one for pull and push."""
    near = _round(0.01 * _middle(x))
    if not x.min() < 0 < x.max():
        return [Factor(v, shapes.EVEN, (2.0, near))]
    return [Factor(v, shapes.PLUS), *(Factor(v, shapes.EVEN, (p, near)) for p in (1.0, 2.0))]


def _gravity(v: Variable, x: Floats) -> list[Factor]:
    near = _round(0.01 * _middle(x))
    side = Factor(v, shapes.SATURATION, (_round(0.05 * _middle(x)),))
    return [side, *(Factor(v, shapes.EVEN, (p, near)) for p in (1.0, 2.0))]


def _temperature(v: Variable, x: Floats) -> list[Factor]:
    near = _round(0.01 * _middle(x))
    return [*(Factor(v, shapes.EVEN, (p, near)) for p in (2.0, 1.0)), Factor(v, shapes.PLUS)]


def _grown(v: Variable, x: Floats) -> list[Factor]:
    """Powers of what is never negative."""
    if x.min() < 0:
        return [Factor(v, shapes.EVEN, (2.0, _round(0.01 * _middle(x))))]
    return [Factor(v, shapes.POWER, (p,)) for p in (0.5, 2.0)]


def _lasting(v: Variable, x: Floats) -> list[Factor]:
    last = float(x.max())
    out = [*_grown(v, x), Factor(v, shapes.LOG)]
    out += [Factor(v, shapes.RELAXATION, (_round(k * last),)) for k in (0.03, 0.1, 0.3)]
    if v.kind == "time":
        out += [
            Factor(v, shapes.STEP, (_round(a * last), _round(w * last)))
            for a in (0.15, 0.3, 0.5, 0.7, 0.85)
            for w in (0.02, 0.1)
        ]
    return out


_CURVED: dict[str, _Made] = {
    "torque": _wrench,
    "force": _wrench,
    "load": _wrench,
    "sensor": _read_by_sensor,
    "gravity": _gravity,
    "temperature": _temperature,
    "time": _lasting,
    "hanging": _lasting,
    "place": _grown,
}


def _round(x: float) -> float:
    """Two digits."""
    return float(f"{x:.2g}")
