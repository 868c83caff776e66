"""Functions of one recorded quantity from which laws are formed, with their derivatives.

linear      x
cos, sin    cos k x, sin k x
odd, even   sign(x) |x|^p, |x|^p, rounded off at zero where p < 1
plus, minus max(x, 0), max(−x, 0)
above       max(x − x0, 0), and a power of it
below       max(x0 − x, 0), and a power of it
saturation  tanh(x/x0), for small x0 the sign of x
log         log10(1 + x/unit)
relaxation  1 − exp(−x/T)
step        tanh((x − x0)/w)

Each function is Python code: the search evaluates the same code as a law's effect.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from types import CodeType
from typing import Any

import numpy as np

from hilcal.types import Floats

Numbers = tuple[float, ...]
_Written = str | Callable[[str, list[str]], str]
"""How f(x; p) is written, from text for x and for each of p: with {x}, {p[0]}, {p[1]}, the product
{px} of p[0] and x, and {b}, p[0] in brackets if it is negative; or a function that writes it."""


@dataclass(frozen=True, slots=True)
class Shape:
    """A function f(x; p) of one quantity."""

    name: str  # e.g. "saturation"
    cost: int  # complexity
    code: _Written  # f as Python
    slope_code: _Written  # ∂f/∂x as Python
    text: _Written
    power: Callable[[Numbers], float] = lambda p: 0.0  # power of the unit of x in the unit of f
    free: tuple[int, ...] = ()  # indices of p that a refinement may change
    places: tuple[int, ...] = ()  # indices of p that are values of x, which may be zero or negative

    def value(self, x: Floats, p: Any) -> Floats:
        """Return f at x; numbers may be arrays that broadcast with it."""
        return _evaluated(self.code, x, p)

    def slope(self, x: Floats, p: Any) -> Floats:
        """Return ∂f/∂x at x; numbers may be arrays that broadcast with it."""
        return _evaluated(self.slope_code, x, p)

    def written(self, notation: str, x: str, p: list[str]) -> str:
        """Return f as "text", "latex" or Python "code", or its slope as "slope_code"."""
        if notation != "latex":
            return _filled(getattr(self, notation), x, p, "·" if notation == "text" else " * ")
        if self.name == "threshold":
            return rf"\operatorname{{sign}}({x})\max(|{x}| - {p[0]}, 0)"
        if self.name == "relaxation":
            return rf"(1 - e^{{-{x}/{p[0]}}})"
        out = _filled(self.text, x, p, r"\,").replace("·", r"\,")
        out = out.replace("sign(", r"\operatorname{sign}(")
        out = re.sub(r"(?<![\\\w])(max|cos|sin|tanh)\(", r"\\\1(", out).replace(
            "log10", r"\log_{10}"
        )
        return re.sub(r"\^(\d[\d.]+)", r"^{\1}", out)

    @property
    def rank(self) -> int:
        """Order in which equally good functions are shown: smaller is simpler."""
        bent = ("minus", "above", "below", "above_power", "below_power")
        return {"linear": 0, "even": 2, **dict.fromkeys(bent, 3)}.get(self.name, 1)


def _filled(written: _Written, x: str, p: list[str], times: str) -> str:
    if callable(written):
        return written(x, p)
    first = p[0] if p else ""
    product = x if first in ("1", "1.0") else f"{first}{times}{x}"
    return written.format(x=x, p=p, px=product, b=f"({first})" if first.startswith("-") else first)


def _evaluated(written: _Written, x: Floats, p: Any) -> Floats:
    return np.asarray(eval(_compiled(written), {"np": np, "x": x, "p": p}))  # noqa: S307


@cache
def _compiled(written: _Written) -> CodeType:
    return compile(_filled(written, "x", ["p[0]", "p[1]"], " * "), "<function>", "eval")


def _one(p: Numbers) -> float:
    return 1.0


def _exponent(p: Numbers) -> float:
    return p[0]


def _root(x: str, p: list[str]) -> str:
    """Return |x|, rounded off by p[1] if the exponent p[0] is below 1: else no equilibrium."""
    if p[0] == "p[0]":
        return f"np.hypot({x}, p[1] * (p[0] < 1))"
    return f"np.hypot({x}, {p[1]})" if float(p[0]) < 1 else f"np.abs({x})"


def _odd_slope(x: str, p: list[str]) -> str:
    root = f"np.maximum({_root(x, p)}, 1e-12)"
    smooth = f"{p[0]} * {root} ** ({p[0]} - 1)"
    rounded = f"{root} ** ({p[0]} - 3) * ({p[0]} * {x}**2 + {p[1]}**2)"
    if p[0] == "p[0]":
        return f"np.where(p[0] < 1, {rounded}, {smooth})"
    return rounded if float(p[0]) < 1 else smooth


LINEAR = Shape("linear", 1, "{x}", "np.ones_like({x})", "{x}", _one)
COS = Shape("cos", 1, "np.cos({px})", "-{p[0]} * np.sin({px})", "cos({px})")
SIN = Shape("sin", 1, "np.sin({px})", "{p[0]} * np.cos({px})", "sin({px})")
FINE_COS, FINE_SIN = replace(COS, cost=3), replace(SIN, cost=3)  # of high orders
ODD = Shape(
    "odd", 2,
    lambda x, p: f"{x} * {_root(x, p)} ** ({p[0]} - 1)",
    _odd_slope,
    lambda x, p: f"{x}^3" if p[0] == "3" else f"sign({x})·|{x}|^{p[0]}",
    _exponent, (0,),
)  # fmt: skip
EVEN = Shape(
    "even", 2,
    lambda x, p: f"{_root(x, p)} ** {p[0]}",
    lambda x, p: f"{p[0]} * {x} * np.maximum({_root(x, p)}, 1e-12) ** ({p[0]} - 2)",
    lambda x, p: {"1": f"|{x}|", "2": f"{x}^2"}.get(p[0], f"|{x}|^{p[0]}"),
    _exponent, (0,),
)  # fmt: skip
POWER = Shape(
    "power", 2, "np.maximum({x}, 0.0) ** {p[0]}",
    "{p[0]} * np.maximum({x}, 0.0) ** ({p[0]} - 1)", "{x}^{p[0]}", _exponent, (0,),
)  # fmt: skip
PLUS = Shape("plus", 2, "np.maximum({x}, 0.0)", "np.where({x} > 0, 1.0, 0.0)", "max({x}, 0)", _one)
MINUS = Shape(
    "minus", 2, "np.maximum(-{x}, 0.0)", "np.where({x} < 0, -1.0, 0.0)", "max(-{x}, 0)", _one
)
ABOVE = Shape(
    "above", 2, "np.maximum({x} - {b}, 0.0)", "np.where({x} > {p[0]}, 1.0, 0.0)",
    "max({x} - {b}, 0)", _one, (0,), (0,),
)  # fmt: skip
BELOW = Shape(
    "below", 2, "np.maximum({p[0]} - {x}, 0.0)", "np.where({x} < {p[0]}, -1.0, 0.0)",
    "max({p[0]} - {x}, 0)", _one, (0,), (0,),
)  # fmt: skip
ABOVE_POWER = Shape(
    "above_power", 3, "np.maximum({x} - {b}, 0.0) ** {p[1]}",
    "{p[1]} * np.maximum(({x} - {b}), 1e-12) ** ({p[1]} - 1) * (({x} - {b}) > 0)",
    "max({x} - {b}, 0)^{p[1]}", lambda p: p[1], (0, 1), (0,),
)  # fmt: skip
BELOW_POWER = Shape(
    "below_power", 3, "np.maximum({p[0]} - {x}, 0.0) ** {p[1]}",
    "-{p[1]} * np.maximum(({p[0]} - {x}), 1e-12) ** ({p[1]} - 1) * (({p[0]} - {x}) > 0)",
    "max({p[0]} - {x}, 0)^{p[1]}", lambda p: p[1], (0, 1), (0,),
)  # fmt: skip
SATURATION = Shape(
    "saturation", 2, "np.tanh({x} / {p[0]})", "(1 - np.tanh({x} / {p[0]}) ** 2) / {p[0]}",
    "tanh({x}/{p[0]})", free=(0,),
)  # fmt: skip
THRESHOLD = Shape(
    "threshold", 2, "np.sign({x}) * np.maximum(np.abs({x}) - {p[0]}, 0.0)",
    "np.where(np.abs({x}) > {p[0]}, 1.0, 0.0)", "beyond({x}, {p[0]})", _one, (0,),
)  # fmt: skip
LOG = Shape(
    "log", 1, "np.log10(1.0 + np.maximum({x}, 0.0))",
    "np.where({x} > 0, 1.0, 0.0) / np.log(10.0) / (1.0 + np.maximum({x}, 0.0))",
    "log10(1 + {x})",
)  # fmt: skip
RELAXATION = Shape(
    "relaxation", 2, "1.0 - np.exp(-np.maximum({x}, 0.0) / {p[0]})",
    "np.where({x} > 0, 1.0, 0.0) * np.exp(-np.maximum({x}, 0.0) / {p[0]}) / {p[0]}",
    "(1 - exp(-{x}/{p[0]}))", free=(0,),
)  # fmt: skip
STEP = Shape(
    "step", 2, "np.tanh(({x} - {p[0]}) / {p[1]})",
    "(1 - np.tanh(({x} - {p[0]}) / {p[1]}) ** 2) / {p[1]}", "tanh(({x} - {p[0]})/{p[1]})",
    free=(0, 1), places=(0,),
)  # fmt: skip
