"""The curve of a law over a quantity that it depends on, with what the readings say beside it.

A law moves site s by Σ_p θ_p f_p(x) g(·), where x is the quantity and g the product of the other
factors. With T the whitened motion of one reading by a unit motion of the site and r the whitened
residual of the fit with the law, that reading alone would have

    y = Σ_p θ_p f_p(x) + Tᵀ r / (TᵀT g),    std = 1 / (|T| |g|)

(a partial residual). Waves of high order are drawn over one period.

Of an effect of a file, as `discover` or a user wrote it, the motion m of a site is drawn over a
quantity x that its formula names, divided by another one g where the formula is a product: of all
such pairs that in which m/g follows x most smoothly (von Neumann's ratio).
"""

import re
from dataclasses import dataclass

import numpy as np

from hilcal.discovery.amplitudes import Variable, variables
from hilcal.discovery.grammar import HARMONICS
from hilcal.discovery.law import Form, LawPart
from hilcal.discovery.sites import ORDINARY, Place, Site, site_motions
from hilcal.effects.force_sensor import sensor_error
from hilcal.effects.protocol import Effect, Situation
from hilcal.identification.fit import Fit
from hilcal.types import Bools, Floats, Ints

MOST_CURVES = 3
BINS = 12
LINE = 101  # Points of the drawn law; a choice, as the two above
MOST_POINTS = 2000  # Readings that are drawn at most; a choice, by memory
LEAST = 0.02  # share of the largest of the other factors below which nothing is said; a choice


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
    """Return the curves of a law, the last effect of a fit, those of its surest parts first."""
    rows = after.model.slices()[-1]
    theta, std = after.theta[rows], after.uncertainty.std[rows]
    sure = sorted(form.parts, key=lambda p: -abs(theta[p.coefficient]) / std[p.coefficient])
    groups: dict[tuple[Site, str, frozenset[tuple[object, ...]]], list[LawPart]] = {}
    for p in sure:
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
    for (site, symbol, _), parts in list(groups.items())[:most]:
        own = motion[:, :, sites.index(site)] / ORDINARY[site.unit]
        out.append(_curve(after, situation, own, parts, symbol, theta))
    return tuple(out)


def _curve(
    after: Fit, s: Situation, motion: Floats, parts: list[LawPart], symbol: str, theta: Floats
) -> Curve:
    site, first = parts[0].site, parts[0]
    own = [(p, f) for p in parts for f in p.amplitude.factors if f.variable.symbol == symbol]
    others = [f for f in first.amplitude.factors if f.variable.symbol != symbol]
    v = own[0][1].variable
    orders = {f.numbers[0] if f.shape.name in ("cos", "sin") else 0.0 for _, f in own}
    order = orders.pop() if len(orders) == 1 else 0.0
    x = _folded(v.read(s), order)
    other = np.prod([f.values(s) for f in others], axis=0) if others else np.ones(len(x))

    def law(at: Floats) -> Floats:
        terms = [theta[p.coefficient] * f.shape.value(at, f.numbers) for p, f in own]
        return np.asarray(np.sum(terms, axis=0))

    said, std = said_by_readings(after, motion)
    at = _points(_sayable(std, other))
    x, y, std = x[at], law(x[at]) + said[at] / other[at], std[at] / np.abs(other[at])
    ends = np.linspace(float(x.min()), float(x.max()), LINE)
    inner = "·".join(f.shape.text(f.variable.symbol, [f"{n:g}" for n in f.numbers]) for f in others)
    of, unit = site.symbol, site.unit
    if others:
        of = f"{of}/({inner})" if "·" in inner else f"{of}/{inner}"
        divided = type(first.amplitude)(tuple(others)).unit()
        unit = unit if divided == "1" else f"{unit}/({divided})"
    return _over(site, of, unit, v, order, x, y, std, np.vstack([ends, law(ends)]))


def _sayable(std: Floats, divisor: Floats) -> Bools:
    """(N,) which readings say something of a motion that is divided by the other factors."""
    size = np.abs(divisor)
    return np.asarray(np.isfinite(std) & (size > LEAST * float(size.max())))


def _points(kept: Bools) -> Ints:
    """Return which readings are drawn: all of those kept, or some at random."""
    at = np.flatnonzero(kept)
    if len(at) <= MOST_POINTS:
        return at
    return np.random.default_rng(20261122).choice(at, MOST_POINTS, replace=False)


def _over(
    site: Site, of: str, unit: str, v: Variable, order: float, x: Floats, y: Floats, std: Floats,
    line: Floats,
) -> Curve:  # fmt: skip
    """Return a curve over a quantity, within a period of a wave of high order."""
    name = f"{v.symbol} within a period of 2π/{order:g}" if order > HARMONICS else v.symbol
    return Curve(site.words, of, unit, name, v.unit, x, y, std, binned(x, y, std), line)


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


MOST_SITES = 2  # Sites of a law that are drawn, those that it moves most; a choice
SMOOTH = 0.05  # von Neumann's ratio below which the law is a line, else means in bins; a choice

Way = tuple[Variable, Variable | None]  # What a law is drawn over, and what it is divided by


