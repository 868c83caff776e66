"""The amplitude of a law: a product of functions of recorded quantities.

The complexity of a product is the sum of those of its shapes; a sum of joint angles as quantity
adds 1. A function f(u) of a composed quantity u = Σ w_i φ_i is not a sum of products: the pull of
a hose that is taut beyond a length u0 is max(u − u0, 0), where u depends on two joints, for example
as cos q_5·cos q_6. Its derivative with respect to the transmitted wrenches W follows from the chain
rule, ∂f/∂W = f'(u) Σ w_i ∂φ_i/∂W.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain, combinations
from types import CodeType
from typing import Literal

import numpy as np

from hilcal.discovery.shapes import Numbers, Shape
from hilcal.effects.force_sensor import recorded
from hilcal.effects.protocol import Situation
from hilcal.types import Floats

Kind = Literal[
    "angle", "sum", "torque", "force", "load", "gravity", "temperature", "time", "hanging", "side",
    "place", "sight", "sensor", "composed",
]  # fmt: skip
LEAST_SPREAD = 1e-6
"""Least spread, as a share of the largest value, of a quantity that counts as varying."""
_AXES = "xyz"
_COMPONENTS = tuple(
    (c, *(("force", "f") if c < 3 else ("moment", "m")), _AXES[c % 3], "N" if c < 3 else "N·m")
    for c in range(6)
)
"""Of a wrench: index, word, letter, axis, unit."""


@dataclass(frozen=True, slots=True, eq=False)
class Variable:
    """A recorded quantity."""

    kind: Kind  # selects the functions that are tried
    names: tuple[str, ...]  # in the diagnosis; for a sum those of its summands
    symbol: str  # in formulas
    latex: str  # in LaTeX formulas
    unit: str  # SI; °C for temperatures, "1" for a number
    code: str  # Python expression of a situation s, for effects and for the search
    need: str = ""  # column of the readings that it needs; empty for none
    slot: tuple[int, int] | None = None  # slot and component, for a component of a wrench
    joint: int = -1  # index of its joint; −1 for none
    vector: str = ""  # vector of which it is a component; empty for none
    axis: int = -1  # axis of the component; −1 for none

    def read(self, s: Situation) -> Floats:
        """(N,) values in the states."""
        namespace = {"np": np, "recorded": recorded, "s": s}
        return np.asarray(eval(_compiled(self.code), namespace))  # noqa: S307 - made below

    @property
    def cost(self) -> int:
        """Complexity that the quantity adds to its functions."""
        return int(self.kind == "sum")

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return (self.need,) if self.need else ()

    @property
    def recorded(self) -> tuple["Variable", ...]:
        """The recorded quantities of which it consists: itself."""
        return (self,)

    def slopes(self) -> tuple[tuple[tuple[int, int], str], ...]:
        """Slots and components of transmitted wrenches, each with ∂x as Python; "" for 1."""
        return () if self.slot is None else ((self.slot, ""),)


@cache
def _compiled(code: str) -> CodeType:
    return compile(code, "<quantity>", "eval")


def variables(s: Situation) -> list[Variable]:
    """Return all quantities that vary over the states of a situation."""
    n = s.angle.shape[1]
    quantities = chain(_angles(s), _wrenches(n), _attitude(n), _recorded(s, n), _places())
    values = ((v, v.read(s)) for v in quantities)
    return [v for v, x in values if np.ptp(x) > LEAST_SPREAD * max(float(np.abs(x).max()), 1e-300)]


def _angles(s: Situation) -> Iterator[Variable]:
    """Angles of joints and their sums; for a joint that slides, the phase φ of its travel."""
    arm = s.cell.arm
    for j, slides in enumerate(arm.slides.tolist()):
        letter, latex = ("φ", r"\phi") if slides else ("q", "q")
        yield Variable(
            "angle", (f"joint {j + 1} {arm.kind(j)}",), f"{letter}_{j + 1}", f"{latex}_{j + 1}",
            "rad", f"s.angle[:, {j}]", joint=j,
        )  # fmt: skip
    for i, j in combinations(np.flatnonzero(~arm.slides).tolist(), 2):
        for sign in "+-":
            names = f"joint {i + 1} angle", f"joint {j + 1} angle"
            text = f"(q_{i + 1} {sign} q_{j + 1})"
            code = f"(s.angle[:, {i}] {sign} s.angle[:, {j}])"
            yield Variable("sum", names, text, text, "rad", code)
    for a, b in ((i, i + k) for k in range(3, arm.n + 1) for i in range(arm.n - k + 1)):
        # Rotation of a link relative to another one: sum over consecutive joints.
        if not arm.slides[a:b].any():
            text = f"({' + '.join(f'q_{j + 1}' for j in range(a, b))})"
            summands = tuple(f"joint {j + 1} angle" for j in range(a, b))
            yield Variable("sum", summands, text, text, "rad", f"s.angle[:, {a}:{b}].sum(axis=1)")


def _wrenches(n: int) -> Iterator[Variable]:
    """Torques of drives, wrenches through joints and flange, load, and force sensor readings."""
    for j in range(n):
        yield Variable(
            "torque", (f"joint {j + 1} torque",), f"τ_{j + 1}", rf"\tau_{j + 1}", "N·m",
            f"s.torque[:, {j}]", slot=(j, 5), joint=j,
        )  # fmt: skip
    for k in range(n + 1):
        where, short, joint = (f"joint {k + 1}", str(k + 1), k) if k < n else ("flange", "F", -1)
        for c, word, letter, axis, unit in _COMPONENTS[: 5 if k < n else 6]:
            yield Variable(
                "force", (f"{where} {word} {axis}",), f"{letter}{short}_{axis}",
                f"{letter}_{{{short},{axis}}}", unit, f"s.wrench[:, {k}, {c}]", slot=(k, c),
                joint=joint, vector=f"{letter}{short}", axis=c % 3,
            )  # fmt: skip
    for c, _, letter, axis, unit in _COMPONENTS:
        if c % 3 == 0:
            norm = f"np.linalg.norm(s.states.wrench[:, {c}:{c + 3}], axis=1)"
            yield Variable("load", ("load",), f"|{letter}|", f"|{letter}|", unit, norm)
        text, code = f"{letter}_{axis}", f"s.states.wrench[:, {c}]"
        yield Variable("load", ("load",), text, text, unit, code, vector=letter, axis=c % 3)
    for c, word, letter, axis, unit in _COMPONENTS:  # causes of the sensor's errors
        yield Variable(
            "sensor", (f"force sensor {word} {axis}",), f"{letter}S_{axis}",
            rf"{letter}_{{S,{axis}}}", unit, f"recorded(s)[:, {c}]",
            vector=f"{letter}S", axis=c % 3,
        )  # fmt: skip


def _attitude(n: int) -> Iterator[Variable]:
    """Components of gravity's direction along the joint axes and the flange axes."""
    places = [(k, 2, f"axis of joint {k + 1} to gravity", f"g{k + 1}") for k in range(n)]
    places += [(n, c, "flange attitude", f"gF_{_AXES[c]}") for c in range(3)]
    for k, c, name, symbol in places:
        yield Variable(
            "gravity", (name,), symbol, symbol.replace("g", "g_", 1).replace("_F_", "_"), "1",
            f"(s.chain.rotation[{k}][:, :, {c}]"
            " @ (s.cell.gravity / np.linalg.norm(s.cell.gravity)))",
            joint=k if k < n else -1, vector="gravity" if k == n else "", axis=c,
        )  # fmt: skip


