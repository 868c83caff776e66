"""Where the stated covariance is wrong: an axis of the instrument, a joint, a load.

A direction d_k of each reading k (along the beam, the motion by joint j, all elements of the
readings under one load) scatters more or less than stated. With g_k the derivative of ½‖y‖² by
reading k, y the contrasts of repeats,

    T = Σ_k ‖d_kᵀ g_k‖²,     score statistic T / ‖y‖²

which does not depend on a common factor. Its null distribution, and that of T for the factor
in this direction T / E[T], come from simulated contrasts, the same for all directions.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.stats import chi2

from hilcal.diagnosis.repeats import Contrasts
from hilcal.identification.fit import Fit
from hilcal.types import Floats

Kind = Literal["axis", "joint", "load"]
DRAWS = 600
MOST = 1 << 22
"""Numbers that are drawn at a time, 32 MB; a choice."""
CERTAIN = 0.003
"""Chance of naming any direction where the factor is the same in all of them."""
FEWEST = 8.0
"""Degrees of freedom that a direction must have to be judged."""


@dataclass(frozen=True, slots=True)
class NoiseWhere:
    """A direction in which the noise is not as stated.

    Attributes:
        kind: "axis" of the instrument, motion by a "joint", or "load".
        name: e.g. "along the beam", "joint 2", "10kg".
        factor: variance factor in this direction, against the stated covariance.
        interval: its 95 % confidence interval.
        p_value: that this direction differs from the others by chance, all directions counted.
    """

    kind: Kind
    name: str
    factor: float
    interval: tuple[float, float]
    p_value: float


def noise_where(fit: Fit, c: Contrasts) -> NoiseWhere | None:
    """Return the direction that stands out most, None where none does."""
    found = [v for v in every_direction(fit, c) if v.p_value < CERTAIN and _agrees(v, c)]
    return min(found, key=lambda v: v.p_value, default=None)


def every_direction(fit: Fit, c: Contrasts) -> tuple[NoiseWhere, ...]:
    """Judge all directions; p-values count all of them."""
    directions = _directions(fit, c)
    rng = np.random.default_rng(20250301)
    rows = [np.flatnonzero(np.any(d != 0, axis=(1, 2))) for _, _, d in directions]
    square, size = np.zeros(1 + DRAWS), np.zeros((len(directions), 1 + DRAWS))
    at_once = max(MOST // len(c.y), 1)
    for start in range(0, 1 + DRAWS, at_once):
        some = slice(start, min(start + at_once, 1 + DRAWS))
        drawn = c.free(rng.standard_normal((len(c.y), some.stop - some.start)))
        if start == 0:
            drawn[:, 0] = c.y
        square[some], slopes = np.sum(drawn**2, axis=0), c.slopes(drawn)
        for k, (_, _, d) in enumerate(directions):
            along = np.einsum("kir,kis->krs", d[rows[k]], slopes[rows[k]])
            size[k, some] = np.sum(along**2, axis=(0, 1))
    out: list[tuple[Kind, str, float, float, float]] = []
    for (kind, name, _), t in zip(directions, size, strict=True):
        mean, spread = float(t[1:].mean()), float(t[1:].std())
        if mean <= 0 or 2 * (mean / spread) ** 2 < FEWEST:
            continue
        out.append(
            (kind, name, float(t[0]) / mean / c.bias, 2 * (mean / spread) ** 2, _p(t / square))
        )
    return tuple(
        NoiseWhere(kind, name, factor, _interval(factor, dof), min(p * len(out), 1.0))
        for kind, name, factor, dof, p in out
    )


def _agrees(v: NoiseWhere, c: Contrasts) -> bool:
    """Whether the direction itself is off, not only the others about it."""
    overall = float(c.y @ c.y) / c.dof / c.bias
    away = abs(np.log(max(v.factor, 1e-300)))
    return bool((v.factor > overall) == (v.factor > 1) and away > abs(np.log(max(overall, 1e-300))))


def _p(ratio: Floats) -> float:
    """Two-sided p-value of the first of these ratios among the drawn others.

    The cube root of a sum of squares is nearly normal (Wilson and Hilferty, Proc. Natl. Acad.
    Sci. 17 (1931) 684-688); what skewness is left is taken from the draws.
    """
    root = np.cbrt(ratio)
    mean, spread = float(root[1:].mean()), float(root[1:].std())
    if spread <= 1e-9 * mean:
        return 1.0
    skew = float(np.mean(((root[1:] - mean) / spread) ** 3))
    z = (float(root[0]) - mean) / spread
    from scipy.stats import pearson3  # slow to import

    return float(min(2 * min(pearson3.sf(z, skew), pearson3.cdf(z, skew)), 1.0))


def _interval(factor: float, dof: float) -> tuple[float, float]:
    return float(factor * dof / chi2.isf(0.025, dof)), float(factor * dof / chi2.ppf(0.025, dof))


def _directions(fit: Fit, c: Contrasts) -> list[tuple[Kind, str, Floats]]:
    """Kind, name and (N, m, r) directions of each reading."""
    readings, m = c.readings, c.whitening.m
    v = readings.covariance
    out: list[tuple[Kind, str, Floats]] = []
    for name, unit in _axes(fit):
        d = np.zeros((len(readings), m, 1))
        d[:, :3, 0] = unit * np.sqrt(np.einsum("ki,kij,kj->k", unit, v[:, :3, :3], unit))[:, None]
        out.append(("axis", name, d))
    values, vectors = np.linalg.eigh(v)
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    if m == 6:
        turned = np.zeros_like(root)
        turned[:, 3:] = root[:, 3:]
        out.append(("axis", "orientation", turned))
    out += [("joint", f"joint {j + 1}", c.moves[:, :, [j]]) for j in range(c.moves.shape[2])]
    loads = np.unique(readings.load)
    if len(loads) > 1:
        for load in loads:
            name = readings.load_names[load]
            mine = (readings.load == load)[:, None, None]
            out.append(("load", "unloaded" if name == "none" else name, root * mine))
        if len(loads) > 2 and readings.unloaded.any():
            out.append(("load", "any load", root * ~readings.unloaded[:, None, None]))
    return out


def _axes(fit: Fit) -> list[tuple[str, Floats]]:
    """Axes (N, 3) of the instrument: of the beam where the station is the sensor's origin."""
    cell, o = fit.model.cell, fit.solution.prediction.observation
    count = len(o.position)
    if cell.registration_known and np.array_equal(cell.registration, np.eye(4)):
        each = np.eye(3)
        return [(f"sensor {n}", np.tile(each[i], (count, 1))) for i, n in enumerate("xyz")]
    beam = o.position / np.maximum(np.linalg.norm(o.position, axis=1), 1e-300)[:, None]
    gravity = cell.gravity if np.any(cell.gravity) else np.array([0.0, 0.0, -1.0])
    up = -np.einsum("kij,j->ki", o.axes, gravity)
    level = np.cross(up, beam)
    size = np.linalg.norm(level, axis=1)
    flat = size > 1e-6 * np.linalg.norm(up, axis=1)
    level = np.where(flat[:, None], level / np.where(flat, size, 1.0)[:, None], [[1.0, 0.0, 0.0]])
    return [
        ("along the beam", beam),
        ("across the beam, level", level),
        ("across the beam, upright", np.cross(beam, level)),
    ]
