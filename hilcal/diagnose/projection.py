"""Columns of a family, whitened, and freed of what the fitted model can do itself."""

from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.diagnose.score import Score, score
from hilcal.identify.fit import Fit
from hilcal.identify.holdout import fold_ridge
from hilcal.identify.poses import random_folds
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The fitted model's part of the regression, ready to score families.

    Attributes:
        fit: the fit.
        rows: (R, K) whitened Jacobian of the model, identifiable coordinates.
        factor: Cholesky factor of H.
        yy: ‖r‖².
        left_out: the same of poses predicted without themselves.
    """

    fit: Fit
    rows: Floats
    factor: tuple[Floats, bool]
    yy: float
    left_out: float

    def free(self, x: Floats) -> Floats:
        """Return X − B H⁻¹ Bᵀ X for whitened columns X (R, P)."""
        if self.rows.shape[1] == 0:
            return x
        return np.asarray(x - self.rows @ sl.cho_solve(self.factor, self.rows.T @ x))

    def score(self, x: Floats) -> Score:
        """Score whitened columns X (R, P)."""
        return score(x.T @ self.free(x), x.T @ self.fit.white, self.yy, self.fit.dof)

    def misfit(self) -> float:
        """‖r‖² − dof, the part that noise does not explain, at least three of its σ."""
        dof = self.fit.dof
        return float(max(self.yy - dof, 3 * np.sqrt(2 * dof)))

    def share(self, gain: float) -> float:
        """Share of the misfit that a reduction of ‖r‖² is, within [0, 1]."""
        return float(np.clip(gain / self.misfit(), 0.0, 1.0))

    def held_out_share(self, x: Floats, found: Score) -> float:
        """Share of the misfit explained on poses left out; negative where it misleads.

        Model and family are both refitted without the fold: the residual of a fit to all poses
        would already know of those left out.

        Args:
            x: (R, P) whitened columns of the family.
            found: their score, for the strength of the prior.
        """
        if found.rank == 0:
            return 0.0
        fit, s = self.fit, self.fit.solution
        ridge = np.concatenate(
            [
                fold_ridge(s.equations, s.beta),
                np.full(x.shape[1], self.yy / (fit.dof * found.strength**2)),
            ]
        )
        rows = np.concatenate([self.rows, x], axis=1)
        gram = rows.T @ rows
        rhs = rows.T @ fit.white
        # Steps start from the fit, where its priors pull already.
        pull = s.beta * s.equations.basis.prior_precision * s.equations.solve(s.beta)
        rhs[: len(pull)] -= pull
        gram[np.diag_indices_from(gram)] += ridge
        fold = fit.whitening.rows_of(random_folds(fit.pose))
        left = 0.0
        for f in range(int(fold.max()) + 1):
            out, r = rows[fold == f], fit.white[fold == f]
            h, b = gram - out.T @ out, rhs - out.T @ r
            step = sl.solve(h, b, assume_a="pos", check_finite=False)
            left += float(np.sum((r - out @ step) ** 2))
        noise = fit.whitening.rank
        misfit = max(self.left_out - noise, 3 * np.sqrt(2 * noise))
        return float(np.clip((self.left_out - left) / misfit, -1.0, 1.0))


def projection(fit: Fit) -> Projection:
    """Prepare the scoring of families against a gc-scaled fit."""
    s = fit.solution
    left_out = fit.whitening.whiten(fit.left_out)
    return Projection(
        fit,
        s.rows,
        s.equations.factor(s.beta),
        float(fit.white @ fit.white),
        float(np.sum(left_out**2)),
    )