def _recorded(s: Situation, n: int) -> Iterator[Variable]:
    """Temperatures, times, and sides of approach: optional columns of readings."""
    states = s.states
    if states.air_temperature is not None:
        zero = round(float(np.median(states.air_temperature)), 1)
        yield Variable(
            "temperature", ("air temperature",), f"(T_air - {zero})",
            rf"(T_\mathrm{{air}} - {zero})", "°C", f"(s.states.air_temperature - {zero})",
            "air_temperature",
        )  # fmt: skip
    if states.joint_temperature is not None:
        zero = round(float(np.median(states.joint_temperature)), 1)
        for j in range(n):
            name, text = (f"joint {j + 1} temperature",), f"(T_{j + 1} - {zero})"
            code = f"(s.states.joint_temperature[:, {j}] - {zero})"
            yield Variable(
                "temperature", name, text, text, "°C", code, "joint_temperature", joint=j
            )
    if states.time is not None:
        zero = float(np.floor(states.time.min()))
        text = "t" if zero == 0 else f"(t - {zero:.0f})"
        yield Variable("time", ("time",), text, text, "s", f"(s.states.time - {zero})", "time")
    if states.load_time is not None:
        latex, code = r"t_\mathrm{load}", "s.states.load_time"
        yield Variable("hanging", ("time under load",), "t_load", latex, "s", code, "load_time")
    for j in range(n if states.approach is not None else 0):
        name, text, code = (f"joint {j + 1} approach",), f"s_{j + 1}", f"s.states.approach[:, {j}]"
        yield Variable("side", name, text, text, "1", code, "approach", joint=j)


