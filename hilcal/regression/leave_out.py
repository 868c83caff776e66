"""Paired test of the errors on poses left out, before and after a change of the model.

----

Prediction of rows that are left out, with the model and a family of columns refitted.

Each fold is refitted by one Gauss-Newton step from the fit to all rows, in which the fold's rows
are taken out of the normal equations exactly. A residual of the fit to all rows would already know
of those left out.

A single pose may be the only one that determines a direction. A flat estimate along it from the
other poses would be noise, magnified without limit, and one such pose would outweigh all others in
the error. So without a fold the flat parameters have a prior about zero (empirical Bayes), whose
standard deviation is their magnitude in the full fit. A direction that the other rows determine to
1/s of this magnitude shrinks by the share 1/(1 + s²): not at all where it is well determined, to
the model without it where it is not.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import norm, wilcoxon

from hilcal.regression.normal_equations import NormalEquations
from hilcal.regression.projection import Projection
from hilcal.regression.schur import inverse_root, positive_solve
from hilcal.types import Bools, Floats, Ints

LEAST_GAIN = 0.002
"""Share by which the rms error on poses left out must fall for an effect to stay ..."""
SURE = 2.0
"""... and by how many of its standard errors, from pose to pose; or as surely by its ranks."""
FEWEST = 8  # poses from which ranks are judged


def improves(before: Floats, after: Floats, sure: float = SURE) -> bool:
    """Compare the squared whitened residuals of poses (P,), each predicted without itself.

    The gain must be certain from pose to pose: by its mean, or where few poses gain very much
    (then the mean scatters, however sure the gain is) by Wilcoxon's signed ranks, at the same
    level. Source: Wilcoxon, *Individual comparisons by ranking methods*, Biometrics Bulletin 1
    (1945) 80-83.

    Args:
        before: (P,) of the model as it was.
        after: (P,) of the changed one.
        sure: how many standard errors the gain must be.
    """
    if float(np.sum(after)) >= (1 - LEAST_GAIN) ** 2 * float(np.sum(before)):
        return False
    gain = before - after
    error = float(np.std(gain)) / np.sqrt(max(len(gain) - 1, 1))
    if float(np.mean(gain)) > sure * error:
        return True
    if np.count_nonzero(gain) < FEWEST:
        return False
    return float(wilcoxon(gain, alternative="greater").pvalue) < float(norm.sf(sure))


ROUNDING = 1e-6  # ridge of flat directions, whose gram is the identity
SMALL = 48
"""Parameters of a family up to which it is solved for in all folds at once; a choice by timing."""
FAMILY_ROUNDING = 1e-10  # least ridge of a family, as a share of the largest square of a column


@dataclass(frozen=True, slots=True, eq=False)
class Fold:
    """The model's normal equations without one fold."""

    out: Bools  # (R,) rows of the fold
    inverse_root: Floats  # (K, K) T with Tᵀ T = H⁻¹ without them
    rhs: Floats  # (K,) right-hand side without them, for a step from the fit

    def rows(self, p: Projection) -> Floats:
        """Return the model's columns in the rows of the fold."""
        return np.asarray(p.rows[self.out])

    def solve(self, rhs: Floats) -> Floats:
        """Return H⁻¹ times (K,) or (K, P)."""
        return np.asarray(self.inverse_root.T @ (self.inverse_root @ rhs))

    def step(self) -> Floats:
        """Return (K,) coordinates without the fold minus those with it."""
        return self.solve(self.rhs)


