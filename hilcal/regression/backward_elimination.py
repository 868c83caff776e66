"""A fitted linear model without some of its columns; no refit is needed.

With A the whitened columns that stay, H = AᵀA + β diag(1/σ²) and y the residual that the
eliminated columns are part of,

    r₀ = y − A H⁻¹ Aᵀ y

is the residual that the eliminated columns are scored by, and so is what could replace them.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.normal_equations import Basis, find_basis, normal_equations
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class ReducedModel:
    """A model without some of its columns, which are not copied: they can be many.

    Attributes:
        columns: (R, P) all columns of the model.
        out: (P,) the eliminated ones.
        basis: coordinates of those that stay, flat ones first.
        flat: (R, F) rows by the flat coordinates.
        inverse_root: (K, K) T with Tᵀ T = H⁻¹.
        gram: (P, P) of all columns.
        residual: (R,) r₀.
        dof: degrees of freedom of r₀.
    """

    columns: Floats
    out: Bools
    basis: Basis
    flat: Floats
    inverse_root: Floats
    gram: Floats
    residual: Floats
    dof: float

    @property
    def rss(self) -> float:
        """‖r₀‖²."""
        return float(self.residual @ self.residual)

    def information(self, x: Floats, gram: Floats, products: Floats) -> Floats:
        """Return Xᵀ M X (Q, Q), M the projection off the columns that stay.

        Args:
            x: (R, Q) whitened columns.
            gram: (Q, Q) XᵀX.
            products: (P, Q) of all columns of the model with X.
        """
        return self._information(self.flat.T @ x, gram, products)

    def _information(self, flat: Floats, gram: Floats, products: Floats) -> Floats:
        """Return `information` of X from the products (F, Q) of the flat directions with X."""
        held, count = self.basis.held, self.flat.shape[1]
        sigma = self.basis.transform[held, count + np.arange(len(held))]
        lifted = self.inverse_root @ np.vstack([flat, sigma[:, None] * products[held]])
        return np.asarray(gram - lifted.T @ lifted)

    def score(self) -> FamilyScore:
        """Score the eliminated columns against the model without them."""
        products = self.gram[:, self.out]
        # Of all columns: those that are taken out would be copied.
        flat = (self.flat.T @ self.columns)[:, self.out]
        s = self._information(flat, products[self.out], products)
        slope = (self.columns.T @ self.residual)[self.out]
        return score_family(s, slope, self.rss, self.dof)


def eliminate_columns(
    columns: Floats,
    gram: Floats,
    white: Floats,
    theta: Floats,
    prior: Floats,
    out: Bools,
    beta: float,
    rank: int,
) -> ReducedModel:
    """Take columns out of a fitted model.

    Args:
        columns: (R, P) A, whitened columns of all parameters.
        gram: (P, P) AᵀA.
        white: (R,) whitened residual of the fit.
        theta: (P,) parameters of the fit.
        prior: (P,) their prior standard deviations: infinite for flat ones, zero for those held
            at zero.
        out: (P,) which to take out.
        beta: noise variance factor that the priors are weighed against.
        rank: number of rows that carry information.
    """
    stay = ~out & (prior > 0)
    basis = find_basis(columns, np.ones(columns.shape[1]), np.where(stay, prior, 0.0))
    y = white + columns @ np.where(out, theta, 0.0)
    equations = normal_equations(columns, y, basis, gram)
    # Priors pull to zero, not to where the fit stands.
    count, ridge = len(basis.singular), beta * basis.prior_precision
    z = np.zeros(len(ridge))
    z[count:] = (theta / np.where(stay, prior, 1.0))[basis.held]
    root = equations.inverse_root(beta)
    step = basis.transform @ (root.T @ (root @ (equations.rhs - ridge * z)))
    shrunk = float(np.sum(ridge * np.sum(root**2, axis=0)))
    determined = float(np.count_nonzero(np.any(root, axis=1)))
    return ReducedModel(
        columns=columns,
        out=out,
        basis=basis,
        flat=basis.flat_rows(columns),
        inverse_root=root,
        gram=gram,
        residual=y - columns @ step,
        dof=rank - (determined - shrunk),
    )
