"""The curve of a law over one of its quantities, with the partial residuals of the readings.

A law moves site s by Σ_p θ_p f_p(x) g(·), where x is the quantity and g the product of the other
factors. With T the whitened motion of one reading by a unit motion of the site and r the whitened
residual of the fit with the law, the partial residual of this reading is

    y = Σ_p θ_p f_p(x) + Tᵀ r / (TᵀT g),    std = 1 / (|T| |g|)

Waves of high order are drawn over one period. For an effect from a file, the motion m of a site is
drawn over a quantity x that its formula names, divided by another one g if the formula is a
product: the pair (x, g) with the smoothest m/g over x, by von Neumann's ratio.
"""

import re
from dataclasses import dataclass

import numpy as np

from hilcal.discovery.amplitudes import Amplitude, Variable, variables
from hilcal.discovery.grammar import HARMONICS
from hilcal.discovery.law import Form, LawPart
from hilcal.discovery.sites import ORDINARY, Place, Site, site_motions
from hilcal.effects.force_sensor import sensor_error
from hilcal.effects.protocol import Effect, Situation
from hilcal.identification.fit import Fit
from hilcal.types import Floats, Ints

MOST_CURVES = 3
BINS = 12
LINE_POINTS = 101  # Points of the drawn law; a choice, as are the two above
MOST_POINTS = 2000  # Most readings that are drawn; a choice, by memory
LEAST_DIVISOR = 0.02  # Least size of g, as share of its largest, for a reading to count; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A law over one quantity."""

    site: str  # site of the law, in words
    of: str  # symbol of y: the site's motion divided by the other factors
    unit: str  # of y, SI
    quantity: str  # symbol of the quantity
    quantity_unit: str  # SI; "1" for a number
    x: Floats  # (P,) the quantity at readings
    y: Floats  # (P,) partial residual of each reading
    std: Floats  # (P,) its standard deviation by the noise
    binned: Floats  # (4, B) mean of x, mean of y, its standard deviation, number of readings
    line: Floats  # (2, L) quantity and law


def curves(after: Fit, form: Form) -> tuple[Curve, ...]:
    """Return the curves of a law, the last effect of a fit, most significant parts first."""
    rows = after.model.slices()[-1]
    theta, std = after.theta[rows], after.uncertainty.std[rows]
    ordered = sorted(form.parts, key=lambda p: -abs(theta[p.coefficient]) / std[p.coefficient])
    groups: dict[tuple[Site, str, frozenset[tuple[object, ...]]], list[LawPart]] = {}
    for p in ordered:
        for f in p.amplitude.factors:
            others = frozenset(
                (x.variable.symbol, x.shape.name, x.numbers)
                for x in p.amplitude.factors
                if x.variable.symbol != f.variable.symbol
            )
            groups.setdefault((p.site, f.variable.symbol, others), []).append(p)
    if not groups:
        return ()
    sites, motion = site_motions(after)
    situation = after.solution.prediction.situation
    out = []
    for (site, symbol, _), parts in list(groups.items())[:MOST_CURVES]:
        of_site = motion[:, :, sites.index(site)] / ORDINARY[site.unit]
        out.append(_curve(after, situation, of_site, parts, symbol, theta))
    return tuple(out)


def _curve(
    after: Fit, s: Situation, motion: Floats, parts: list[LawPart], symbol: str, theta: Floats
) -> Curve:
    site, first = parts[0].site, parts[0]
    varying = [(p, f) for p in parts for f in p.amplitude.factors if f.variable.symbol == symbol]
    others = Amplitude(tuple(f for f in first.amplitude.factors if f.variable.symbol != symbol))
    v = varying[0][1].variable
    orders = {f.numbers[0] if f.shape.name in ("cos", "sin") else 0.0 for _, f in varying}
    order = orders.pop() if len(orders) == 1 else 0.0
    x, divisor = _folded(v.read(s), order), others.values(s)

    def law(x: Floats) -> Floats:
        terms = [theta[p.coefficient] * f.shape.value(x, f.numbers) for p, f in varying]
        return np.asarray(np.sum(terms, axis=0))

    deviation, std = partial_residuals(after, motion)
    drawn = _points(_usable(std, divisor))
    x, divisor = x[drawn], divisor[drawn]
    y, std = law(x) + deviation[drawn] / divisor, std[drawn] / np.abs(divisor)
    ends = np.linspace(float(x.min()), float(x.max()), LINE_POINTS)
    ordinate, unit = site.symbol, site.unit
    if others.factors:
        inner, divided = others.text(), others.unit()
        ordinate = f"{ordinate}/({inner})" if "·" in inner else f"{ordinate}/{inner}"
        unit = unit if divided == "1" else f"{unit}/({divided})"
    return _over(site, ordinate, unit, v, order, x, y, std, np.vstack([ends, law(ends)]))


