"""Columns of a family, whitened, and freed of what the fitted model can do itself."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy.linalg as sl

from hilcal.diagnose.score import Score, score
from hilcal.identify.fit import Fit
from hilcal.identify.folds import random_folds
from hilcal.identify.holdout import fold_equations
from hilcal.regression.paired_test import improves
from hilcal.types import Bools, Floats

ROUNDING = 1e-10


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """The model's normal equations without one fold.

    Attributes:
        mine: (R,) rows of the fold.
        factor: Cholesky factor of H without them.
        rhs: (K,) right-hand side without them, for a step from the fit.
    """

    mine: Bools
    factor: tuple[Floats, bool]
    rhs: Floats


@dataclass(frozen=True, slots=True)
class HeldOut:
    """What a family explains on poses left out.

    Attributes:
        share: of the misfit; negative where it misleads.
        sure: whether the error falls by more than it scatters from pose to pose.
    """

    share: float
    sure: bool


@dataclass(frozen=True, slots=True, eq=False)
class Projection:
    """The fitted model's part of the regression, ready to score families.

    Attributes:
        fit: the fit.
        rows: (R, K) whitened Jacobian of the model, identifiable coordinates.
        factor: Cholesky factor of H.
        white: (R,) whitened residual r, free of what the model itself could still explain.
        yy: ‖r‖².
        left_out: (poses,) the same of each pose, predicted without itself.
        folds: the model without each fold of poses.
    """

    fit: Fit
    rows: Floats
    factor: tuple[Floats, bool]
    white: Floats
    yy: float
    left_out: Floats
    folds: tuple[Fold, ...]

    def free(self, x: Floats) -> Floats:
        """Return X − B H⁻¹ Bᵀ X for whitened columns X (R, P)."""
        if self.rows.shape[1] == 0:
            return x
        return np.asarray(x - self.rows @ sl.cho_solve(self.factor, self.rows.T @ x))

    def score(self, x: Floats) -> Score:
        """Score whitened columns X (R, P)."""
        return self.score_of(x.T @ self.free(x), x)

    def score_of(self, s: Floats, x: Floats) -> Score:
        """Score whitened columns X (R, P) whose S = Xᵀ M X (P, P) is known."""
        return score(s, x.T @ self.white, self.yy, self.fit.dof)

    def misfit(self) -> float:
        """‖r‖² − dof, the part that noise does not explain, at least three of its σ."""
        dof = self.fit.dof
        return float(max(self.yy - dof, 3 * np.sqrt(2 * dof)))

    def share(self, gain: float) -> float:
        """Share of the misfit that a reduction of ‖r‖² is, within [0, 1]."""
        return float(np.clip(gain / self.misfit(), 0.0, 1.0))

    def held_out_share(self, x: Floats, found: Score) -> float:
        """Share of the misfit explained on poses left out; see `held_out`."""
        return self.held_out(x, found).share

    def held_out(self, x: Floats, found: Score) -> HeldOut:
        """What a family explains on poses left out.

        Model and family are both refitted without the fold: the residual of a fit to all poses
        would already know of those left out.

        Args:
            x: (R, P) whitened columns of the family.
            found: their score, for the strength of the prior.
        """
        if found.rank == 0:
            return HeldOut(0.0, False)
        white = self.fit.white
        across, gram, rhs = self.rows.T @ x, x.T @ x, x.T @ white
        precision = self.yy / (self.fit.dof * found.strength**2)
        gram[np.diag_indices_from(gram)] += max(precision, ROUNDING * float(gram.max()))
        left = np.zeros(len(white))
        for fold in self.folds:
            out, own, r = x[fold.mine], self.rows[fold.mine], white[fold.mine]
            # Eliminate the model's own coordinates, then solve for the family.
            c = across - own.T @ out
            solved = sl.cho_solve(fold.factor, np.column_stack([c, fold.rhs]), check_finite=False)
            h = gram - out.T @ out - c.T @ solved[:, :-1]
            b = rhs - out.T @ r - c.T @ solved[:, -1]
            step = sl.solve(h, b, assume_a="pos", check_finite=False)
            model_step = solved[:, -1] - solved[:, :-1] @ step
            left[fold.mine] = r - own @ model_step - out @ step
        noise = self.fit.whitening.rank
        before, after = self.left_out, by_pose(self.fit, left)
        misfit = max(float(before.sum()) - noise, 3 * np.sqrt(2 * noise))
        gain = float(before.sum() - after.sum())
        return HeldOut(float(np.clip(gain / misfit, -1.0, 1.0)), improves(before, after))


def projection(fit: Fit) -> Projection:
    """Prepare the scoring of families against a gc-scaled fit."""
    s = fit.solution
    white = s.rest()
    return Projection(
        fit,
        s.rows,
        s.equations.factor(s.beta),
        white,
        float(white @ white),
        left_out_by_pose(fit),
        tuple(_folds(fit)),
    )


def by_pose(fit: Fit, white: Floats) -> Floats:
    """(poses,) sums of squared whitened residuals (R,)."""
    squares = np.sum(white.reshape(len(fit.pose), -1) ** 2, axis=1)
    return np.asarray(np.bincount(fit.pose, weights=squares), dtype=float)


def left_out_by_pose(fit: Fit) -> Floats:
    """(poses,) squared whitened residual of each pose, predicted without it."""
    return by_pose(fit, fit.whitening.whiten(fit.left_out).reshape(-1))


def _folds(fit: Fit) -> Iterator[Fold]:
    s = fit.solution
    full, rhs = fold_equations(fit.model, s)
    of_row = fit.whitening.rows_of(random_folds(fit.pose))
    for f in range(int(of_row.max()) + 1):
        mine = of_row == f
        out = s.rows[mine]
        factor, low = sl.cho_factor(full - out.T @ out, check_finite=False)
        yield Fold(mine, (factor, bool(low)), rhs - out.T @ fit.white[mine])
