"""What an effect of a file does over what its formula depends on, beside the readings.

A law that `discover` wrote, or a user, is a class: where it acts, and the value that it has at each
reading. The motion of a site by it, m = Σ_p θ_p f_p, is drawn over a quantity x that its formula
names, divided by another one g where the formula is a product: of all such pairs that in which m/g
follows x most smoothly (von Neumann's ratio of successive differences). Beside it is what each
reading says by itself, as in `curve`.
"""

import re
from dataclasses import dataclass

import numpy as np

from hilcal.discovery.curve import LEAST, LINE, MOST_POINTS, Curve, binned, said_by_readings
from hilcal.discovery.functions import HARMONICS
from hilcal.discovery.sites import ORDINARY, Place, Site, site_motions
from hilcal.discovery.variables import Variable, variables
from hilcal.effects.force_sensor import sensor_error
from hilcal.effects.protocol import Effect
from hilcal.identification.fit import Fit
from hilcal.types import Bools, Floats

MOST_SITES = 2  # Sites of a law that are drawn, those that it moves most; a choice
SMOOTH = 0.05
"""Von Neumann's ratio below which the law is drawn as a line, above as means in bins; a choice."""

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
        _curve(fit, sites[k], unit[:, :, k] / ORDINARY[sites[k].unit], moved[k], ways, effect)
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


def _curve(
    fit: Fit, site: Site, motion: Floats, law: Floats, ways: list[Way], effect: Effect
) -> Curve:
    s = fit.solution.prediction.situation
    said, std = said_by_readings(fit, motion)
    seen = np.isfinite(std)
    tried: list[tuple[float, int, Variable, Variable | None, Floats, Bools, Floats]] = []
    for v, g in ways:
        divisor = np.ones(len(law)) if g is None else g.read(s)
        kept = seen & (np.abs(divisor) > LEAST * float(np.abs(divisor).max()))
        x = _folded(v.read(s), _order(v, effect.summary))
        rough = _roughness(x[kept], law[kept] / divisor[kept])
        tried.append((rough, len(tried), v, g, divisor, kept, x))
    rough, _, v, g, divisor, kept, x = min(tried, key=lambda t: (t[0] > SMOOTH, t[:2]))
    at = np.flatnonzero(kept)
    if len(at) > MOST_POINTS:
        at = np.random.default_rng(20261122).choice(at, MOST_POINTS, replace=False)
    x, told = x[at], law[at] / divisor[at]
    y, error = told + said[at] / divisor[at], std[at] / np.abs(divisor[at])
    line = _line(x, told) if rough <= SMOOTH else binned(x, told, error)[:2]
    period = _order(v, effect.summary)
    name = f"{v.symbol} within a period of 2π/{period:g}" if period > HARMONICS else v.symbol
    of, unit = site.symbol, site.unit
    if g is not None:
        of, unit = f"{of}/{g.symbol}", unit if g.unit == "1" else f"{unit}/({g.unit})"
    return Curve(
        site.words, of, unit, name, v.unit, x, y, error, binned(x, y, error), line,
    )  # fmt: skip


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
