"""What a fit states of readings that it has not seen: its posterior, and how its misfit is shared.

The fit missed the poses that it had left out by κσ² times the stated variance (`predictive`). Of
what is beyond the stated noise, κσ² − 1, a part may be common to all readings of a pose: a few
poses under several loads then tell less than as many poses. How much is read from the residual.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.errors import InputError
from hilcal.identification.fit import Fit
from hilcal.identification.predictive import Predictive, predictive
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, covariance_blocks
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True, eq=False)
class EarlierFit:
    """A gc-scaled fit, and what it states of readings that it has not seen.

    Attributes:
        fit: the fit.
        knows: what it states of other readings.
        root: (P, K) R, root of κC.
        noise: a, variance of the noise in units of the stated one.
        by_pose: c, variance of the misfit that all readings of a pose share, in the same units.
    """

    fit: Fit
    knows: Predictive
    root: Floats
    noise: float
    by_pose: float

    @property
    def mode(self) -> Mode:
        """Kind of readings."""
        return self.fit.mode


def earlier_fit(fit: Fit) -> EarlierFit:
    """Return what a gc-scaled fit states of readings that it has not seen.

    Raises:
        InputError: another scaling.
    """
    if fit.scaling != "gc":
        raise InputError(
            f"the earlier fit has scaling {fit.scaling}; a comparison needs gc: run hilcal "
            "identify again"
        )
    kept = fit.readings[~fit.outlier]
    w = fit.whitening
    sigma = float(np.sqrt(np.sum(w.whiten(fit.left_out) ** 2) / w.rank))
    knows = predictive(fit.model, fit.theta, fit.solution.prior, kept, fit.mode, sigma)
    beyond = max(knows.factor * knows.scatter - 1.0, 0.0)
    shared = beyond * _shared(fit, knows, kept)
    values, vectors = np.linalg.eigh(knows.factor * knows.covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return EarlierFit(fit, knows, root[:, values > 0.0], 1.0 + beyond - shared, shared)


def _shared(fit: Fit, knows: Predictive, kept: Readings) -> float:
    """Share of the misfit on poses left out that all readings of a pose have in common.

    With r_i (3,) the residual of measurement i, predicted without its pose, V_ij the stated
    covariance of two measurements, J_i C J_jᵀ that of their predictions and τ_i² = tr V_ii, the
    shares a and c of

        r_iᵀ r_j = a tr V_ij + c τ_i τ_j + tr J_i C J_jᵀ

    are fitted to all i ≠ j of a pose and to i = j; 1 of a is the stated noise. Without two readings
    in a pose c is 0.
    """
    w, m = fit.whitening, fit.whitening.m
    if len(np.unique(fit.pose)) == len(fit.pose):
        return 0.0
    off = fit.left_out[:, :3]
    tau = np.sqrt(np.trace(w.covariance[:, :3, :3], axis1=1, axis2=2))
    at = np.empty(len(kept), dtype=np.int64)
    at[w.reading] = np.arange(len(off))
    stated: dict[tuple[int, int], float] = {}
    for bucket, block in zip(w.buckets, covariance_blocks(kept, w), strict=True):
        count = bucket.loaded.shape[1]
        parts = block.reshape(len(block), count, m, count, m)[:, :, :3, :, :3]
        traces = np.einsum("gaibi->gab", parts)
        for rows, trace in zip(at[bucket.loaded], traces, strict=True):
            for a in range(count):
                for b in range(a + 1, count):
                    stated[int(rows[a]), int(rows[b])] = float(trace[a, b])
    values, vectors = np.linalg.eigh(knows.covariance)
    jacobian = fit.model.jacobian(fit.solution.prediction, fit.theta, m)[:, :3]
    spread = w.raw(jacobian @ (vectors * np.sqrt(np.maximum(values, 0.0)))).reshape(len(off), -1)
    x = [np.stack([tau**2, tau**2], axis=1)]
    y = [np.sum(off**2, axis=1) - np.sum(spread**2, axis=1)]
    pairs = []
    for mine in _groups(fit.pose):
        first, second = np.triu_indices(len(mine), 1)
        i, j = mine[first], mine[second]
        known = [stated.get((a, b), stated.get((b, a), 0.0)) for a, b in zip(i, j, strict=True)]
        pairs.append(len(i))
        x.append(np.stack([np.array(known), tau[i] * tau[j]], axis=1).reshape(-1, 2))
        y.append(np.sum(off[i] * off[j], axis=1) - (spread[mine] @ spread[mine].T)[first, second])
    if not sum(pairs):
        return 0.0
    a, c = np.linalg.lstsq(np.concatenate(x), np.concatenate(y), rcond=None)[0]
    scatter, shared = max(float(a) - 1.0, 0.0), max(float(c), 0.0)
    return shared / (scatter + shared) if scatter + shared > 0.0 else 0.0


def _groups(number: Ints) -> list[Ints]:
    order = np.argsort(number, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(number[order])) + 1)
