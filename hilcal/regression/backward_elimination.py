"""A fitted linear model without some of its columns; no refit is needed.

With A the whitened columns that stay, H = AᵀA + β diag(1/σ²) and y the residual that the
eliminated columns are part of,

    r₀ = y − A H⁻¹ Aᵀ y

is the residual that the eliminated columns are scored by, and so is what could replace them.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.regression.evidence import FamilyScore, score_family
from hilcal.regression.normal_equations import find_basis
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True, eq=False)
class ReducedModel:
    """A model without some of its columns.

    Attributes:
        columns: (R, E) the eliminated ones.
        projection: M of those that stay.
        residual: (R,) r₀.
        dof: degrees of freedom of r₀.
    """

    columns: Floats
    projection: Projection
    residual: Floats
    dof: float

    @property
    def rss(self) -> float:
        """‖r₀‖²."""
        return float(self.residual @ self.residual)

    def score(self) -> FamilyScore:
        """Score the eliminated columns against the model without them."""
        s = self.projection.information(self.columns)
        return score_family(s, self.columns.T @ self.residual, self.rss, self.dof)


def eliminate_columns(
    columns: Floats,
    white: Floats,
    theta: Floats,
    prior: Floats,
    out: Bools,
    beta: float,
    rank: int,
) -> ReducedModel:
    """Take columns out of a fitted model.

    Args:
        columns: (R, P) whitened columns of all parameters.
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
    p = projection(basis.rows(columns), beta * basis.prior_precision)
    # Priors pull to zero, not to where the fit stands.
    z = np.zeros(len(p.ridge))
    z[len(basis.singular) :] = (theta / np.where(stay, prior, 1.0))[basis.held]
    y = white + columns[:, out] @ theta[out]
    return ReducedModel(columns[:, out], p, p.residual(y, z), rank - p.effective())