def _usable(std: Floats, divisor: Floats) -> Ints:
    """Indices of the readings that determine the motion over the other factors."""
    size = np.abs(divisor)
    return np.flatnonzero(np.isfinite(std) & (size > LEAST_DIVISOR * float(size.max())))


def _points(usable: Ints) -> Ints:
    """Return which of the usable readings are drawn: all, or some at random."""
    if len(usable) <= MOST_POINTS:
        return usable
    return np.random.default_rng(20261122).choice(usable, MOST_POINTS, replace=False)


def _over(
    site: Site, ordinate: str, unit: str, v: Variable, order: float, x: Floats, y: Floats,
    std: Floats, line: Floats,
) -> Curve:  # fmt: skip
    """Return a curve over a quantity, or over one period for a wave of high order."""
    name = f"{v.symbol} within a period of 2π/{order:g}" if order > HARMONICS else v.symbol
    return Curve(site.words, ordinate, unit, name, v.unit, x, y, std, binned(x, y, std), line)


def partial_residuals(after: Fit, motion: Floats) -> tuple[Floats, Floats]:
    """Partial residual (N,) of each reading, as motion of the site, and its std."""
    w, white = after.whitening, after.white
    partial, square = np.zeros(len(motion)), np.zeros(len(motion))
    for start in range(0, len(motion), 200):
        part = np.arange(start, min(start + 200, len(motion)))
        spread = np.zeros((*motion.shape, len(part)))
        spread[part, :, part - start] = motion[part]
        t = w.whiten_readings(spread)
        partial[part], square[part] = t.T @ white, np.sum(t**2, axis=0)
    visible = square > 0
    safe = np.where(visible, square, 1.0)
    return partial / safe, np.where(visible, 1.0 / np.sqrt(safe), np.inf)


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


MOST_SITES = 2  # Sites of a law that are drawn, those with the largest motion; a choice
MOST_ROUGHNESS = 0.05
"""Von Neumann's ratio below which a law is drawn as line, not binned; a choice."""

Axes = tuple[Variable, Variable | None]  # Quantity of the abscissa, and divisor of the ordinate


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLaw:
    """An effect of a file in a fitted model."""

    name: str
    formula: str  # summary of the effect; for a proposed law its formula
    acts_on: tuple[str, ...]  # its sites, in words
    curves: tuple[Curve, ...]  # over recorded quantities


def drawn_laws(fit: Fit) -> tuple[DrawnLaw, ...]:
    """Return the effects of a fit that are from files, with their curves."""
    files = fit.model.catalogue.files
    names = {e.name for f in files for e in f.effects}
    indices = [k for k, e in enumerate(fit.model.effects) if e.name in names]
    if not indices:
        return ()
    sites, unit = site_motions(fit)
    return tuple(_drawn(fit, k, sites, unit) for k in indices)


def _drawn(fit: Fit, index: int, sites: tuple[Site, ...], unit: Floats) -> DrawnLaw:
    effect, theta = fit.model.effects[index], fit.theta[fit.model.slices()[index]]
    motion = _motions(effect, theta, fit, sites)
    size = {k: float(np.sqrt(np.mean((unit[:, :, k] / ORDINARY[sites[k].unit] * m[:, None]) ** 2)))
            for k, m in motion.items()}  # fmt: skip
    order = sorted(motion, key=lambda k: -size[k])
    quantities = variables(fit.solution.prediction.situation)
    named = [v for v in quantities if _named(v, effect.summary)]
    axes: list[Axes] = [(v, None) for v in named or quantities]
    axes += [(v, g) for v in named for g in named if g is not v]
    curves = tuple(
        _drawn_curve(
            fit, sites[k], unit[:, :, k] / ORDINARY[sites[k].unit], motion[k], axes, effect
        )
        for k in order[:MOST_SITES]
        if axes and size[k] > 0
    )
    return DrawnLaw(effect.name, effect.summary, tuple(sites[k].words for k in order), curves)


