"""A fitted model without one of its effects, at the same linearisation: no refit is needed.

With A the whitened Jacobian of the other effects, H = AᵀA + β diag(1/σ²) and y the residual
that the effect is part of,

    r₀ = y − A H⁻¹ Aᵀ y

is what the effect is scored by, and whatever could be there in place of it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.identify.fit import Fit
from hilcal.identify.gauss_newton import scales_of
from hilcal.regression.normal_equations import find_basis
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Without:
    """What is left of a model when an effect is taken out.

    Attributes:
        columns: (R, P) whitened columns of the effect, in ordinary magnitudes.
        rows: (R, K) A, the others' whitened Jacobian in identifiable coordinates.
        factor: Cholesky factor of H.
        rest: (R,) r₀.
        dof: degrees of freedom of r₀.
    """

    columns: Floats
    rows: Floats
    factor: tuple[Floats, bool]
    rest: Floats
    dof: float

    def free(self, x: Floats) -> Floats:
        """Return X − A H⁻¹ Aᵀ X for whitened columns X (R, P)."""
        return np.asarray(
            x - self.rows @ sl.cho_solve(self.factor, self.rows.T @ x, check_finite=False)
        )


def whitened_columns(fit: Fit) -> Floats:
    """Whitened Jacobian (R, P) of all parameters of a fit, in ordinary magnitudes."""
    scale, s, w = scales_of(fit.model), fit.solution, fit.whitening
    jacobian = fit.model.jacobian(s.prediction, s.theta, w.m) * scale
    return w.whiten(w.raw(jacobian)).reshape(-1, len(scale))


def leave_out_effect(fit: Fit, columns: Floats, effect: str) -> Without:
    """Take an effect out of a fit.

    Args:
        fit: the fit.
        columns: (R, P) its `whitened_columns`.
        effect: name of the effect, which is in its model.
    """
    mine = np.zeros(columns.shape[1], dtype=np.bool_)
    mine[fit.model.slices()[fit.model.names.index(effect)]] = True
    scale = scales_of(fit.model)
    theta, prior = fit.theta / scale, fit.solution.prior / scale
    others = ~mine & (prior > 0)
    y = fit.white + columns[:, mine] @ theta[mine]
    basis = find_basis(columns[:, others], np.ones(int(others.sum())), prior[others])
    a = columns[:, others] @ basis.transform
    ridge = fit.solution.beta * basis.prior_precision
    inner = a.T @ a
    factor, low = sl.cho_factor(inner + np.diag(ridge), check_finite=False)
    solver = (factor, bool(low))
    # Priors pull to zero, not to where the fit stands: their part of y is in it, too.
    own = y + a @ _coordinates(basis.transform, theta[others], ridge)
    rest = own - a @ sl.cho_solve(solver, a.T @ own, check_finite=False)
    spent = float(np.trace(sl.cho_solve(solver, inner, check_finite=False)))
    return Without(columns[:, mine], a, solver, rest, fit.whitening.rank - spent)


def _coordinates(transform: Floats, theta: Floats, ridge: Floats) -> Floats:
    """Coordinates (K,) of the parameters that have a prior; zero for the others."""
    z = np.linalg.lstsq(transform, theta, rcond=None)[0]
    return np.where(ridge > 0, z, 0.0)
