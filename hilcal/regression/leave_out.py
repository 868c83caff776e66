"""Prediction of rows that are left out, with the model and a family of columns refitted.

Each fold is left out by one Gauss-Newton step from the fit to all rows, with the fold's rows
subtracted exactly from the normal equations.

A single pose may be the only one that determines a direction. A flat estimate along this direction
from the other poses would be noise, magnified without limit, and one such pose would dominate the
error. So without a fold the flat parameters have a prior about zero (empirical Bayes), whose
standard deviation is their magnitude in the full fit: a direction that the other rows determine to
1/s of this magnitude shrinks by the share 1/(1 + s²).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from hilcal.regression.normal_equations import NormalEquations
from hilcal.regression.schur import Projection, inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

LEAST_GAIN = 0.002
"""Share by which the rms error on poses left out must fall for an effect to stay ..."""
STANDARD_ERRORS = 2.0
"""... and the number of standard errors, from pose to pose, or the same level by signed ranks."""
FEWEST_POSES = 8  # least number of poses for the test by ranks
ROUNDING = 1e-6  # ridge of flat directions, whose gram is the identity
FAMILY_ROUNDING = 1e-10  # least ridge of a family, as a share of the largest square of a column


def improves(before: Floats, after: Floats, standard_errors: float = STANDARD_ERRORS) -> bool:
    """Return whether squared whitened residuals (P,) of poses left out became smaller.

    The gain must exceed `standard_errors` standard errors from pose to pose, or the same level by
    Wilcoxon's signed ranks (Biometrics Bulletin 1 (1945) 80-83), as the mean scatters where few
    poses gain very much.
    """
    if float(np.sum(after)) >= (1 - LEAST_GAIN) ** 2 * float(np.sum(before)):
        return False
    gain = before - after
    error = float(np.std(gain)) / np.sqrt(max(len(gain) - 1, 1))
    if float(np.mean(gain)) > standard_errors * error:
        return True
    if np.count_nonzero(gain) < FEWEST_POSES:
        return False
    return float(scipy.stats.wilcoxon(gain, alternative="greater").pvalue) < float(
        scipy.stats.norm.sf(standard_errors)
    )


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """The model's normal equations without one fold."""

    left_out_rows: Bools  # (R,) rows of the fold
    inverse_root: Floats  # (K, K) T with Tᵀ T = H⁻¹ of the other rows
    rhs: Floats  # (K,) right-hand side of the other rows, for a step from the fit

    def step(self) -> Floats:
        """Return (K,) coordinates without the fold minus those with it."""
        return np.asarray(self.inverse_root.T @ (self.inverse_root @ self.rhs))


@dataclass(frozen=True, slots=True, eq=False)
class LeftOutResidual:
    """Residual of each row, predicted by the model that is fitted without the row's fold."""

    y: Floats  # (R, ...) residual before the change of the parameters without each fold
    solved: tuple[Floats, ...]  # (K, ...) T b of each fold: Tᵀ T b is that change
    residual: Floats  # (R, ...) residual after it

    def plus(self, other: "LeftOutResidual", factor: float) -> "LeftOutResidual":
        """Return that of y plus `factor` times the other y: all is linear in y."""
        pairs = zip(self.solved, other.solved, strict=True)
        return LeftOutResidual(
            self.y + factor * other.y,
            tuple(a + factor * b for a, b in pairs),
            self.residual + factor * other.residual,
        )


