"""The functions of one quantity that are tried, with starting values of their numbers."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from hilcal.discovery import shapes
from hilcal.discovery.amplitudes import Factor
from hilcal.discovery.variables import Variable
from hilcal.types import Floats

HARMONICS = 4  # Multiples of an angle; as in the diagnosis
FINEST = 512
"""Highest multiple of a joint's angle, as of encoders and gears; a choice. Not more than there are
poses: each order costs the search, and few poses do not tell hundreds of them apart."""


def fine_waves(v: Variable, finest: int) -> list[Factor]:
    """Return waves of an angle beyond `HARMONICS`; as complex as a product, so in none."""
    return [
        Factor(v, f, (float(k),))
        for k in range(HARMONICS + 1, finest + 1)
        for f in (shapes.FINE_COS, shapes.FINE_SIN)
    ]


def functions(v: Variable, x: Floats, most: int) -> list[Factor]:
    """Return the functions of one quantity, with starting values of their numbers.

    x: (N,) it at the readings; most: complexity of a product; functions that are to be in none have
    it.
    """
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
    return [linear, *_CURVED[v.kind](v, x), *_bent(v, x, most)]


WAVES = {"angle": HARMONICS, "sum": 2, "sight": 2}
"""Multiples of an angle, by the kind of quantity; a choice."""
BENDS = (0.3, 0.7)
"""Shares of the readings below a bend to begin with; a refinement moves it. A choice."""
_Made = Callable[[Variable, Floats], list[Factor]]


def _bent(v: Variable, x: Floats, most: int) -> list[Factor]:
    """Return functions that are zero up to some value, by either side, and symmetric ones."""
    alone = v.kind in (
        "force",
        "load",
        "sensor",
        "place",
    )  # many, and rarely with a bend: in no product
    made = [
        Factor(v, replace(f, cost=most) if alone else f, (_round(at),))
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
