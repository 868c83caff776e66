"""All amplitudes that are tried: products of functions of different quantities.

A product has at most `MOST_FACTORS` factors and the complexity `MOST_COMPLEXITY`. Its price, for
the size of the search, is the logarithm of the number of candidates of its complexity, plus log 2
for each unit of complexity: simple laws are few, and cheap.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from math import comb, log

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Amplitude, Composed, Factor, Variable, different
from hilcal.discovery.shapes import Numbers
from hilcal.effects.protocol import Situation
from hilcal.types import Floats, Ints

HARMONICS = 4  # Multiples of an angle; as in the diagnosis
HIGHEST_MULTIPLE = 512
"""Of an angle, at most one per pose; a choice, as for encoders."""


def functions(v: Variable, x: Floats, most: int) -> list[Factor]:
    """Return the functions of a quantity x (N,); those of complexity `most` are in no product."""
    linear = Factor(v, shapes.LINEAR)
    if v.kind in WAVES:
        waves = [
            Factor(v, f, (float(k),))
            for k in range(1, WAVES[v.kind] + 1)
            for f in (shapes.COS, shapes.SIN)
        ]
        return [linear, *waves, *_bent(v, x, most)] if v.kind == "angle" else waves
    if v.kind == "side":
        return [linear]
    return [linear, *_curved(v, x), *_bent(v, x, most)]


WAVES = {"angle": HARMONICS, "sum": 2, "sight": 2}  # multiples of an angle; a choice
BENDS = (0.3, 0.7)  # Initial bends, as quantiles; a choice


def _bent(v: Variable, x: Floats, most: int) -> list[Factor]:
    """Return functions that are zero on one side of a value, and functions of the magnitude."""
    alone = v.kind in ("force", "load", "sensor", "place")  # too many bends for products
    out = [
        Factor(v, replace(f, cost=most) if alone else f, (_round(bend),))
        for bend in np.quantile(x, BENDS).tolist()
        for f in (shapes.ABOVE, shapes.BELOW)
    ]
    if x.min() < 0 < x.max() and v.kind in ("angle", "torque"):
        near = _round(0.01 * _middle(x))
        out.append(Factor(v, shapes.THRESHOLD, (_round(0.5 * _middle(x)),)))
        out.append(Factor(v, shapes.SATURATION, (_round(_middle(x)),)))
        out += [Factor(v, shapes.EVEN, (p, near)) for p in (1.0, 2.0)]
    return list({(f.shape.name, f.numbers): f for f in out}.values())


def _middle(x: Floats) -> float:
    return float(np.median(np.abs(x[x != 0]))) if np.any(x) else 1.0


def _curved(v: Variable, x: Floats) -> list[Factor]:
    """Return curved functions of a quantity, by its kind."""
    both_signs, middle = x.min() < 0 < x.max(), _middle(x)
    near = _round(0.01 * middle)

    def even(*powers: float) -> list[Factor]:
        return [Factor(v, shapes.EVEN, (p, near)) for p in powers]

    saturation = Factor(v, shapes.SATURATION, (_round(0.05 * middle),))

    if v.kind == "gravity":
        return [saturation, *even(1.0, 2.0)]
    if v.kind == "temperature":
        return [*even(2.0, 1.0), Factor(v, shapes.PLUS)]
    if v.kind == "sensor":  # curvatures, and different gains of the sensor for pull and push
        return [Factor(v, shapes.PLUS), *even(1.0, 2.0)] if both_signs else even(2.0)
    if v.kind in ("torque", "force", "load") and both_signs:
        powers = (0.5, 2.0, 3.0) if v.kind == "torque" else ()
        odd = [Factor(v, shapes.ODD, (p, near)) for p in powers]
        return [Factor(v, shapes.PLUS), Factor(v, shapes.MINUS), saturation, *odd]
    if v.kind in ("torque", "force"):
        return [*even(2.0), Factor(v, shapes.ODD, (0.5, near))]
    grown = even(2.0) if x.min() < 0 else [Factor(v, shapes.POWER, (p,)) for p in (0.5, 2.0)]
    if v.kind not in ("time", "hanging"):
        return grown
    last = float(x.max())
    out = [*grown, Factor(v, shapes.LOG)]
    out += [Factor(v, shapes.RELAXATION, (_round(k * last),)) for k in (0.03, 0.1, 0.3)]
    if v.kind == "time":
        out += [
            Factor(v, shapes.STEP, (_round(a * last), _round(w * last)))
            for a in (0.15, 0.3, 0.5, 0.7, 0.85)
            for w in (0.02, 0.1)
        ]
    return out


def _round(x: float) -> float:
    return float(f"{x:.2g}")


MOST_COMPLEXITY = 3  # Complexity of a product; a choice: about 10⁶ candidates with all sites
MOST_FACTORS = 2  # Factors of a product; a choice, for the same reason
PRODUCTS_AT_ONCE = 2000  # Products that are formed at a time; a choice, by memory
ARGUMENT_COMPLEXITY = 2  # Complexity of a product in a composed quantity; a choice, by their number
COMPOSED_OF = {
    "angle", "torque", "load", "gravity", "temperature", "time", "hanging", "place",
}  # fmt: skip
"""Kinds of quantities in composed ones; a choice: components in joint axes are too many."""
WAVES_OF_ARGUMENT = 2  # Multiples of an angle in a composed quantity; a choice
SHAPES_OF_ARGUMENT = 5  # of a composed quantity: bends to both sides, also with an exponent, steps
NEARLY_CONSTANT = 0.1
"""Spread over size of nearly constant factors, which enter no product; a choice."""


@dataclass(frozen=True, eq=False)
class Grammar:
    """All amplitudes that are tried, and their values."""

    known: list[Variable]
    amplitudes: tuple[Amplitude, ...]
    values: Floats  # (F, N) their values, single precision, each scaled to root mean square 1
    size: Floats  # (F,) root mean squares before scaling
    cost: Ints  # (F,) complexities
    partner: Ints  # (F,) index with sine for cosine in the first periodic factor; −1 for none
    without_factor: Ints  # (2, F) index of a product of two without either factor; else −1
    situation: Situation
    single_factors: tuple[Factor, ...]  # functions of one quantity from which products are formed
    _more: list[tuple[Amplitude, Floats, float]] = field(default_factory=list)
    _read: dict[str, Floats] = field(default_factory=dict)

    def amplitude(self, k: int) -> Amplitude:
        """Return an amplitude by its index."""
        count = len(self.amplitudes)
        return self.amplitudes[k] if k < count else self._more[k - count][0]

    def rows(self, which: list[int]) -> Floats:
        """(P, N) values of amplitudes, each with root mean square 1."""
        count = len(self.amplitudes)
        return np.array([self.values[k] if k < count else self._more[k - count][1] for k in which])

    def index(self, amplitude: Amplitude) -> int | None:
        """Return the index of an amplitude, adding a new one; None if it is zero."""
        index = self.place(amplitude)
        if index is not None:
            return index
        values = self.values_of(amplitude)
        size = float(np.sqrt(np.mean(values**2)))
        if not np.isfinite(size) or size == 0:
            return None
        k = len(self.amplitudes) + len(self._more)
        self._more.append((amplitude, (values / size).astype(np.float32), size))
        self._places[_key(amplitude)] = k
        return k

    def values_of(self, a: Amplitude) -> Floats:
        """(N,) values of an amplitude at the readings."""
        out = np.ones(self.values.shape[1])
        for f in a.factors:
            out = out * f.shape.value(self.read(f.variable), f.numbers)
        return out

    def read(self, v: Variable) -> Floats:
        """(N,) values of a quantity at the readings."""
        if v.symbol not in self._read:
            self._read[v.symbol] = v.read(self.situation)
        return self._read[v.symbol]

    def with_sine(self, k: int) -> int | None:
        """Return the amplitude with sine for cosine in its first periodic factor."""
        if k < len(self.amplitudes):
            return int(self.partner[k]) if self.partner[k] >= 0 else None
        partner = _sine_for_cosine(self.amplitude(k))
        return None if partner is None else self.index(partner)

    def place(self, amplitude: Amplitude) -> int | None:
        """Return the index of an amplitude; None if it was not tried."""
        return self._places.get(_key(amplitude))

    @cached_property
    def _places(self) -> dict[frozenset[tuple[str, str, Numbers]], int]:
        return {_key(a): k for k, a in enumerate(self.amplitudes)}

    def tuned(self, a: Amplitude) -> int:
        """Return the number of factors whose numbers are not on the grid."""
        return sum(k not in self._grid for k in _key(a))

    @cached_property
    def _grid(self) -> frozenset[tuple[str, str, Numbers]]:
        return frozenset(k for a in self.amplitudes if len(a.factors) == 1 for k in _key(a))

    def inner(self, k: int) -> list[int]:
        """Return the indices of the amplitudes with one factor less."""
        factors = self.amplitude(k).factors
        less = (Amplitude((*factors[:i], *factors[i + 1 :])) for i in range(len(factors)))
        return [index for a in less if (index := self.place(a)) is not None]

    def price(self, sites: int) -> Floats:
        """(F,) price: log of the number of candidates of this complexity, plus log 2 per unit."""
        count = np.bincount(self.cost) * sites
        return np.asarray(np.log(count[self.cost]) + log(2.0) * self.cost)

    def price_of(self, a: Amplitude, sites: int) -> float:
        """Return the price of any product, as if all products of its complexity were tried."""
        if len(a.factors) == 1 and isinstance(u := a.factors[0].variable, Composed):
            # Further products of a sum are priced where they are added.
            argument = float(self.price_of_argument[u.terms[0][1].cost])
            return argument + log(SHAPES_OF_ARGUMENT * sites) + log(2.0) * a.factors[0].shape.cost
        kind = a.cost, len(a.factors)
        count = self._counts.get(kind, self._counts.get((a.cost, 0), 1))
        return log(max(count, 1) * sites) + log(2.0) * a.cost

    @cached_property
    def _counts(self) -> dict[tuple[int, int], int]:
        """Number of products by complexity and factors; with 0 factors, of `amplitudes`."""
        n = np.bincount([f.cost for f in self.single_factors], minlength=4).tolist()
        by_cost = np.bincount(self.cost).tolist()
        return {
            (4, 2): comb(n[2], 2) + n[1] * n[3],
            (3, 3): comb(n[1], 3),
            (4, 3): comb(n[1], 2) * n[2],
            **{(cost, 0): count for cost, count in enumerate(by_cost)},
        }

    @cached_property
    def price_of_argument(self) -> Floats:
        """(C,) log of the number of products in arguments, plus log 2 per unit, by complexity."""
        count = np.bincount(self.cost[self.smooth], minlength=ARGUMENT_COMPLEXITY + 1)
        return np.asarray(np.log(np.maximum(count, 1)) + log(2.0) * np.arange(len(count)))

    @cached_property
    def smooth(self) -> Ints:
        """(F',) indices of simple products without a bend, for composed quantities."""
        indices = [k for k, a in enumerate(self.amplitudes) if _smooth(a)]
        return np.array(sorted(indices, key=lambda k: self.cost[k]), dtype=np.int_)

    @cached_property
    def unit_of_smooth(self) -> dict[int, str]:
        """Units of `smooth`, by index."""
        return {k: self.amplitude(k).unit() for k in self.smooth.tolist()}

    @cached_property
    def depends(self) -> tuple[frozenset[str], ...]:
        """Names of the quantities of each amplitude."""
        return tuple(frozenset(a.names) for a in self.amplitudes)


def _smooth(a: Amplitude) -> bool:
    kinds = {f.variable.kind for f in a.factors}
    if not 0 < a.cost <= ARGUMENT_COMPLEXITY or not kinds <= COMPOSED_OF | {"sum"}:
        return False
    if len(a.factors) > 1 and "sum" in kinds:
        return False
    return all(
        f.shape.name == "linear"
        or (f.shape.name in ("cos", "sin") and f.numbers[0] <= WAVES_OF_ARGUMENT)
        or (f.shape.name == "even" and f.numbers[0] == 2)
        for f in a.factors
    )


def _key(a: Amplitude) -> frozenset[tuple[str, str, Numbers]]:
    return frozenset((f.variable.symbol, f.shape.name, f.numbers) for f in a.factors)


def grammar(quantities: list[Variable], s: Situation, poses: int = 0) -> Grammar:
    """Return all products of functions of quantities; `poses` limits multiples of an angle."""
    singles = [f for v in quantities for f in functions(v, v.read(s), MOST_COMPLEXITY)]
    singles += [  # fine waves, as complex as a product: in no product
        Factor(v, f, (float(k),))
        for v in quantities
        if v.kind == "angle"
        for k in range(HARMONICS + 1, min(poses, HIGHEST_MULTIPLE) + 1)
        for f in (shapes.FINE_COS, shapes.FINE_SIN)
    ]
    value = np.array([f.values(s) for f in singles]).reshape(len(singles), -1)
    cost = np.array([f.cost for f in singles])
    flat = np.std(value, axis=1) < NEARLY_CONSTANT * np.sqrt(np.mean(value**2, axis=1))
    pairs: list[tuple[int, int]] = [(-1, -1)] + [
        (i, -1) for i in range(len(singles)) if cost[i] <= MOST_COMPLEXITY
    ]
    curved = np.flatnonzero((cost < MOST_COMPLEXITY) & ~flat).tolist()
    for start, i in enumerate(curved, start=1):
        for k in curved[start:]:
            if cost[i] + cost[k] <= MOST_COMPLEXITY and different(singles[i], singles[k]):
                pairs.append((i, k))
    value = np.vstack([value, np.ones(value.shape[1])])
    values, size, nonzero = _products(value, np.array(pairs))
    amplitudes = tuple(
        Amplitude(tuple(singles[i] for i in pairs[k] if i >= 0)) for k in nonzero.tolist()
    )
    place = {pairs[k]: index for index, k in enumerate(nonzero.tolist())}
    by_key = {_key(a): k for k, a in enumerate(amplitudes)}
    turned = (_sine_for_cosine(a) for a in amplitudes)
    partner = np.array([-1 if t is None else by_key.get(_key(t), -1) for t in turned])
    of_single = np.array([place.get((i, -1), -1) for i in range(-1, len(singles))])
    first, second = np.array(pairs)[nonzero].T
    less = np.where(second >= 0, [of_single[second + 1], of_single[first + 1]], -1)
    return Grammar(
        quantities,
        amplitudes,
        values,
        size,
        np.array([a.cost for a in amplitudes]),
        partner,
        less,
        s,
        tuple(
            f
            for f, same in zip(singles, flat.tolist(), strict=True)
            if not same and f.shape not in (shapes.FINE_COS, shapes.FINE_SIN)
        ),
    )


def _products(value: Floats, pairs: Ints) -> tuple[Floats, Floats, Ints]:
    """Multiply pairs (F, 2) of rows, and leave out the products that are zero.

    Returns the other products (F', N), scaled to root mean square 1, in single precision; (F',)
    their root mean squares before; and (F',) the indices of their pairs.
    """
    size = np.empty(len(pairs))
    for part in (slice(a, a + PRODUCTS_AT_ONCE) for a in range(0, len(pairs), PRODUCTS_AT_ONCE)):
        first, second = pairs[part].T
        size[part] = np.sqrt(np.mean((value[first] * value[second]) ** 2, axis=1))
    nonzero = np.flatnonzero(size > 0)
    out: Floats = np.empty((len(nonzero), value.shape[1]), dtype=np.float32)
    for part in (slice(a, a + PRODUCTS_AT_ONCE) for a in range(0, len(nonzero), PRODUCTS_AT_ONCE)):
        first, second = pairs[nonzero[part]].T
        out[part] = value[first] * value[second] / size[nonzero[part], None]
    return out, size[nonzero], nonzero


def _sine_for_cosine(a: Amplitude) -> Amplitude | None:
    """Return the amplitude with sine for cosine in its first periodic factor; None for none."""
    for i, f in enumerate(a.factors):
        if f.shape.name == "cos":
            sine = replace(f, shape=replace(shapes.SIN, cost=f.shape.cost))
            return Amplitude((*a.factors[:i], sine, *a.factors[i + 1 :]))
    return None
