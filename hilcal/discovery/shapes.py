"""Functions of one recorded quantity from which laws are made, each with its derivative.

linear      x
cos, sin    cos k x, sin k x
odd, even   sign(x) |x|^p, |x|^p, rounded off at zero where p < 1
plus, minus max(x, 0), max(−x, 0)
above       max(x − x0, 0), and a power of it
below       max(x0 − x, 0), likewise
saturation  tanh(x/x0), which for a small x0 is the sign of x
log         log10(1 + x/unit)
approach    1 − exp(−x/T)
step        tanh((x − x0)/w)
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from hilcal.types import Floats

Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Shape:
    """A function f(x; p) of one quantity.

    Attributes:
        name: e.g. "saturation".
        cost: its complexity.
        value: f.
        slope: ∂f/∂x.
        code: f as Python, of the name of x and the numbers p as Python.
        slope_code: ∂f/∂x likewise.
        text: f as text, likewise.
        latex: f in LaTeX, likewise.
        power: p of the unit of x that f has.
        free: which of the numbers p a refinement may change.
        places: which of these are values of x, which may be zero or negative.
    """

    name: str
    cost: int
    value: Callable[[Floats, Numbers], Floats]
    slope: Callable[[Floats, Numbers], Floats]
    code: Callable[[str, list[str]], str]
    slope_code: Callable[[str, list[str]], str]
    text: Callable[[str, list[str]], str]
    latex: Callable[[str, list[str]], str]
    power: Callable[[Numbers], float] = lambda p: 0.0
    free: tuple[int, ...] = ()
    places: tuple[int, ...] = ()

    @property
    def rank(self) -> int:
        """Order in which equally good functions are shown: smaller is simpler."""
        return {
            "linear": 0,
            "minus": 3,
            "above": 3,
            "below": 3,
            "even": 2,
            "above_power": 3,
            "below_power": 3,
        }.get(self.name, 1)


def _past(x: Floats) -> Floats:
    return np.maximum(x, 1e-12)


def _past_slope(x: str, power: str) -> str:
    return f"{power} * np.maximum({x}, 1e-12) ** ({power} - 1) * ({x} > 0)"


def _times(k: str, x: str) -> str:
    return x if k in ("1", "1.0") else f"{k}·{x}"


def _by(k: str, x: str) -> str:
    return x if k in ("1", "1.0") else f"{k} * {x}"


LINEAR = Shape(
    "linear", 1,
    lambda x, p: x,
    lambda x, p: np.ones_like(x),
    lambda x, p: x,
    lambda x, p: f"np.ones_like({x})",
    lambda x, p: x,
    lambda x, p: x,
    lambda p: 1.0,
)  # fmt: skip
COS = Shape(
    "cos", 1,
    lambda x, p: np.cos(p[0] * x),
    lambda x, p: -p[0] * np.sin(p[0] * x),
    lambda x, p: f"np.cos({_by(p[0], x)})",
    lambda x, p: f"-{p[0]} * np.sin({_by(p[0], x)})",
    lambda x, p: f"cos({_times(p[0], x)})",
    lambda x, p: rf"\cos({_latex_times(p[0], x)})",
)  # fmt: skip
SIN = Shape(
    "sin", 1,
    lambda x, p: np.sin(p[0] * x),
    lambda x, p: p[0] * np.cos(p[0] * x),
    lambda x, p: f"np.sin({_by(p[0], x)})",
    lambda x, p: f"{p[0]} * np.cos({_by(p[0], x)})",
    lambda x, p: f"sin({_times(p[0], x)})",
    lambda x, p: rf"\sin({_latex_times(p[0], x)})",
)  # fmt: skip
FINE_COS, FINE_SIN = replace(COS, cost=3), replace(SIN, cost=3)
"""Of high orders, which are many to choose from."""


def _root(x: Floats, p: Numbers) -> Floats:
    """Return |x|; rounded off at zero by p[1] where the exponent p[0] is below 1.

    A slope without limit at zero would have no equilibrium.
    """
    return np.hypot(x, p[1]) if p[0] < 1 else np.abs(x)


def _root_code(x: str, p: list[str]) -> str:
    return f"np.hypot({x}, {p[1]})" if float(p[0]) < 1 else f"np.abs({x})"


def _even_slope(x: Floats, p: Numbers) -> Floats:
    root = _root(x, p)
    return np.asarray(p[0] * x * np.where(root > 0, root, 1.0) ** (p[0] - 2))


def _even_slope_code(x: str, p: list[str]) -> str:
    root = _root_code(x, p)
    return f"{p[0]} * {x} * np.maximum({root}, 1e-12) ** ({p[0]} - 2)"


def _odd_slope(x: Floats, p: Numbers) -> Floats:
    root = np.maximum(_root(x, p), 1e-12)
    if p[0] >= 1:
        return np.asarray(p[0] * root ** (p[0] - 1))
    return np.asarray(root ** (p[0] - 3) * (p[0] * x**2 + p[1] ** 2))


def _odd_slope_code(x: str, p: list[str]) -> str:
    root = f"np.maximum({_root_code(x, p)}, 1e-12)"
    if float(p[0]) >= 1:
        return f"{p[0]} * {root} ** ({p[0]} - 1)"
    return f"{root} ** ({p[0]} - 3) * ({p[0]} * {x}**2 + {p[1]}**2)"


ODD = Shape(
    "odd", 2,
    lambda x, p: x * _root(x, p) ** (p[0] - 1),
    _odd_slope,
    lambda x, p: f"{x} * {_root_code(x, p)} ** ({p[0]} - 1)",
    _odd_slope_code,
    lambda x, p: f"{x}^3" if p[0] == "3" else f"sign({x})·|{x}|^{p[0]}",
    lambda x, p: (
        f"{x}^3" if p[0] == "3" else rf"\operatorname{{sign}}({x})\,|{x}|^{{{p[0]}}}"
    ),
    lambda p: p[0],
    (0,),
)  # fmt: skip
EVEN = Shape(
    "even", 2,
    lambda x, p: _root(x, p) ** p[0],
    _even_slope,
    lambda x, p: f"{_root_code(x, p)} ** {p[0]}",
    _even_slope_code,
    lambda x, p: {"1": f"|{x}|", "2": f"{x}^2"}.get(p[0], f"|{x}|^{p[0]}"),
    lambda x, p: {"1": f"|{x}|", "2": f"{x}^2"}.get(p[0], f"|{x}|^{{{p[0]}}}"),
    lambda p: p[0],
    (0,),
)  # fmt: skip
POWER = Shape(
    "power", 2,
    lambda x, p: np.maximum(x, 0.0) ** p[0],
    lambda x, p: p[0] * np.maximum(x, 0.0) ** (p[0] - 1),
    lambda x, p: f"np.maximum({x}, 0.0) ** {p[0]}",
    lambda x, p: f"{p[0]} * np.maximum({x}, 0.0) ** ({p[0]} - 1)",
    lambda x, p: f"{x}^{p[0]}",
    lambda x, p: f"{x}^{{{p[0]}}}",
    lambda p: p[0],
    (0,),
)  # fmt: skip
PLUS = Shape(
    "plus", 2,
    lambda x, p: np.maximum(x, 0.0),
    lambda x, p: np.where(x > 0, 1.0, 0.0),
    lambda x, p: f"np.maximum({x}, 0.0)",
    lambda x, p: f"np.where({x} > 0, 1.0, 0.0)",
    lambda x, p: f"max({x}, 0)",
    lambda x, p: rf"\max({x}, 0)",
    lambda p: 1.0,
)  # fmt: skip
MINUS = Shape(
    "minus", 2,
    lambda x, p: np.maximum(-x, 0.0),
    lambda x, p: np.where(x < 0, -1.0, 0.0),
    lambda x, p: f"np.maximum(-{x}, 0.0)",
    lambda x, p: f"np.where({x} < 0, -1.0, 0.0)",
    lambda x, p: f"max(-{x}, 0)",
    lambda x, p: rf"\max(-{x}, 0)",
    lambda p: 1.0,
)  # fmt: skip
ABOVE = Shape(
    "above", 2,
    lambda x, p: np.maximum(x - p[0], 0.0),
    lambda x, p: np.where(x > p[0], 1.0, 0.0),
    lambda x, p: f"np.maximum({x} - {_bracketed(p[0])}, 0.0)",
    lambda x, p: f"np.where({x} > {p[0]}, 1.0, 0.0)",
    lambda x, p: f"max({x} - {_bracketed(p[0])}, 0)",
    lambda x, p: rf"\max({x} - {_bracketed(p[0])}, 0)",
    lambda p: 1.0,
    (0,), (0,),
)  # fmt: skip
BELOW = Shape(
    "below", 2,
    lambda x, p: np.maximum(p[0] - x, 0.0),
    lambda x, p: np.where(x < p[0], -1.0, 0.0),
    lambda x, p: f"np.maximum({p[0]} - {x}, 0.0)",
    lambda x, p: f"np.where({x} < {p[0]}, -1.0, 0.0)",
    lambda x, p: f"max({p[0]} - {x}, 0)",
    lambda x, p: rf"\max({p[0]} - {x}, 0)",
    lambda p: 1.0,
    (0,), (0,),
)  # fmt: skip
ABOVE_POWER = Shape(
    "above_power", 3,
    lambda x, p: np.maximum(x - p[0], 0.0) ** p[1],
    lambda x, p: p[1] * _past(x - p[0]) ** (p[1] - 1) * (x > p[0]),
    lambda x, p: f"np.maximum({x} - {_bracketed(p[0])}, 0.0) ** {p[1]}",
    lambda x, p: _past_slope(f"({x} - {_bracketed(p[0])})", p[1]),
    lambda x, p: f"max({x} - {_bracketed(p[0])}, 0)^{p[1]}",
    lambda x, p: rf"\max({x} - {_bracketed(p[0])}, 0)^{{{p[1]}}}",
    lambda p: p[1],
    (0, 1), (0,),
)  # fmt: skip
BELOW_POWER = Shape(
    "below_power", 3,
    lambda x, p: np.maximum(p[0] - x, 0.0) ** p[1],
    lambda x, p: -p[1] * _past(p[0] - x) ** (p[1] - 1) * (x < p[0]),
    lambda x, p: f"np.maximum({p[0]} - {x}, 0.0) ** {p[1]}",
    lambda x, p: f"-{_past_slope(f'({p[0]} - {x})', p[1])}",
    lambda x, p: f"max({p[0]} - {x}, 0)^{p[1]}",
    lambda x, p: rf"\max({p[0]} - {x}, 0)^{{{p[1]}}}",
    lambda p: p[1],
    (0, 1), (0,),
)  # fmt: skip
SATURATION = Shape(
    "saturation", 2,
    lambda x, p: np.tanh(x / p[0]),
    lambda x, p: (1 - np.tanh(x / p[0]) ** 2) / p[0],
    lambda x, p: f"np.tanh({x} / {p[0]})",
    lambda x, p: f"(1 - np.tanh({x} / {p[0]}) ** 2) / {p[0]}",
    lambda x, p: f"tanh({x}/{p[0]})",
    lambda x, p: rf"\tanh({x}/{p[0]})",
    free=(0,),
)  # fmt: skip
THRESHOLD = Shape(
    "threshold", 2,
    lambda x, p: np.sign(x) * np.maximum(np.abs(x) - p[0], 0.0),
    lambda x, p: np.where(np.abs(x) > p[0], 1.0, 0.0),
    lambda x, p: f"np.sign({x}) * np.maximum(np.abs({x}) - {p[0]}, 0.0)",
    lambda x, p: f"np.where(np.abs({x}) > {p[0]}, 1.0, 0.0)",
    lambda x, p: f"beyond({x}, {p[0]})",
    lambda x, p: rf"\operatorname{{sign}}({x})\max(|{x}| - {p[0]}, 0)",
    lambda p: 1.0,
    (0,),
)  # fmt: skip
LOG = Shape(
    "log", 1,
    lambda x, p: np.log10(1.0 + np.maximum(x, 0.0)),
    lambda x, p: np.where(x > 0, 1.0, 0.0) / np.log(10.0) / (1.0 + np.maximum(x, 0.0)),
    lambda x, p: f"np.log10(1.0 + np.maximum({x}, 0.0))",
    lambda x, p: f"np.where({x} > 0, 1.0, 0.0) / np.log(10.0) / (1.0 + np.maximum({x}, 0.0))",
    lambda x, p: f"log10(1 + {x})",
    lambda x, p: rf"\log_{{10}}(1 + {x})",
)  # fmt: skip
RELAXATION = Shape(
    "relaxation", 2,
    lambda x, p: 1.0 - np.exp(-np.maximum(x, 0.0) / p[0]),
    lambda x, p: np.where(x > 0, 1.0, 0.0) * np.exp(-np.maximum(x, 0.0) / p[0]) / p[0],
    lambda x, p: f"1.0 - np.exp(-np.maximum({x}, 0.0) / {p[0]})",
    lambda x, p: f"np.where({x} > 0, 1.0, 0.0) * np.exp(-np.maximum({x}, 0.0) / {p[0]}) / {p[0]}",
    lambda x, p: f"(1 - exp(-{x}/{p[0]}))",
    lambda x, p: rf"(1 - e^{{-{x}/{p[0]}}})",
    free=(0,),
)  # fmt: skip
STEP = Shape(
    "step", 2,
    lambda x, p: np.tanh((x - p[0]) / p[1]),
    lambda x, p: (1 - np.tanh((x - p[0]) / p[1]) ** 2) / p[1],
    lambda x, p: f"np.tanh(({x} - {p[0]}) / {p[1]})",
    lambda x, p: f"(1 - np.tanh(({x} - {p[0]}) / {p[1]}) ** 2) / {p[1]}",
    lambda x, p: f"tanh(({x} - {p[0]})/{p[1]})",
    lambda x, p: rf"\tanh(({x} - {p[0]})/{p[1]})",
    free=(0, 1),
    places=(0,),
)  # fmt: skip


def _bracketed(x: str) -> str:
    return f"({x})" if x.startswith("-") else x


def _latex_times(k: str, x: str) -> str:
    return x if k in ("1", "1.0") else f"{k} {x}"