@dataclass(frozen=True, slots=True, eq=False)
class DrawnLaw:
    """An effect of a file in a fitted model."""

    name: str
    formula: str  # its summary; that of a proposed law is its formula
    acts_on: tuple[str, ...]  # where it acts, in words
    curves: tuple[Curve, ...]  # over what it depends on, where a site moves with something recorded


def drawn_laws(fit: Fit) -> tuple[DrawnLaw, ...]:
    """Return the effects of a fit that are from files, each with its curves."""
    files = fit.model.catalogue.files
    own = {e.name for f in files for e in f.effects}
    mine = [k for k, e in enumerate(fit.model.effects) if e.name in own]
    if not mine:
        return ()
    sites, unit = site_motions(fit)
    return tuple(_drawn(fit, k, sites, unit) for k in mine)


def _drawn(fit: Fit, index: int, sites: tuple[Site, ...], unit: Floats) -> DrawnLaw:
    effect, theta = fit.model.effects[index], fit.theta[fit.model.slices()[index]]
    moved = _motions(effect, theta, fit, sites)
    size = {k: float(np.sqrt(np.mean((unit[:, :, k] / ORDINARY[sites[k].unit] * m[:, None]) ** 2)))
            for k, m in moved.items()}  # fmt: skip
    order = sorted(moved, key=lambda k: -size[k])
    found = variables(fit.solution.prediction.situation)
    named = [v for v in found if _named(v, effect.summary)]
    ways: list[Way] = [(v, None) for v in named or found]
    ways += [(v, g) for v in named for g in named if g is not v]
    curves = tuple(
        _drawn_curve(fit, sites[k], unit[:, :, k] / ORDINARY[sites[k].unit], moved[k], ways, effect)
        for k in order[:MOST_SITES]
        if ways and size[k] > 0
    )
    return DrawnLaw(effect.name, effect.summary, tuple(sites[k].words for k in order), curves)


def _motions(effect: Effect, theta: Floats, fit: Fit, sites: tuple[Site, ...]) -> dict[int, Floats]:
    """Motion (N,) of each site, by its index, by the effect."""
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
                at = place.get((c.field, 0 if c.field == "scale" else int(element), axis))
                if at is not None and np.any(values[:, axis]):
                    now = np.broadcast_to(theta[p] * values[:, axis], len(s.angle))
                    out[at] = out.get(at, np.zeros(len(s.angle))) + now
    change = effect.wrench_change(theta, s)
    if change is not None:
        error = sensor_error(s, change)
        out |= {place["sensor", 0, c]: error[:, c] for c in range(6) if np.any(error[:, c])}
    return out


def _named(v: Variable, formula: str) -> bool:
    """Whether a formula names a quantity: q_3 is not in dq_3, nor in q_31."""
    return re.search(rf"(?<![^\W_]){re.escape(v.symbol)}(?!\w)", formula) is not None


def _drawn_curve(
    fit: Fit, site: Site, motion: Floats, law: Floats, ways: list[Way], effect: Effect
) -> Curve:
    s = fit.solution.prediction.situation
    said, std = said_by_readings(fit, motion)
    tried: list[tuple[float, int, Variable, Variable | None, Floats, Bools, Floats]] = []
    for v, g in ways:
        divisor = np.ones(len(law)) if g is None else g.read(s)
        kept = _sayable(std, divisor)
        x = _folded(v.read(s), _order(v, effect.summary))
        rough = _roughness(x[kept], law[kept] / divisor[kept])
        tried.append((rough, len(tried), v, g, divisor, kept, x))
    rough, _, v, g, divisor, kept, x = min(tried, key=lambda t: (t[0] > SMOOTH, t[:2]))
    at = _points(kept)
    x, known = x[at], law[at] / divisor[at]
    y, error = known + said[at] / divisor[at], std[at] / np.abs(divisor[at])
    line = _line(x, known) if rough <= SMOOTH else binned(x, known, error)[:2]
    of, unit = site.symbol, site.unit
    if g is not None:
        of, unit = f"{of}/{g.symbol}", unit if g.unit == "1" else f"{unit}/({g.unit})"
    return _over(site, of, unit, v, _order(v, effect.summary), x, y, error, line)


def _line(x: Floats, y: Floats) -> Floats:
    """(2, L) a law that is known at some places (K,), interpolated without overshooting."""
    from scipy.interpolate import PchipInterpolator  # slow to import

    places, which = np.unique(x, return_inverse=True)
    if len(places) < 2:
        return np.vstack([x[:1], y[:1]])
    mean = np.bincount(which, y) / np.bincount(which)
    ends = np.linspace(places[0], places[-1], LINE)
    return np.vstack([ends, PchipInterpolator(places, mean)(ends)])


def _order(v: Variable, formula: str) -> float:
    """The multiple of an angle that a formula has, largest if several; 0 for none."""
    found = re.findall(rf"([\d.]+)·{re.escape(v.symbol)}(?!\w)", formula)
    return max((float(k) for k in found), default=0.0)


def _folded(x: Floats, order: float) -> Floats:
    """Waves of high order are drawn over one period."""
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
