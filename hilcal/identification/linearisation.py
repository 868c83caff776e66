"""The linearisation of a fit: evidence and predictions of effects that are not in the model.

The ranking of effects that could be missing and the planning of measurements that separate them
both use it, so that the planner's power and the diagnosis's test are of the same information.

A fitted linear model without some of its columns; no refit is needed.

With A the whitened columns that stay, H = AᵀA + β diag(1/σ²) and y the residual that the
eliminated columns are part of,

    r₀ = y − A H⁻¹ Aᵀ y

is the residual that the eliminated columns are scored by, and so is what could replace them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from hilcal.identification.effect_columns import EffectColumns
from hilcal.identification.fit import Fit
from hilcal.identification.folds import folds_of, random_folds
from hilcal.identification.gauss_newton import columns_of
from hilcal.identification.priors import scales_of
from hilcal.regression.evidence import FamilyScore, Spectrum, score_family
from hilcal.regression.leave_out import (
    FamilyProducts,
    Fold,
    family_products,
    improves,
    left_out_of_families,
    left_out_residual,
)
from hilcal.regression.normal_equations import Basis, find_basis, normal_equations
from hilcal.regression.projection import Projection
from hilcal.types import Bools, Floats, Ints

LEAST_MISFIT = 3.0  # standard deviations of χ² that a misfit counts as at least; a choice


@dataclass(frozen=True, slots=True, eq=False)
class ReducedModel:
    """A model without some of its columns, which are not copied: they can be many."""

    columns: Floats  # (R, P) all columns of the model
    out: Bools  # (P,) the eliminated ones
    basis: Basis  # coordinates of those that stay, flat ones first
    flat: Floats  # (R, F) rows by the flat coordinates
    inverse_root: Floats  # (K, K) T with Tᵀ T = H⁻¹
    gram: Floats  # (P, P) of all columns
    residual: Floats  # (R,) r₀
    dof: float  # degrees of freedom of r₀

    @property
    def rss(self) -> float:
        """‖r₀‖²."""
        return float(self.residual @ self.residual)

    def information(self, x: Floats, gram: Floats, products: Floats) -> Floats:
        """Return Xᵀ M X (Q, Q), M the projection off the columns that stay.

        Of whitened columns X (R, Q), with XᵀX (Q, Q) and products (P, Q) of the model's with X.
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


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Reduction of the held-out error by a family."""

    share: float  # of the misfit; negative where it makes predictions worse
    sure: bool  # whether the error falls by more than it scatters from pose to pose


@dataclass(frozen=True, eq=False)
class Linearisation:
    """A gc-scaled fit as a linear problem."""

    fit: Fit
    projection: Projection  # M, off the columns of the fitted model
    residual: Floats  # (R,) whitened residual r, after the remaining step of the model

    @property
    def rows(self) -> Floats:
        """(R, K) whitened Jacobian of the model by identifiable coordinates."""
        return self.projection.rows

    @cached_property
    def rss(self) -> float:
        """‖r‖²."""
        return float(self.residual @ self.residual)

    @cached_property
    def left_out(self) -> Floats:
        """(poses,) squared whitened residual of each pose, predicted without it.

        With the strengths of the fit, as `held_out` predicts with one family more; those of
        `Fit.left_out` are chosen without the pose.
        """
        white = left_out_residual(self.folds, self.projection, self.fit.white)
        return by_pose(self.fit, white)

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """The model without each fold of poses."""
        fit = self.fit
        return folds_of(fit.model, fit.solution, fit.whitening.rows_of(random_folds(fit.pose)))

    def project_out(self, x: Floats) -> Floats:
        """Return M X of whitened columns X (R, P)."""
        return self.projection.project_out(x)

    def information(self, x: Floats | FamilyProducts) -> Floats:
        """Return S = Xᵀ M X (P, P) of whitened columns X (R, P), or of their products."""
        if isinstance(x, FamilyProducts):
            return self.projection.schur(x.whole.gram, x.whole.cross)
        return self.projection.information(x)

    def products(self, families: Iterable[Floats]) -> list[FamilyProducts]:
        """Return the products of families of whitened columns, which `held_out` needs."""
        return family_products(self.folds, self.projection, self.fit.white, families)

    def score(
        self, x: Floats, s: Floats | Spectrum | None = None, most: float = np.inf
    ) -> FamilyScore:
        """Score whitened columns X (R, P) beside the model.

        Args:
            x: X.
            s: (P, P) S where it is known, or its spectrum.
            most: largest plausible strength.
        """
        s = self.information(x) if s is None else s
        return self.score_of(s, x.T @ self.residual, most)

    def score_of(self, s: Floats | Spectrum, g: Floats, most: float = np.inf) -> FamilyScore:
        """Score a family by S, or its spectrum, and g = Xᵀ r (P,); see `families`."""
        return score_family(s, g, self.rss, self.fit.dof, most=most)

    def families(self, columns: Sequence[EffectColumns]) -> list[tuple[Floats, Floats]]:
        """Return S (P, P) and g = Xᵀ r (P,) of effects whose columns were whitened together."""
        if not columns:
            return []
        own = np.column_stack([self.rows, self.residual])
        of_all = own.T @ columns[0].together
        out = []
        for of in columns:
            both = of_all[:, of.within]
            lifted = self.projection.inverse_root @ both[:-1]
            out.append((of.white.T @ of.white - lifted.T @ lifted, both[-1]))
        return out

    def misfit(self) -> float:
        """‖r‖² − dof, the misfit beyond the noise, at least `LEAST_MISFIT` of its σ."""
        dof = self.fit.dof
        return float(max(self.rss - dof, LEAST_MISFIT * np.sqrt(2 * dof)))

    def share(self, gain: float) -> float:
        """Share of the misfit that a reduction of ‖r‖² is, within [0, 1]."""
        return float(np.clip(gain / self.misfit(), 0.0, 1.0))

    def held_out(self, families: Sequence[tuple[FamilyProducts, FamilyScore]]) -> list[HeldOut]:
        """Return the reductions of the held-out error by families, each beside the model by itself.

        A family is its products and its score, for the ridge; see `regression.leave_out`.
        """
        seen = [(of, found.ridge) for of, found in families if found.rank]
        left = iter(left_out_of_families(self.folds, self.projection, self.fit.white, seen))
        return [
            self._held_out(next(left)) if found.rank else HeldOut(0.0, False)
            for _, found in families
        ]

    def _held_out(self, left: Floats) -> HeldOut:
        """Compare residuals (R,) predicted without their poses with those of the model alone."""
        noise = self.fit.whitening.rank
        before, after = self.left_out, by_pose(self.fit, left)
        misfit = max(float(before.sum()) - noise, LEAST_MISFIT * np.sqrt(2 * noise))
        gain = float(before.sum() - after.sum())
        return HeldOut(float(np.clip(gain / misfit, -1.0, 1.0)), improves(before, after))


def linearise(fit: Fit) -> Linearisation:
    """Return the linearisation of a gc-scaled fit."""
    s = fit.solution
    off = s.projection()
    return Linearisation(fit, off, off.residual(s.white, s.coordinates()))


@dataclass(frozen=True, slots=True, eq=False)
class ModelColumns:
    """The columns of a fitted model in ordinary magnitudes of its parameters.

    Parameters that are held at zero have no column, unless a test of their effect needs it
    (`Effect.for_scoring`). With a carried prior, columns are derivatives by the coordinates in
    which that prior is independent.
    """

    parameter: Ints  # (L,) indices of the parameters, or coordinates, ascending
    scale: Floats  # (L,) ordinary magnitudes, SI
    white: Floats  # (R, L) whitened columns
    gram: Floats  # (L, L) their products


def model_columns(fit: Fit) -> ModelColumns:
    """Return the columns of a fitted model."""
    model, s, w = fit.model, fit.solution, fit.whitening
    states = s.prediction.situation.states
    scored: list[bool] = []
    for effect in model.effects:
        names = {p.name for p in effect.for_scoring(states).parameters}
        scored += [p.name in names for p in effect.parameters]
    carried = s.space.carried(model.size)
    kept = (s.prior > 0) | (np.array(scored, dtype=np.bool_) & ~carried)
    parameter = np.flatnonzero(kept)
    scale = s.space.scales(scales_of(model))[parameter]
    columns = columns_of(model, s.space, s.prediction, s.theta, w, parameter) * scale
    return ModelColumns(parameter, scale, columns, columns.T @ columns)


def eliminate_effect(fit: Fit, columns: ModelColumns, effect: str) -> ReducedModel:
    """Take an effect of its model out of a fit, at the same linearisation."""
    place = fit.model.slices()[fit.model.names.index(effect)]
    index, scale, s = columns.parameter, columns.scale, fit.solution
    theta, prior = s.y[index] / scale, s.prior[index] / scale
    out = (index >= place.start) & (index < place.stop)
    return eliminate_columns(
        columns.white, columns.gram, fit.white, theta, prior, out, s.beta, fit.whitening.rank
    )


def by_pose(fit: Fit, white: Floats) -> Floats:
    """(poses,) sums of squared whitened residuals (R,)."""
    squares = np.sum(white.reshape(len(fit.pose), -1) ** 2, axis=1)
    return np.asarray(np.bincount(fit.pose, weights=squares), dtype=float)


def left_out_by_pose(fit: Fit) -> Floats:
    """(poses,) squared whitened residual of each pose, predicted without it."""
    return by_pose(fit, fit.whitening.whiten(fit.left_out).reshape(-1))


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
    """Take some (P,) of the whitened columns A (R, P), with gram AᵀA, out of a fitted model.

    Of the fit: whitened residual (R,), parameters (P,) and their prior standard deviations,
    infinite for flat ones, zero for held ones; noise factor, and rank: rows with information.
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