def folds(
    p: Projection,  # the fit's columns by identifiable coordinates, with the ridge of its priors
    white: Floats,  # (R,) its whitened residual
    equations: NormalEquations,  # its normal equations, over all parameters
    theta: Floats,  # (P,) its parameters
    prior: Floats,  # (P,) their prior standard deviations, infinite for flat ones
    magnitude: Floats,  # (P,) standard deviations that flat parameters have without a fold
    beta: float,  # noise variance factor that priors are weighed against
    fold: Ints,  # (R,) fold of each row, from 0
) -> tuple[Fold, ...]:
    """Return the normal equations of a step from a fit without each fold."""
    basis = equations.basis
    flat, held = slice(0, len(basis.singular)), basis.held
    h = equations.gram + np.diag(p.ridge + np.where(p.ridge > 0, 0.0, ROUNDING))
    per_magnitude = basis.transform[:, flat] / magnitude[:, None]
    h[flat, flat] += beta * per_magnitude.T @ per_magnitude
    pull = np.zeros(len(h))
    pull[flat] = per_magnitude.T @ (np.where(basis.flat, theta, 0.0) / magnitude)
    pull[flat.stop :] = theta[held] / prior[held]
    rhs = p.rows.T @ white - beta * pull

    def without(f: int) -> Fold:
        mine = fold == f
        rows = p.rows[mine]
        root = inverse_root(h - rows.T @ rows)
        return Fold(mine, root, rhs - rows.T @ white[mine])

    return tuple(without(f) for f in range(int(fold.max()) + 1))


def left_out_residual(
    folds: tuple[Fold, ...],
    p: Projection,
    white: Floats,  # (R,) residual of the model fitted to all rows
    x: Floats | None = None,  # (R, F) whitened columns of the family; None for the model alone
    ridge: float = 0.0,
) -> Floats:
    """Return the residual (R,) of each row, predicted without its fold by model and family."""
    if x is None:
        left = np.zeros(len(white))
        for fold in folds:
            left[fold.out] = white[fold.out] - fold.rows(p) @ fold.step()
        return left
    return left_out_of_families(
        folds, p, white, [(of, ridge) for of in family_products(folds, p, white, [x])]
    )[0]


@dataclass(frozen=True, slots=True, eq=False)
class FamilyProducts:
    """Products of a family's columns with themselves and with the model's, in each fold.

    Their sums over the folds serve the tests of the whole family.
    """

    x: Floats  # (R, F) whitened columns
    parts: tuple["_Products", ...]  # of each fold
    whole: "_Products"  # of all rows


def family_products(
    folds: tuple[Fold, ...], p: Projection, white: Floats, families: Iterable[Floats]
) -> list[FamilyProducts]:
    """Form the products of families of whitened columns (R, F).

    Args:
        folds: of the model; each row is in one.
        white: (R,) residual of the model fitted to all rows.
        families: X of each.
    """
    every = list(families)

    def products(fold: Fold) -> list[_Products]:
        own, y = fold.rows(p), white[fold.out]
        return [_Products.of(own, x[fold.out], y) for x in every]

    by_fold = [products(fold) for fold in folds]
    return [
        FamilyProducts(x, parts, _Products.sum(parts))
        for x, parts in zip(every, zip(*by_fold, strict=True), strict=True)
    ]


def left_out_of_families(
    folds: tuple[Fold, ...],
    p: Projection,
    white: Floats,  # (R,) residual of the model fitted to all rows
    families: Sequence[tuple[FamilyProducts, float]],
) -> list[Floats]:
    """Return `left_out_residual` (R,) of each family, each beside the model by itself."""
    found = [np.zeros(len(white)) for _ in families]
    small = [_in_all_folds(folds, of, ridge) for of, ridge in families]

    for f, fold in enumerate(folds):
        out, own = fold.out, fold.rows(p)
        for (of, ridge), left, known in zip(families, found, small, strict=True):
            back, step = known[f] if known else _without(fold, of.whole, of.parts[f], ridge)
            left[out] = white[out] - own @ back - of.x[out] @ step
    return found


def _in_all_folds(
    folds: tuple[Fold, ...], of: FamilyProducts, ridge: float
) -> list[tuple[Floats, Floats]]:
    """Return `_without` of each fold; nothing where the family is not small."""
    if of.x.shape[1] > SMALL:
        return []
    root = np.stack([fold.inverse_root for fold in folds])
    along = root @ (of.whole.cross - np.stack([own.cross for own in of.parts]))
    across = np.swapaxes(along, 1, 2)
    size = (root @ np.stack([fold.rhs for fold in folds])[..., None])[..., 0]
    h = of.whole.gram - np.stack([own.gram for own in of.parts]) - across @ along
    each = np.arange(h.shape[1])
    h[:, each, each] += _least_ridge(of.whole, ridge)
    rhs = of.whole.rhs - np.stack([own.rhs for own in of.parts])
    inverse = inverse_root(h)
    known = inverse @ (rhs[..., None] - across @ size[..., None])
    step = (np.swapaxes(inverse, 1, 2) @ known)[..., 0]
    back = np.swapaxes(root, 1, 2) @ (size[..., None] - along @ step[..., None])
    return list(zip(back[..., 0], step, strict=True))