@dataclass(frozen=True, eq=False)
class ModelFolds:
    """A model without each of several folds."""

    projection: Projection  # of the model's columns B
    folds: tuple[Fold, ...]

    @cached_property
    def rows(self) -> tuple[Floats, ...]:
        """B (R_f, K) in the rows of each fold."""
        return tuple(self.projection.rows[f.left_out_rows] for f in self.folds)

    def left_out(self, y: Floats, of_fit: bool = False) -> LeftOutResidual:
        """Predict each row without its fold.

        y (R, ...) are residuals of a model with the parameters zero, or the residual `of_fit`.
        """
        total, residual = self.projection.rows.T @ y, y.copy()
        solved = []
        for fold, rows in zip(self.folds, self.rows, strict=True):
            out = fold.left_out_rows
            rhs = fold.rhs if of_fit else total - rows.T @ y[out]
            solved.append(fold.inverse_root @ rhs)
            residual[out] -= rows @ (fold.inverse_root.T @ solved[-1])
        return LeftOutResidual(y, tuple(solved), residual)


def folds(
    p: Projection,  # the fit's columns by identifiable coordinates, with the ridge of its priors
    white: Floats,  # (R,) whitened residual of the fit
    equations: NormalEquations,  # of the fit, over all parameters
    theta: Floats,  # (P,) parameters of the fit
    prior: Floats,  # (P,) their prior standard deviations, infinite for flat ones
    magnitude: Floats,  # (P,) prior standard deviations of flat parameters without a fold
    beta: float,  # noise variance factor that multiplies the prior precisions
    fold: Ints,  # (R,) fold of each row, from 0
) -> ModelFolds:
    """Return for each fold the normal equations of a step from the fit without it."""
    basis = equations.basis
    flat, held = slice(0, len(basis.singular)), basis.with_prior
    h = equations.gram + np.diag(p.ridge + np.where(p.ridge > 0, 0.0, ROUNDING))
    per_magnitude = basis.transform[:, flat] / magnitude[:, None]
    h[flat, flat] += beta * per_magnitude.T @ per_magnitude
    pull = np.zeros(len(h))
    pull[flat] = per_magnitude.T @ (np.where(basis.flat, theta, 0.0) / magnitude)
    pull[flat.stop :] = theta[held] / prior[held]
    rhs = p.rows.T @ white - beta * pull

    def without(f: int) -> Fold:
        out = fold == f
        rows = p.rows[out]
        root = inverse_root(h - rows.T @ rows)
        return Fold(out, root, rhs - rows.T @ white[out])

    return ModelFolds(p, tuple(without(f) for f in range(int(fold.max()) + 1)))


class FamilyFolds:
    """A model without each fold, and a family X (R, F); products of columns are formed once."""

    def __init__(self, model: ModelFolds, x: Floats) -> None:
        self._x, self._model = x, model
        parts = [x[f.left_out_rows] for f in model.folds]
        grams = [part.T @ part for part in parts]
        crosses = [rows.T @ part for rows, part in zip(model.rows, parts, strict=True)]
        self.gram, self.cross = sum(grams, np.zeros(())), sum(crosses, np.zeros(()))  # XᵀX, BᵀX
        self._rounding = FAMILY_ROUNDING * float(self.gram.max(initial=0.0))
        self._products = []  # T BᵀX and Xᵀ M X of the other rows
        for fold, gram, cross in zip(model.folds, grams, crosses, strict=True):
            c = fold.inverse_root @ (self.cross - cross)
            self._products.append((c, self.gram - gram - c.T @ c))

    def left_out(self, by_model: LeftOutResidual, ridge: float = 0.0) -> Floats:
        """Return the residual (R, ...) of each row, predicted without its fold.

        The family is fitted in addition to the model, whose residual is `by_model`; its parameters
        have the prior precision `ridge`, in units of the noise.
        """
        x, y, left = self._x, by_model.y, by_model.residual.copy()
        rhs = x.T @ y
        for fold, model_rows, steps, (c, gram) in zip(
            self._model.folds, self._model.rows, by_model.solved, self._products, strict=True
        ):
            rows = fold.left_out_rows
            h, b = gram.copy(), rhs - x[rows].T @ y[rows] - c.T @ steps
            h[np.diag_indices_from(h)] += max(ridge, self._rounding)
            family = positive_solve(h, b)
            left[rows] += model_rows @ (fold.inverse_root.T @ (c @ family)) - x[rows] @ family
        return left
