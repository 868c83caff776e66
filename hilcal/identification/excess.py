"""What a residual has beyond the stated noise: of positions and of attitudes apart.

A model's misfit has not the shape of an instrument's noise, which is small along the beam, nor the
same share of positions and attitudes. With r (3,) the residuals of the D positions, V their
covariance, W = V + s² 1, and J C Jᵀ the covariance of their predictions, C that of parameters
estimated with σ² W, s² solves (Mandel and Paule, for the scatter between laboratories beyond what
each states)

    Σ rᵀ W⁻¹ r = 3 D − Σ tr (σ² W)⁻¹ J C Jᵀ

and the attitudes' part of V is multiplied by their χ² over its degrees of freedom. Either only
where its own χ² is larger than chance allows.

Source: Mandel and Paule, Analytical Chemistry 42 (1970) 1194-1197.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import chi2

from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Whitening
from hilcal.types import Floats

CHANCE = 0.0005
"""p-value of χ² below which there is an excess: that of `diagnosis.noise`."""
SOME = 400
"""Measurements, evenly spaced, from which a mean leverage is taken, for speed; a choice."""
SAME = 0.05
"""Relative change of s² and of the factor that makes no difference; a choice."""


@dataclass(frozen=True, slots=True)
class Excess:
    """What is added to the stated covariance.

    Attributes:
        position: s² of each coordinate of a measured position, m².
        attitude: factor of the variances of the attitude.
    """

    position: float = 0.0
    attitude: float = 1.0

    @property
    def none(self) -> bool:
        """Whether there is none."""
        return self.position == 0.0 and self.attitude == 1.0

    def near(self, other: "Excess") -> bool:
        """Whether the difference to another one does not matter."""
        a, b = self.position, other.position
        return abs(a - b) <= SAME * max(a, b) and abs(self.attitude / other.attitude - 1) <= SAME

    def halfway(self, other: "Excess") -> "Excess":
        """Return one between this and another: the geometric mean, half where one has none."""
        both = self.position, other.position
        middle = float(np.sqrt(both[0] * both[1])) if min(both) > 0 else sum(both) / 2
        return Excess(middle, float(np.sqrt(self.attitude * other.attitude)))

    def widened(self, covariance: Floats, share: float = 1.0) -> Floats:
        """Return covariances (N, m, m) with it; with a share of s²."""
        m = covariance.shape[-1]
        root = np.sqrt(np.where(np.arange(m) < 3, 1.0, self.attitude))
        more = np.where(np.arange(m) < 3, share * self.position, 0.0)
        return np.asarray(covariance * root[:, None] * root + np.diag(more))

    def of_readings(self, readings: Readings, mode: Mode) -> Readings:
        """Return readings with it; a deflection, the difference of two, has s² in all."""
        share = 0.5 if mode == "deflection" else 1.0
        return replace(readings, covariance=self.widened(readings.covariance, share))


NONE = Excess()


def excess(
    raw: Floats,
    stated: Whitening,
    used: Whitening,
    rows: Floats,
    root: Floats,
    before: Excess = NONE,
) -> Excess:
    """Return what a residual has beyond the stated noise.

    Args:
        raw: (D, m) residual.
        stated: scaling by V.
        used: scaling by which C was found, of the same measurements.
        rows: (R, P) derivatives, whitened by `used`.
        root: (P, K) root of C over the noise factor that it was found with.
        before: what `used` has already; a part that has some is not asked for chance again.
    """
    spread = _spread(used, rows, root)
    every = np.linspace(0, len(raw) - 1, min(len(raw), SOME)).astype(int)
    position, attitude = 0.0, 1.0
    for part in (slice(0, 3), slice(3, 6))[: raw.shape[1] // 3]:
        v, r = stated.covariance[:, part, part], raw[:, part]
        values, vectors = np.linalg.eigh(v)
        if values.min() <= 0.0:
            continue
        share = np.linalg.solve(used.covariance[every, part, part], spread[:, part, part])
        free = r.size - len(raw) * float(np.trace(share, axis1=1, axis2=2).mean())
        square = np.einsum("dij,di->dj", vectors, r) ** 2
        total = float(np.sum(square / values))
        known = before.attitude > 1.0 if part.start else before.position > 0.0
        if free < 1.0 or total <= free:
            continue
        if not known and float(chi2.sf(total, free)) >= CHANCE:
            continue
        if part.start:
            attitude = total / free
        else:
            from scipy.optimize import brentq  # slow to import

            most = float(square.sum()) / free
            position = float(
                brentq(lambda s, q=square, e=values, f=free: np.sum(q / (e + s)) - f, 0.0, most)
            )
    return Excess(position, attitude)


def _spread(w: Whitening, rows: Floats, root: Floats) -> Floats:
    """J C Jᵀ (S, m, m) of some measurements, evenly spaced."""
    count = len(w.reading)
    every = np.linspace(0, count - 1, min(count, SOME)).astype(int)
    out, at, first = np.zeros((len(every), w.m, w.m)), 0, 0
    for b in w.buckets:
        groups, size = len(b.loaded), b.factor.shape[-1]
        each = size // w.m
        mine = np.flatnonzero((every >= first) & (every < first + groups * each))
        group, place = np.divmod(every[mine] - first, each)
        part = rows[at : at + groups * size].reshape(groups, size, -1)[group] @ root
        part = np.linalg.pinv(b.factor[group]) @ part
        part = part.reshape(len(mine), each, w.m, -1)[np.arange(len(mine)), place]
        out[mine] = part @ np.swapaxes(part, 1, 2)
        at, first = at + groups * size, first + groups * each
    return out
