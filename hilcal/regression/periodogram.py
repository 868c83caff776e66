"""Least-squares periodogram: waves of several variables in a residual.

The elements i of reading n move by w_nij with a unit displacement of joint j. A wave of k periods
per turn has the columns w_nij cos k q_nj and w_nij sin k q_nj. Beside nothing else it explains

    χ²_jk = gᵀ A⁻¹ g,    g = Xᵀ r,    A = Xᵀ X

of ‖r‖², which without such a wave is about 2 s² F(2, f − 2), with s² = ‖r‖²/f and f degrees of
freedom. The residual of a model is not white where effects are missing. So s² is also at least that
which the median of χ²_jk over k shows.

Sources: Lomb, *Least-squares frequency analysis of unequally spaced data*, Astrophysics and Space
Science 39 (1976) 447; the strongest waves are removed in turn, as by Högbom, *Aperture synthesis
with a non-regular distribution of interferometer baselines*, Astronomy and Astrophysics Supplement
15 (1974) 417.
"""

import numpy as np
import scipy

from hilcal.types import Floats, Ints

ROUNDS = 5  # each finds at most one wave of each joint; a choice
LEAST_SHARE = 0.005
"""Share of ‖r‖² below which a wave is not worth its parameters, however sure: without it the rms
falls by a quarter of a per cent. A choice."""
SINGULAR = 1e-6  # share of the largest determinant of A below which angles do not show a wave
TIE = 1e-6  # share by which waves differ that are the same at all angles: the lowest is found
AT_ONCE = 64  # orders that are computed together


def significant_waves(
    angle: Floats,  # (N, n) q
    moved: Floats,  # (N, m, n) w
    residual: Floats,  # (N, m) r, in units of the noise
    orders: Ints,  # (K,) periods per turn that are tried, ascending
    dof: float,  # f
    level: float,  # probability to find any wave where there is none
) -> list[tuple[int, int]]:
    """Return the joints and orders of significant waves above `LEAST_SHARE`, the strongest first.

    Each round fits the waves of all previous ones together, and searches what is left.
    """
    lines: list[tuple[int, int]] = []
    remaining = residual
    for _ in range(ROUNDS):
        free = max(dof - 2.0 * len(lines), 3.0)
        total = float(np.sum(remaining**2))
        square, best = total / free, []
        for j in range(angle.shape[1]):
            gain = _gains(angle[:, j], moved[:, :, j], remaining, orders)
            k = int(np.argmax(gain > (1.0 - TIE) * gain.max(initial=0.0)))
            floor = max(square, float(np.median(gain)) / scipy.stats.chi2.median(2))
            f = gain[k] / 2.0 / max(floor - gain[k] / free, 1e-300)
            p = scipy.stats.f.sf(f, 2, free - 2) * len(orders) * angle.shape[1]
            if p < level and gain[k] > LEAST_SHARE * total:
                best.append((float(gain[k]), j, int(orders[k])))
        new = [(j, k) for _, j, k in sorted(best, reverse=True) if (j, k) not in lines]
        if not new:
            break
        lines += new
        waves = [w(k * angle[:, j]) for j, k in lines for w in (np.cos, np.sin)]
        joints = np.repeat([j for j, _ in lines], 2)
        x = (moved[:, :, joints] * np.stack(waves, axis=1)[:, None]).reshape(-1, len(joints))
        y = residual.reshape(-1)
        remaining = (y - x @ np.linalg.lstsq(x, y, rcond=None)[0]).reshape(residual.shape)
    return lines


def _gains(angle: Floats, moved: Floats, residual: Floats, orders: Ints) -> Floats:
    """χ² (K,) of the waves of one joint, with `angle` (N,), `moved` (N, m), `residual` (N, m)."""
    a, b = np.sum(moved**2, axis=1), np.sum(moved * residual, axis=1)
    wave = np.exp(1j * np.outer(angle, np.arange(AT_ONCE) + orders[0]))
    step = np.exp(1j * AT_ONCE * angle)[:, None]  # products are many times as fast as exponentials
    sums = []
    for _ in range(orders[0], orders[-1] + 1, AT_ONCE):
        sums.append((b @ wave, a @ wave**2))
        wave *= step
    g, double = np.concatenate(sums, axis=1)[:, orders - orders[0]]
    total = float(a.sum())
    determinant = total**2 - np.abs(double) ** 2  # 4 det A
    determined = determinant > SINGULAR * total**2
    # A = ½ [Σa + Re D, Im D; Im D, Σa − Re D], D = Σ a exp 2ikq
    square = total * np.abs(g) ** 2 - np.real(np.conj(double) * g**2)
    return np.where(determined, 2.0 * square / np.where(determined, determinant, 1.0), 0.0)
