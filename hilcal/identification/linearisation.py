"""The linearisation of a fit: evidence and predictions of effects that are not in the model.

The ranking of effects that could be missing and the planning of measurements that separate them
both use it, so that the power of the plan and the test of the diagnosis have the same information.

A column can also be eliminated from a fitted model without a refit. With A the whitened columns
that stay, H = AᵀA + β diag(1/σ²), and y the residual plus the contribution of the eliminated
columns,

    r₀ = y − A H⁻¹ Aᵀ y

is the residual against which the eliminated columns, and columns that could replace them, are
scored.
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
from hilcal.regression.leave_out import FamilyFolds, Fold, improves
from hilcal.regression.normal_equations import Basis, find_basis, normal_equations
from hilcal.regression.projection import Projection
from hilcal.types import Bools, Floats, Ints

LEAST_MISFIT = 3.0  # least value of a misfit, in standard deviations of χ²; a choice


@dataclass(frozen=True, slots=True, eq=False)
class ReducedModel:
    """A fitted linear model with some of its columns eliminated; columns are not copied."""

    columns: Floats  # (R, P) all columns of the model
    out: Bools  # (P,) eliminated columns
    basis: Basis  # coordinates of the columns that stay, flat ones first
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

        Args:
            x: (R, Q) whitened columns X.
            gram: (Q, Q) XᵀX.
            products: (P, Q) of the model's columns with X.
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
        # Products with all columns, as selecting columns would copy them.
        flat = (self.flat.T @ self.columns)[:, self.out]
        s = self._information(flat, products[self.out], products)
        slope = (self.columns.T @ self.residual)[self.out]
        return score_family(s, slope, self.rss, self.dof)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Reduction of the held-out error by a family."""

    share: float  # of the misfit; negative where predictions become worse
    sure: bool  # whether the reduction is significant against the scatter from pose to pose


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

        The strengths are those of the fit, as in `held_out`; `Fit.left_out` has strengths chosen
        without the pose.
        """
        model = FamilyFolds(self.folds, self.projection)
        return by_pose(self.fit, model.left_out(self.fit.white, of_fit=True))

    @cached_property
    def folds(self) -> tuple[Fold, ...]:
        """The model without each fold of poses."""
        fit = self.fit
        return folds_of(fit.model, fit.solution, fit.whitening.rows_of(random_folds(fit.pose)))

    def project_out(self, x: Floats) -> Floats:
        """Return M X of whitened columns X (R, P)."""
        return self.projection.project_out(x)

    def information(self, x: Floats | FamilyFolds) -> Floats:
        """Return S = Xᵀ M X (P, P) of whitened columns X (R, P), or of their products."""
        if isinstance(x, FamilyFolds):
            return self.projection.schur(x.gram, x.cross)
        return self.projection.information(x)

    def products(self, families: Iterable[Floats]) -> list[FamilyFolds]:
        """Return the products of families of whitened columns, for `held_out`."""
        return [FamilyFolds(self.folds, self.projection, x) for x in families]

    def score(
        self, x: Floats, s: Floats | Spectrum | None = None, most: float = np.inf
    ) -> FamilyScore:
        """Score whitened columns X (R, P) as an addition to the model.

        Args:
            x: X.
            s: (P, P) S or its spectrum, if computed before.
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
        model_rows = np.column_stack([self.rows, self.residual])
        products = model_rows.T @ columns[0].together
        out = []
        for c in columns:
            of_effect = products[:, c.within]
            lifted = self.projection.inverse_root @ of_effect[:-1]
            out.append((c.white.T @ c.white - lifted.T @ lifted, of_effect[-1]))
        return out

    def misfit(self) -> float:
        """‖r‖² − dof, the misfit beyond the noise, at least `LEAST_MISFIT` times its σ."""
        dof = self.fit.dof
        return float(max(self.rss - dof, LEAST_MISFIT * np.sqrt(2 * dof)))

    def share(self, gain: float) -> float:
        """Return a reduction of ‖r‖² as a share of the misfit, within [0, 1]."""
        return float(np.clip(gain / self.misfit(), 0.0, 1.0))

    def held_out(self, families: Sequence[tuple[FamilyFolds, FamilyScore]]) -> list[HeldOut]:
        """Return the reduction of the held-out error by each family, with its score's ridge."""
        noise, before = self.fit.whitening.rank, self.left_out
        misfit = max(float(before.sum()) - noise, LEAST_MISFIT * np.sqrt(2 * noise))
        out = []
        for family, score in families:
            if not score.rank:
                out.append(HeldOut(0.0, False))
                continue
            after = by_pose(self.fit, family.left_out(self.fit.white, score.ridge, of_fit=True))
            gain = float(before.sum() - after.sum())
            share = float(np.clip(gain / misfit, -1.0, 1.0))
            out.append(HeldOut(share, improves(before, after)))
        return out


def linearise(fit: Fit) -> Linearisation:
    """Return the linearisation of a gc-scaled fit."""
    s = fit.solution
    projection = s.projection()
    return Linearisation(fit, projection, projection.residual(s.white, s.coordinates()))


@dataclass(frozen=True, slots=True, eq=False)
class ModelColumns:
    """The columns of a fitted model in ordinary magnitudes of its parameters.

    Parameters held at zero have no column, unless a test of their effect needs it
    (`Effect.for_scoring`). With a carried prior, columns are derivatives by the coordinates in
    which the prior is independent.
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
    parameter = np.flatnonzero((s.prior > 0) | (np.array(scored, dtype=np.bool_) & ~carried))
    scale = s.space.scales(scales_of(model))[parameter]
    columns = columns_of(model, s.space, s.prediction, s.theta, w, parameter) * scale
    return ModelColumns(parameter, scale, columns, columns.T @ columns)


def eliminate_effect(fit: Fit, columns: ModelColumns, effect: str) -> ReducedModel:
    """Eliminate an effect of the model from a fit, at the same linearisation."""
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
    """Eliminate columns from a fitted linear model.

    Args:
        columns: (R, P) whitened columns A.
        gram: (P, P) AᵀA.
        white: (R,) whitened residual of the fit.
        theta: (P,) parameters of the fit.
        prior: (P,) prior standard deviations, infinite for flat parameters, zero for held ones.
        out: (P,) columns to eliminate.
        beta: noise factor of the fit.
        rank: number of rows with information.
    """
    stay = ~out & (prior > 0)
    basis = find_basis(columns, np.ones(columns.shape[1]), np.where(stay, prior, 0.0))
    y = white + columns @ np.where(out, theta, 0.0)
    equations = normal_equations(columns, y, basis, gram)
    # Priors are about zero, not about the parameters of the fit.
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
