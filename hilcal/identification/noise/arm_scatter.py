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

from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.fit import Fit
from hilcal.identification.noise.full_covariance import joint_factors, whitened_blocks
from hilcal.model.model import Model
from hilcal.readings.covariance import scatter_alone, with_scatter
from hilcal.readings.readings import ArmScatter, Readings, ScatterKind
from hilcal.readings.whitening import Whitening, whitening
from hilcal.regression.variance_components import BlockRows, VarianceComponents, variance_components
from hilcal.types import Floats, Ints

MOST_ROWS = 4000  # whitened rows used, of randomly chosen poses, for speed; a choice: hundreds of
# arrivals determine σ to a few per cent
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
    f = np.concatenate([std / scatter.unit * factor for factor, std in parts], axis=2)
    return replace(with_scatter(readings, f), stated=readings.covariance, arm_scatter=scatter)


def with_prior_scatter(model: Model, readings: Readings) -> Readings:
    """Return the readings with the arm's scatter of the model's carried prior.

    Unchanged without such a scatter, or where the covariance contains the arm's scatter already.
    """
    scatter = None if model.prior is None else model.prior.posterior.scatter
    alone = None if scatter is None else replace(scatter, unit=1.0)
    return with_missing_scatter(model.cell, readings, alone)


def with_missing_scatter(cell: Cell, readings: Readings, scatter: ArmScatter | None) -> Readings:
    """Return the readings with a scatter of the arm that is known from other readings.

    Unchanged where none is known, or where the covariance contains the arm's scatter already.
    """
    if scatter is None or readings.scatter_stated or readings.arm_scatter is not None:
        return readings
    return with_arm_scatter(cell, readings, scatter)


def estimate_arm_scatter(fit: Fit) -> ArmScatter | None:
    """Estimate the arm's scatter; None where the residual shows none.

    The fit must be gc-scaled, and the covariance of its readings the stated one.
    """
    readings, w, white, columns = _whitened(fit)
    ridge, price = fit.solution.equations.basis.prior_precision, 0.5 * float(np.log(fit.dof))
    cell = fit.model.cell

    def maximised(parts: list[list[Floats]]) -> VarianceComponents:
        """Components with the whitened blocks of each."""
        blocks, start = [], 0
        for k, b in enumerate(w.buckets):
            shape = groups, size = len(b.loaded), b.factor.shape[-1]
            rows = slice(start, start + groups * size)
            components = np.stack([part[k] for part in parts])
            y, x = white[rows].reshape(shape), columns[rows].reshape(*shape, columns.shape[1])
            blocks.append(BlockRows(y, x, components))
            start = rows.stop
        return variance_components(blocks, ridge)

    measured = [np.any(b.factor != 0, axis=2) for b in w.buckets]
    noisier = maximised([[m[:, :, None] * np.eye(m.shape[1]) for m in measured]])
    components = {
        kind: maximised(
            [whitened_blocks(scatter_alone(readings, f), w) for f in factors(cell, readings, kind)]
        )
        for kind in KINDS
    }
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
        for v, f in zip(variance, factors(cell, readings, best), strict=True)
    )
    return ArmScatter(
        kind=best,
        std=tuple(std.tolist()),
        std_error=tuple(error.tolist()),
        size_m=float(np.sqrt(moved)),
        log_evidence=float(evidence[best] - noisier.log_likelihood + price),
        instrument_factor=float(np.sqrt(1.0 + noisier.variance[0])),
    )


def _whitened(fit: Fit) -> tuple[Readings, Whitening, Floats, Floats]:
    """Some readings of whole arrivals, their scaling, whitened residual (R,) and columns (R, K)."""
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
    return some, w, white + rows @ s.coordinates(), rows


def some_poses(readings: Readings, share: float, seed: int, fewest: int = 1) -> Ints:
    """Return the rows of all readings, or for a share below 1 those of randomly chosen poses."""
    if share >= 1.0:
        return np.arange(len(readings))
    poses = np.unique(readings.pose)
    count = max(int(share * len(poses)), fewest)
    chosen = np.random.default_rng(seed).choice(poses, count, replace=False)
    return np.flatnonzero(np.isin(readings.pose, chosen))