def _places() -> Iterator[Variable]:
    """Position of the target, from the base and from the tracker."""
    target = "s.chain.point(s.cell.target[:3, 3])"
    in_tracker = f"({target} @ s.cell.registration[:3, :3].T + s.cell.registration[:3, 3])"
    for name, text, latex, code in (
        ("reach", "ρ", r"\rho", f"np.linalg.norm({target}[:, :2], axis=1)"),
        ("height", "z", "z", f"{target}[:, 2]"),
        ("distance", "d", "d", f"np.linalg.norm({in_tracker}, axis=1)"),
        ("target x", "x", "x", f"{target}[:, 0]"),
        ("target y", "y", "y", f"{target}[:, 1]"),
    ):
        axis = _AXES.find(text)
        vector = "target" if axis >= 0 else ""
        yield Variable("place", (name,), text, latex, "m", code, vector=vector, axis=axis)
    flat = f"np.hypot({in_tracker}[:, 0], {in_tracker}[:, 1])"
    turns = f"{in_tracker}[:, 1], {in_tracker}[:, 0]", f"{in_tracker}[:, 2], {flat}"
    yield Variable("sight", ("azimuth",), "az", r"\alpha", "rad", f"np.arctan2({turns[0]})")
    yield Variable("sight", ("elevation",), "el", r"\varepsilon", "rad", f"np.arctan2({turns[1]})")


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
        """(N,) values in the states."""
        return self.shape.value(self.variable.read(s), self.numbers)

    @property
    def power(self) -> float:
        """Power of the variable's unit in the unit of the factor."""
        return self.shape.power(self.numbers)

    def written(self, notation: str) -> str:
        """Return the factor as "text", "latex" or Python "code", or its slope as "slope_code"."""
        v = self.variable
        if notation in ("text", "latex"):
            x, numbers = (
                v.symbol if notation == "text" else v.latex,
                [f"{x:g}" for x in self.numbers],
            )
        else:
            x, numbers = v.code, [repr(x) for x in self.numbers]
        return self.shape.written(notation, x, numbers)


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
        """Names of its quantities."""
        return tuple(dict.fromkeys(n for f in self.factors for n in f.variable.names))

    @property
    def elastic(self) -> bool:
        """Whether the amplitude depends on transmitted wrenches."""
        return any(f.variable.slot is not None for f in self.factors)

    @property
    def sensed(self) -> bool:
        """Whether the amplitude depends on the force sensor's reading in sensor axes."""
        return any(f.variable.kind == "sensor" for f in self.factors)

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return tuple(dict.fromkeys(n for f in self.factors for n in f.variable.needs))

    def values(self, s: Situation) -> Floats:
        """(N,) values in the states."""
        out = np.ones(len(s.angle))
        for f in self.factors:
            out = out * f.values(s)
        return out

    @property
    def powers(self) -> dict[str, float]:
        """Powers of the units in the unit of the product."""
        powers: dict[str, float] = {}
        for f in self.factors:
            if f.power and f.variable.unit != "1":
                powers[f.variable.unit] = powers.get(f.variable.unit, 0.0) + f.power
        return powers

    def text(self) -> str:
        """Return the product as text."""
        return "·".join(f.written("text") for f in self.factors)

    def latex(self) -> str:
        """Return the product in LaTeX."""
        return r"\,".join(f.written("latex") for f in self.factors)

    def code(self) -> str:
        """Return the product as Python expression of a situation s."""
        parts = [f.written("code") for f in self.factors] or ["np.ones(len(s.angle))"]
        return parts[0] if len(parts) == 1 else " * ".join(f"({part})" for part in parts)

    def slopes(self) -> Iterator[tuple[tuple[int, int], str]]:
        """Yield slots and components of transmitted wrenches, with the derivatives as Python."""
        for i, f in enumerate(self.factors):
            cofactor = Amplitude((*self.factors[:i], *self.factors[i + 1 :]))
            for slot, inner in f.variable.slopes():
                parts = [f.written("slope_code"), *([inner] if inner else [])]
                parts += [cofactor.code()] if cofactor.factors else []
                yield slot, " * ".join(f"({part})" for part in parts)

    def unit(self) -> str:
        """Unit of the product; "1" for none."""
        return unit_of(self.powers)

    def of_joint(self, old: int, new: int, quantities: list[Variable]) -> "Amplitude | None":
        """Return the product with the quantities of joint `new`; None if `quantities` lack one."""
        return self._with(
            lambda v: v.joint == old and v.kind != "sum",
            lambda v, w: (
                w.kind == v.kind
                and w.joint == new
                and (w.slot is None or v.slot is None or w.slot[1] == v.slot[1])
            ),
            quantities,
        )

    def of_axis(self, old: int, new: int, quantities: list[Variable]) -> "Amplitude | None":
        """Return the product with the vectors' components along two axes exchanged."""
        swap = {old: new, new: old}
        return self._with(
            lambda v: bool(v.vector) and v.axis in swap,
            lambda v, w: w.vector == v.vector and w.axis == swap[v.axis],
            quantities,
        )

    def _with(
        self,
        changes: Callable[[Variable], bool],
        same: Callable[[Variable, Variable], bool],
        quantities: list[Variable],
    ) -> "Amplitude | None":
        """Return the product with other quantities where `changes`; None if one is missing."""
        out = []
        for f in self.factors:
            v = f.variable
            substitute = next((w for w in quantities if same(v, w)), None) if changes(v) else v
            if substitute is None:
                return None
            out.append(replace(f, variable=substitute))
        return Amplitude(tuple(out))


