"""Projection off the columns of a fitted linear model, with their priors.

With B (R, K) the whitened columns of the model and Λ (K,) the ridge of their priors, zero for a
column without a prior,

    M = 1 − B H⁻¹ Bᵀ,    H = BᵀB + diag(Λ)

is the marginal precision of the data when the model's parameters are integrated out. Without
priors M is the orthogonal projection off the columns of B; with priors M is no projection: M M ≠ M.
Columns may be linearly dependent: H⁻¹ is then the generalised inverse of `schur`.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.regression.schur import inverse_root
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """M of one linear model."""

    rows: Floats  # (R, K) B
    ridge: Floats  # (K,) Λ
    inverse_root: Floats  # (K, K) T with Tᵀ T = H⁻¹

    def solve(self, rhs: Floats) -> Floats:
        """Return H⁻¹ times (K,) or (K, P)."""
        return np.asarray(self.inverse_root.T @ (self.inverse_root @ rhs))

    def project_out(self, x: Floats) -> Floats:
        """Return M X = X − B H⁻¹ Bᵀ X of whitened columns (R,) or (R, P)."""
        return np.asarray(x - self.rows @ self.solve(self.rows.T @ x))

    def information(self, x: Floats) -> Floats:
        """Return Xᵀ M X (P, P) of X (R, P), the Schur complement of the model."""
        return self.schur(x.T @ x, self.rows.T @ x)

    def schur(self, gram: Floats, cross: Floats) -> Floats:
        """Return Xᵀ M X (P, P) from XᵀX (P, P) and BᵀX (K, P)."""
        lifted = self.inverse_root @ cross
        return np.asarray(gram - lifted.T @ lifted)

    def residual(self, y: Floats, z: Floats) -> Floats:
        """Return the residual (R,) after the remaining Gauss-Newton step of the model.

            y − B H⁻¹ (Bᵀ y − Λ z)

        y is its residual, z (K,) its coordinates, used only where they have a prior. Else this step
        would be ascribed to a column that the model nearly explains, divided by its small rest.
        """
        return np.asarray(y - self.rows @ self.solve(self.rows.T @ y - self.ridge * z))


def projection(rows: Floats, ridge: Floats, gram: Floats | None = None) -> Projection:
    """Return M of the columns B (R, K) with the ridge Λ (K,); `gram` is BᵀB (K, K) if computed."""
    h = (rows.T @ rows if gram is None else gram) + np.diag(ridge)
    return Projection(rows, ridge, inverse_root(h))