def _least_ridge(whole: "_Products", ridge: float) -> float:
    """Ridge of a family, at least what rounding asks for."""
    return max(ridge, FAMILY_ROUNDING * float(np.diagonal(whole.gram).max(initial=0.0)))


def _without(
    fold: Fold, whole: "_Products", own: "_Products", ridge: float
) -> tuple[Floats, Floats]:
    """Return the steps (K,) of the model and (F,) of a family without a fold."""
    # Eliminate the model's own coordinates, then solve for the family.
    along = fold.inverse_root @ (whole.cross - own.cross)
    size = fold.inverse_root @ fold.rhs
    h = along.T @ along
    np.subtract(whole.gram, h, out=h)
    h -= own.gram
    h[np.diag_indices_from(h)] += _least_ridge(whole, ridge)
    step = positive_solve(h, whole.rhs - own.rhs - along.T @ size)
    return fold.inverse_root.T @ (size - along @ step), step


@dataclass(frozen=True, slots=True, eq=False)
class _Products:
    """BᵀX, XᵀX and Xᵀr of some rows."""

    cross: Floats
    gram: Floats
    rhs: Floats

    @classmethod
    def of(cls, rows: Floats, x: Floats, white: Floats) -> "_Products":
        """Form them."""
        return cls(rows.T @ x, x.T @ x, x.T @ white)

    @classmethod
    def sum(cls, of: Sequence["_Products"]) -> "_Products":
        """Return those of the rows of all."""
        first = of[0]
        out = cls(first.cross.copy(), first.gram.copy(), first.rhs.copy())
        for more in of[1:]:
            np.add(out.cross, more.cross, out=out.cross)
            np.add(out.gram, more.gram, out=out.gram)
            np.add(out.rhs, more.rhs, out=out.rhs)
        return out


class FamilyFolds:
    """Model and family without each fold, for any residuals and ridges: products formed once."""

    def __init__(self, folds: tuple[Fold, ...], p: Projection, x: Floats | None = None) -> None:
        """Form the products."""
        self._x = x = np.zeros((len(p.rows), 0)) if x is None else x
        self._folds, self._p = folds, p
        gram, cross = x.T @ x, p.rows.T @ x
        self._rounding = FAMILY_ROUNDING * float(gram.max(initial=0.0))
        self._of = []
        for fold in folds:
            out = x[fold.out]
            c = cross - fold.rows(p).T @ out
            at = fold.solve(c)
            self._of.append((c, at, gram - out.T @ out - c.T @ at))

    def left_out(self, y: Floats, ridge: float = 0.0) -> Floats:
        """Return `left_out_residual` (R, K) of K residuals of models at zero, as simulated ones.

        Args:
            y: (R, K) what remains where all parameters are zero.
        """
        x, p = self._x, self._p
        total, rhs = p.rows.T @ y, x.T @ y
        least = max(ridge, self._rounding)
        left = np.zeros(y.shape)
        for fold, (c, at, gram) in zip(self._folds, self._of, strict=True):
            out, own, r = x[fold.out], fold.rows(p), y[fold.out]
            steps = fold.solve(total - own.T @ r)
            left[fold.out] = r - own @ steps
            if x.shape[1]:
                h, b = gram.copy(), rhs - out.T @ r - c.T @ steps
                h[np.diag_indices_from(h)] += least
                family = positive_solve(h, b)
                left[fold.out] += own @ (at @ family) - out @ family
        return left


def left_out_residuals(
    folds: tuple[Fold, ...],
    p: Projection,
    y: Floats,
    x: Floats | None = None,
    ridge: float = 0.0,
) -> Floats:
    """Return `FamilyFolds.left_out` (R, K) of residuals y (R, K)."""
    return FamilyFolds(folds, p, x).left_out(y, ridge)
