"""What a fitted linear model cannot explain: the projection off its columns, priors included.

With B (R, K) the whitened columns of the model and Λ (K,) the ridge of their priors, zero for a
column without one,

    M = 1 − B H⁻¹ Bᵀ,    H = BᵀB + diag(Λ)

is the marginal precision of the data when the model's parameters are integrated out. Without
priors it is the orthogonal projection off the columns of B; with priors it is none: M M ≠ M.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """M of one linear model.

    Attributes:
        rows: (R, K) B.
        ridge: (K,) Λ.
        low: (K, K) lower Cholesky factor of H.
    """

    rows: Floats
    ridge: Floats
    low: Floats

    def solve(self, rhs: Floats) -> Floats:
        """Return H⁻¹ times (K,) or (K, P)."""
        if not len(self.low):
            return rhs
        return np.asarray(sl.cho_solve((self.low, True), rhs, check_finite=False))

    def project_out(self, x: Floats) -> Floats:
        """Return M X = X − B H⁻¹ Bᵀ X of whitened columns (R,) or (R, P)."""
        return np.asarray(x - self.rows @ self.solve(self.rows.T @ x))

    def information(self, x: Floats, gram: Floats | None = None) -> Floats:
        """Return Xᵀ M X (P, P), the Schur complement of the model in the information on X.

        Args:
            x: (R, P) whitened columns.
            gram: (P, P) XᵀX where it is known.
        """
        cross = self.rows.T @ x
        return np.asarray((x.T @ x if gram is None else gram) - cross.T @ self.solve(cross))

    def residual(self, y: Floats, z: Floats) -> Floats:
        """Return the residual (R,) after the model's own remaining step.

            y − B H⁻¹ (Bᵀ y − Λ z)

        A column that the model nearly explains would else be credited with the step that the
        model itself could still take, divided by the little of it that the model cannot explain.

        Args:
            y: (R,) residual where the model stands.
            z: (K,) coordinates where the model stands; of use only where they have a prior.
        """
        return np.asarray(y - self.rows @ self.solve(self.rows.T @ y - self.ridge * z))

    def effective(self) -> float:
        """Effective number of parameters of the model, tr(H⁻¹ BᵀB)."""
        held = self.ridge > 0
        if not held.any():
            return float(len(self.ridge))
        covariance = np.diag(self.solve(np.eye(len(self.ridge))))
        return float(len(held) - np.sum(self.ridge[held] * covariance[held]))

    def root(self) -> Floats:
        """Return Q (R, K) with M = 1 − Q Qᵀ."""
        if not len(self.low):
            return self.rows
        solved = sl.solve_triangular(self.low, self.rows.T, lower=True, check_finite=False)
        return np.asarray(solved.T)


def projection(rows: Floats, ridge: Floats, gram: Floats | None = None) -> Projection:
    """Return M of the columns B (R, K) with the ridge Λ (K,).

    Args:
        rows: B; with the ridge of full column rank.
        ridge: Λ, at least zero.
        gram: (K, K) BᵀB where it is known.
    """
    h = (rows.T @ rows if gram is None else gram) + np.diag(ridge)
    low = sl.cholesky(h, lower=True, check_finite=False) if len(h) else h
    return Projection(rows, ridge, np.asarray(low))
