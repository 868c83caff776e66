"""Constants of each pose beside a model: how much of a residual they take.

The columns C of the constants, three displacements of the target in each pose, are whitened and
orthonormal; each has rows in one pose alone. Beside the model they are M C, with M = 1 − Q Qᵀ (see
`regression.projection`), and with W = CᵀQ their Gram matrix is the identity less one of no more
than the model's rank,

    CᵀM²C = 1 − W (2 − QᵀQ) Wᵀ = 1 − V Vᵀ,    VᵀV = diag(t)

What they take of a vector x is ‖Uᵀx‖² of an orthonormal basis U of their span: with z = CᵀM x

    zᵀ (CᵀM²C)⁺ z = ‖z‖² + Σ_{t_k < 1} (v_kᵀ z)² / (1 − t_k) − Σ_{t_k = 1} (v_kᵀ z)²

where t = 1 is a direction that the model holds already. Thousands of poses cost a small
factorisation each and one of the model's size.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import f as f_distribution

from hilcal.identification.linearisation import Linearisation
from hilcal.regression.projection import Projection
from hilcal.types import Floats, Ints

if TYPE_CHECKING:
    from scipy.sparse import csr_array

DETERMINED = 1e-6
"""Singular value of a determined direction over the largest; below it, rounding."""
HELD = 1.0 - DETERMINED**2
"""t from which on the model holds a direction already."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseConstants:
    """Constants of each pose beside a model.

    Attributes:
        projection: M.
        columns: (R, 3 poses) C.
        shared: (3 poses, K) V.
        t: (K,) squares of its columns, which are orthogonal.
        rank: number of directions beside the model.
        gain: reduction of ‖r‖² by them.
        p_value: of that.
    """

    projection: Projection
    columns: "csr_array"
    shared: Floats
    t: Floats
    rank: int
    gain: float
    p_value: float

    def square(self, x: Floats) -> float:
        """Return the square ‖Uᵀx‖² of whitened columns x (R, P) that the constants take."""
        z = np.asarray(self.columns.T @ self.projection.project_out(x))
        return _square(z, self.shared, self.t)


def pose_constants(p: Linearisation) -> PoseConstants | None:
    """Split the residual by displacements of each pose; None where poses have too few readings."""
    fit, w = p.fit, p.fit.whitening
    poses = int(fit.pose.max()) + 1
    if poses * 3 > fit.dof / 2 or len(fit.pose) < 2 * poses:
        return None
    axes = np.zeros((len(fit.pose), w.m, 3))
    axes[:, :3] = 1e-3 * fit.solution.prediction.observation.axes[w.reading]
    columns, there = _orthonormal(w.whiten(axes), w.rows_of(fit.pose))
    b, inverse_root = p.projection.rows, p.projection.inverse_root
    values, vectors = np.linalg.eigh(
        2.0 * np.eye(len(inverse_root)) - inverse_root @ (b.T @ b) @ inverse_root.T
    )
    shared = np.asarray(columns.T @ b) @ inverse_root.T @ (vectors * np.sqrt(np.abs(values)))
    t, turn = np.linalg.eigh(shared.T @ shared)
    shared = shared @ turn
    rank = there - int(np.count_nonzero(t >= HELD))
    if rank <= 0 or fit.dof - rank <= 0:
        return None
    gain = _square(np.asarray(columns.T @ p.project_out(p.residual[:, None])), shared, t)
    within = (p.rss - gain) / (fit.dof - rank)
    p_value = float(f_distribution.sf(gain / rank / within, rank, fit.dof - rank))
    return PoseConstants(p.projection, columns, shared, t, rank, gain, p_value)


def _orthonormal(columns: Floats, pose: Ints) -> "tuple[csr_array, int]":
    """Columns (R, 3 poses) of columns (R, 3) that each pose has alone, orthonormal; their rank."""
    from scipy.sparse import csr_array  # slow to import

    values = np.zeros_like(columns)
    order = np.argsort(pose, kind="stable")
    parts = np.split(order, np.flatnonzero(np.diff(pose[order])) + 1)
    found = [np.linalg.svd(columns[rows], full_matrices=False) for rows in parts]
    least = DETERMINED * max(float(s.max(initial=0.0)) for _, s, _ in found)
    for rows, (u, s, _) in zip(parts, found, strict=True):
        values[np.ix_(rows, s > least)] = u[:, s > least]
    there = sum(int(np.count_nonzero(s > least)) for _, s, _ in found)
    at = 3 * pose[:, None] + np.arange(3)
    start = 3 * np.arange(len(pose) + 1)
    shape = len(pose), 3 * (int(pose.max()) + 1)
    return csr_array((values.reshape(-1), at.reshape(-1), start), shape=shape), there


def _square(z: Floats, shared: Floats, t: Floats) -> float:
    """Return zᵀ (1 − V Vᵀ)⁺ z, of all columns of z."""
    along = np.sum((shared.T @ z) ** 2, axis=1)
    held = t >= HELD
    return float(np.sum(z**2) + np.sum(along[~held] / (1.0 - t[~held])) - np.sum(along[held]))
