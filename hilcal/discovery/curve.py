"""The curve of a law over a quantity that it depends on, with what the readings say beside it.

A law moves site s by Σ_p θ_p f_p(x) g(·), where x is the quantity and g the product of the other
factors. With T the whitened motion of one reading by a unit motion of the site and r the whitened
residual of the fit with the law, that reading alone would have

    y = Σ_p θ_p f_p(x) + Tᵀ r / (TᵀT g),    std = 1 / (|T| |g|)

(a partial residual). Waves of high order are drawn over one period.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.discovery.functions import HARMONICS
from hilcal.discovery.law import Form, LawPart
from hilcal.discovery.sites import ORDINARY, Site, site_motions
from hilcal.effects.protocol import Situation
from hilcal.identification.fit import Fit
from hilcal.types import Floats

MOST_CURVES = 3
BINS = 12
LINE = 101  # Points of the drawn law; a choice, as the two above
MOST_POINTS = 2000  # Readings that are drawn at most; a choice, by memory
LEAST = 0.02
"""Readings whose other factors are a smaller share of the largest say nothing of the curve; a
choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A law over one quantity."""

    site: str  # where it acts
    of: str  # symbol of what is drawn: the site's motion, over the other factors
    unit: str  # of it, SI
    quantity: str  # symbol of the quantity
    quantity_unit: str  # SI; "1" for a number
    x: Floats  # (P,) the quantity at readings
    y: Floats  # (P,) what each reading by itself says
    std: Floats  # (P,) its standard deviation by the noise
    binned: Floats  # (4, B) mean of x, mean of y, its standard deviation, number of readings
    line: Floats  # (2, L) quantity and law


def curves(after: Fit, form: Form, most: int = MOST_CURVES) -> tuple[Curve, ...]:
    """Return the curves of a law, those of its surest parts first.

    after: a fit whose last effect is the law.
    """
    rows = after.model.slices()[-1]
    theta, std = after.theta[rows], after.uncertainty.std[rows]
    sure = sorted(form.parts, key=lambda p: -abs(theta[p.coefficient]) / std[p.coefficient])
    groups: dict[tuple[Site, str, frozenset[tuple[object, ...]]], list[LawPart]] = {}
    for p in sure:
        for f in p.amplitude.factors:
            others = frozenset(_key(p, f.variable.symbol))
            groups.setdefault((p.site, f.variable.symbol, others), []).append(p)
    if not groups:
        return ()
    sites, motion = site_motions(after)
    situation = after.solution.prediction.situation
    out = []
    for (site, symbol, _), parts in list(groups.items())[:most]:
        own = motion[:, :, sites.index(site)] / ORDINARY[site.unit]
        out.append(_curve(after, situation, own, parts, symbol, theta))
    return tuple(out)


def _key(p: LawPart, symbol: str) -> list[tuple[object, ...]]:
    """Return the other factors of a part."""
    return [
        (f.variable.symbol, f.shape.name, f.numbers)
        for f in p.amplitude.factors
        if f.variable.symbol != symbol
    ]


def _curve(
    after: Fit, s: Situation, motion: Floats, parts: list[LawPart], symbol: str, theta: Floats
) -> Curve:
    site, first = parts[0].site, parts[0]
    own = [(p, f) for p in parts for f in p.amplitude.factors if f.variable.symbol == symbol]
    others = [f for f in first.amplitude.factors if f.variable.symbol != symbol]
    v = own[0][1].variable
    x = v.read(s)
    other = np.prod([f.values(s) for f in others], axis=0) if others else np.ones(len(x))
    orders = {f.numbers[0] if f.shape.name in ("cos", "sin") else 0.0 for _, f in own}
    order = orders.pop() if len(orders) == 1 else 0.0
    name = symbol
    if order > HARMONICS:
        period = 2 * np.pi / order
        x = np.mod(x + period / 2, period) - period / 2
        name = f"{symbol} within a period of 2π/{order:g}"

    def law(at: Floats) -> Floats:
        told = [theta[p.coefficient] * f.shape.value(at, f.numbers) for p, f in own]
        return np.asarray(np.sum(told, axis=0))

    said, std = said_by_readings(after, motion)
    size = np.abs(other)
    kept = np.flatnonzero(np.isfinite(std) & (size > LEAST * float(size.max())))
    if len(kept) > MOST_POINTS:
        kept = np.random.default_rng(20261122).choice(kept, MOST_POINTS, replace=False)
    x, y = x[kept], law(x[kept]) + said[kept] / other[kept]
    std = std[kept] / size[kept]
    ends = np.linspace(float(x.min()), float(x.max()), LINE)
    inner = "·".join(f.shape.text(f.variable.symbol, [f"{n:g}" for n in f.numbers]) for f in others)
    unit = site.unit
    if others:
        divided = type(first.amplitude)(tuple(others)).unit()
        unit = unit if divided == "1" else f"{unit}/({divided})"
    return Curve(
        site.words, _over(site.symbol, inner), unit, name, v.unit,
        x, y, std, binned(x, y, std), np.vstack([ends, law(ends)]),
    )  # fmt: skip


def _over(symbol: str, inner: str) -> str:
    if not inner:
        return symbol
    return f"{symbol}/({inner})" if "·" in inner else f"{symbol}/{inner}"


def said_by_readings(after: Fit, motion: Floats) -> tuple[Floats, Floats]:
    """What the residual of each reading says of the site's motion (N,), and its std."""
    w, white = after.whitening, after.white
    said, square = np.zeros(len(motion)), np.zeros(len(motion))
    for start in range(0, len(motion), 200):
        some = np.arange(start, min(start + 200, len(motion)))
        spread = np.zeros((*motion.shape, len(some)))
        spread[some, :, some - start] = motion[some]
        t = w.whiten_readings(spread)
        said[some], square[some] = t.T @ white, np.sum(t**2, axis=0)
    seen = square > 0
    safe = np.where(seen, square, 1.0)
    return said / safe, np.where(seen, 1.0 / np.sqrt(safe), np.inf)


def binned(x: Floats, y: Floats, std: Floats) -> Floats:
    """(4, B) weighted means in bins of equally many readings."""
    out = []
    order = np.argsort(x, kind="stable")
    for part in np.array_split(order, min(BINS, len(x))):
        weight = 1.0 / std[part] ** 2
        total = float(weight.sum())
        mean = float(weight @ y[part]) / total
        out.append((float(weight @ x[part]) / total, mean, total**-0.5, float(len(part))))
    return np.array(out).T
