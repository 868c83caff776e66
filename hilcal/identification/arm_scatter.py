"""Estimation of the arm's scatter from a residual that nothing predicts.

In addition to the noise of the stated covariance V_0, arrival k of the arm adds F_k ε_k with

    joints        F_k = R J_k,      ε_k ~ N(0, σ² 1)
    each joint    F_k = R J_k,      ε_k ~ N(0, diag(σ_1², ..., σ_n²))
    isotropic     F_k = 1 (3 × 3),  ε_k ~ N(0, σ² 1), the position of the target

where J_k is the Jacobian of the target and R the orientation of the base in the sensor's frame.
Readings of one arrival share ε_k; deflections share that of their unloaded reading. The σ are
variance components of the whitened residual, with the parameters of the model projected out (REML,
see `regression.variance_components`). The kind with the largest evidence ℓ − ½ c log dof, for c
components (Schwarz), is chosen. The alternative is V = f V_0, an instrument noisier than stated;
the difference of the evidences says whether the readings distinguish the two.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.fit import Fit
from hilcal.identification.full_covariance import joint_factors, whitened_blocks
from hilcal.model.model import Model
from hilcal.readings.covariance import scatter_alone, with_scatter
from hilcal.readings.readings import ArmScatter, Readings, ScatterKind
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.variance_components import BlockRows, VarianceComponents, variance_components
from hilcal.types import Floats, Ints

MOST_ROWS = 4000
"""Most whitened rows used, of randomly chosen poses, for speed; a choice: hundreds of arrivals
determine σ to a few per cent."""
SEED = 20250304  # of the choice of poses
KINDS: tuple[ScatterKind, ...] = ("joints", "each joint", "isotropic")


def factors(cell: Cell, readings: Readings, kind: ScatterKind) -> tuple[Floats, ...]:
    """Return F (N, m, k) of each component for unit σ, with the frames of the cell."""
    m = readings.m
    if kind == "isotropic":
        out = np.tile(np.eye(m)[:, :3], (len(readings), 1, 1))
        out[readings.scalar, 1:] = 0.0  # a distance has one element
        return (out,)
    f = joint_factors(cell, readings, np.ones(cell.arm.n))
    return (f,) if kind == "joints" else tuple(f[:, :, [j]] for j in range(f.shape[2]))


def with_arm_scatter(cell: Cell, readings: Readings, scatter: ArmScatter) -> Readings:
    """Return the readings with an estimated scatter added to their stated covariance."""
    parts = zip(factors(cell, readings, scatter.kind), scatter.std, strict=True)
    f = np.concatenate([std * factor for factor, std in parts], axis=2)
    return replace(with_scatter(readings, f), stated=readings.covariance, arm_scatter=scatter)


def with_prior_scatter(model: Model, readings: Readings) -> Readings:
    """Return the readings with the arm's scatter of the model's carried prior.

    Without such a scatter, or where the covariance contains the arm's scatter already, the readings
    are returned unchanged.
    """
    scatter = None if model.prior is None else model.prior.posterior.scatter
    if scatter is None or readings.scatter_stated or readings.arm_scatter is not None:
        return readings
    return with_arm_scatter(model.cell, readings, scatter)


@dataclass(frozen=True, slots=True, eq=False)
class _Whitened:
    """Data for the components: readings, scaling, whitened residual (R,) and columns (R, K)."""

    readings: Readings
    w: Whitening
    y: Floats
    rows: Floats

    def blocks(self, components: list[list[Floats]]) -> list[BlockRows]:
        """Rows in blocks, with the whitened blocks of each component."""
        out, start = [], 0
        for k, b in enumerate(self.w.buckets):
            groups, size = len(b.loaded), b.factor.shape[-1]
            stop = start + groups * size
            y = self.y[start:stop].reshape(groups, size)
            rows = self.rows[start:stop].reshape(groups, size, -1)
            out.append(BlockRows(y, rows, np.stack([c[k] for c in components])))
            start = stop
        return out

    def instrument(self) -> list[Floats]:
        """Whitened blocks of the stated covariance."""
        measured = [np.any(b.factor != 0, axis=2) for b in self.w.buckets]
        return [m[:, :, None] * np.eye(m.shape[1]) for m in measured]


def estimate_arm_scatter(fit: Fit) -> ArmScatter | None:
    """Estimate the arm's scatter; None where the residual shows none.

    The fit must be gc-scaled, and the covariance of its readings the stated one.
    """
    data, ridge = _whitened(fit), fit.solution.equations.basis.prior_precision
    cell, price = fit.model.cell, 0.5 * float(np.log(fit.dof))

    def maximised(kind: ScatterKind | None) -> VarianceComponents:
        if kind is None:  # a noisier instrument
            return variance_components(data.blocks([data.instrument()]), ridge)
        parts = [
            whitened_blocks(scatter_alone(data.readings, f), data.w)
            for f in factors(cell, data.readings, kind)
        ]
        return variance_components(data.blocks(parts), ridge)

    components, noisier = {kind: maximised(kind) for kind in KINDS}, maximised(None)
    evidence = {kind: v.log_likelihood - len(v.variance) * price for kind, v in components.items()}
    best = max(KINDS, key=lambda kind: evidence[kind])
    variance = components[best].variance
    if not variance.any():
        return None
    std = np.sqrt(variance)
    spread = np.sqrt(np.diag(components[best].covariance))
    error = np.where(std > 0, spread / (2 * np.where(std > 0, std, 1.0)), 0.0)
    moved = sum(
        v * np.mean(np.sum(f[:, :3] ** 2, axis=(1, 2)))
        for v, f in zip(variance, factors(cell, data.readings, best), strict=True)
    )
    return ArmScatter(
        kind=best,
        std=tuple(std.tolist()),
        std_error=tuple(error.tolist()),
        size_m=float(np.sqrt(moved)),
        log_evidence=float(evidence[best] - noisier.log_likelihood + price),
        instrument_factor=float(np.sqrt(1.0 + noisier.variance[0])),
    )


def _whitened(fit: Fit) -> _Whitened:
    """Whiten the residual and the columns of a fit in blocks of whole arrivals."""
    inliers, s = fit.readings[~fit.outlier], fit.solution
    live = np.flatnonzero(s.estimated)
    if inliers.states.target is not None and inliers.common is None:
        common = np.zeros((len(inliers), inliers.m, fit.model.cell.arm.n))
        inliers = replace(inliers, common=common)
    chosen = some_poses(inliers, MOST_ROWS / max(fit.white.size, 1), SEED)
    some = inliers[chosen]
    w = whitening(some, fit.mode, "gc")
    place = np.zeros(len(inliers), dtype=np.int64)
    place[fit.whitening.reading] = np.arange(len(fit.raw))
    white = w.whiten(fit.raw[place[chosen[w.reading]]]).reshape(-1)
    jacobian = fit.model.jacobian(s.prediction, s.theta, w.m, live)[chosen]
    rows = w.whiten(w.raw(jacobian)).reshape(w.m * len(w), len(live)) @ s.transform[live]
    return _Whitened(some, w, white + rows @ s.coordinates(), rows)


def some_poses(readings: Readings, share: float, seed: int, fewest: int = 1) -> Ints:
    """Return the rows of all readings, or for a share below 1 those of randomly chosen poses."""
    if share >= 1.0:
        return np.arange(len(readings))
    poses = np.unique(readings.pose)
    count = max(int(share * len(poses)), fewest)
    chosen = np.random.default_rng(seed).choice(poses, count, replace=False)
    return np.flatnonzero(np.isin(readings.pose, chosen))