def unit_of(powers: dict[str, float]) -> str:
    """Return a product of units by their powers; "1" for none."""
    parts = {u: f"({u})" if "·" in u else u for u in powers}
    return "·".join(u if p == 1 else f"{parts[u]}^{p:g}" for u, p in powers.items()) or "1"


def different(a: Factor, b: Factor) -> bool:
    """Whether two factors are of different quantities."""
    return not set(a.variable.names) & set(b.variable.names) or (
        a.variable.kind == "load" and a.variable.symbol != b.variable.symbol
    )


@dataclass(frozen=True, slots=True, eq=False)
class Composed(Variable):
    """A weighted sum of products, as a quantity."""

    terms: tuple[tuple[float, Amplitude], ...] = ()  # weights, the first 1, and products

    def read(self, s: Situation) -> Floats:
        """(N,) values in the states."""
        return np.asarray(sum(w * a.values(s) for w, a in self.terms))

    @property
    def needs(self) -> tuple[str, ...]:
        """Columns of the readings that it needs."""
        return tuple(dict.fromkeys(n for _, a in self.terms for n in a.needs))

    @property
    def recorded(self) -> tuple[Variable, ...]:
        """The recorded quantities of which it consists."""
        return tuple(dict.fromkeys(f.variable for _, a in self.terms for f in a.factors))

    def slopes(self) -> tuple[tuple[tuple[int, int], str], ...]:
        """Slots and components of transmitted wrenches, each with ∂u as Python."""
        slopes = [(slot, w, code) for w, a in self.terms for slot, code in a.slopes()]
        return tuple((slot, code if w == 1 else f"{w!r} * {code}") for slot, w, code in slopes)

    @property
    def cost(self) -> int:
        """Complexity: that of its products, and 1 for each free weight."""
        return sum(a.cost for _, a in self.terms) + len(self.terms) - 1


def composed(terms: tuple[tuple[float, Amplitude], ...]) -> Composed:
    """Return the quantity of a weighted sum of products of one unit; the first weight is 1."""
    products = [a for _, a in terms]
    slots = [f.variable.slot for a in products for f in a.factors if f.variable.slot is not None]
    joints = {f.variable.joint for a in products for f in a.factors}
    return Composed(
        "composed", tuple(dict.fromkeys(n for a in products for n in a.names)),
        _sum([(w, a.text()) for w, a in terms], "·"),
        _sum([(w, a.latex()) for w, a in terms], r"\,"), products[0].unit(), _code(terms),
        slot=slots[0] if slots else None, joint=joints.pop() if len(joints) == 1 else -1,
        terms=terms,
    )  # fmt: skip


def _sum(terms: list[tuple[float, str]], times: str) -> str:
    """Weighted sum as text, in brackets if it has several products."""
    out = terms[0][1]
    for w, text in terms[1:]:
        size = "" if abs(w) == 1 else f"{abs(w):g}{times}"
        out += f" {'-' if w < 0 else '+'} {size}{text}"
    return out if len(terms) == 1 else f"({out})"


def _code(terms: tuple[tuple[float, Amplitude], ...]) -> str:
    parts = [f"({a.code()})" if w == 1 else f"{w!r} * ({a.code()})" for w, a in terms]
    return f"({' + '.join(parts)})" if len(parts) > 1 else parts[0]