def _motions(effect: Effect, theta: Floats, fit: Fit, sites: tuple[Site, ...]) -> dict[int, Floats]:
    """Motions (N,) by the effect, by index of the site."""
    s = fit.solution.prediction.situation
    place: dict[tuple[Place, int, int], int] = {
        (x.field, x.element, x.axis): k for k, x in enumerate(sites)
    }
    out: dict[int, Floats] = {}
    for c in effect.columns(s):
        for k, (p, element) in enumerate(zip(c.parameter, c.element, strict=True)):
            flat = c.field in ("dq", "scale")
            values = c.values[:, k, None] if flat else c.values[:, k]
            for axis in range(values.shape[1]):
                site = place.get((c.field, 0 if c.field == "scale" else int(element), axis))
                if site is not None and np.any(values[:, axis]):
                    motion = np.broadcast_to(theta[p] * values[:, axis], len(s.angle))
                    out[site] = out.get(site, np.zeros(len(s.angle))) + motion
    change = effect.wrench_change(theta, s)
    if change is not None:
        error = sensor_error(s, change)
        out |= {place["sensor", 0, c]: error[:, c] for c in range(6) if np.any(error[:, c])}
    return out


def _named(v: Variable, formula: str) -> bool:
    """Whether a formula names a quantity: q_3 is not in dq_3, nor in q_31."""
    return re.search(rf"(?<![^\W_]){re.escape(v.symbol)}(?!\w)", formula) is not None


def _drawn_curve(
    fit: Fit, site: Site, motion: Floats, law: Floats, axes: list[Axes], effect: Effect
) -> Curve:
    s = fit.solution.prediction.situation
    partial, std = partial_residuals(fit, motion)
    candidates: list[tuple[float, int, Variable, Variable | None, Floats, Ints, Floats]] = []
    for v, g in axes:
        divisor = np.ones(len(law)) if g is None else g.read(s)
        usable = _usable(std, divisor)
        x = _folded(v.read(s), _order(v, effect.summary))
        roughness = _roughness(x[usable], law[usable] / divisor[usable])
        candidates.append((roughness, len(candidates), v, g, divisor, usable, x))
    roughness, _, v, g, divisor, usable, x = min(
        candidates, key=lambda t: (t[0] > MOST_ROUGHNESS, t[:2])
    )
    drawn = _points(usable)
    x, law_values = x[drawn], law[drawn] / divisor[drawn]
    y, error = law_values + partial[drawn] / divisor[drawn], std[drawn] / np.abs(divisor[drawn])
    line = _line(x, law_values) if roughness <= MOST_ROUGHNESS else binned(x, law_values, error)[:2]
    ordinate, unit = site.symbol, site.unit
    if g is not None:
        ordinate, unit = f"{ordinate}/{g.symbol}", unit if g.unit == "1" else f"{unit}/({g.unit})"
    return _over(site, ordinate, unit, v, _order(v, effect.summary), x, y, error, line)


def _line(x: Floats, y: Floats) -> Floats:
    """(2, L) law at some points (K,), interpolated without overshooting."""
    from scipy.interpolate import PchipInterpolator  # slow to import

    points, index = np.unique(x, return_inverse=True)
    if len(points) < 2:
        return np.vstack([x[:1], y[:1]])
    mean = np.bincount(index, y) / np.bincount(index)
    ends = np.linspace(points[0], points[-1], LINE_POINTS)
    return np.vstack([ends, PchipInterpolator(points, mean)(ends)])


def _order(v: Variable, formula: str) -> float:
    """Largest multiple of an angle in a formula; 0 for none."""
    orders = re.findall(rf"([\d.]+)·{re.escape(v.symbol)}(?!\w)", formula)
    return max((float(k) for k in orders), default=0.0)


def _folded(x: Floats, order: float) -> Floats:
    """Return x within one period for a wave of high order."""
    if order <= HARMONICS:
        return x
    period = 2 * np.pi / order
    return np.asarray(np.mod(x + period / 2, period) - period / 2)


def _roughness(x: Floats, y: Floats) -> float:
    """Mean square of successive differences over twice the variance: 0 for a smooth function."""
    spread = float(np.var(y)) if len(y) > 2 else 0.0
    if spread <= 0:
        return 0.0
    steps = np.diff(y[np.argsort(x, kind="stable")])
    return float(np.mean(steps**2) / (2 * spread))
