"""The linearisation of a fit: columns, evidence and predictions of effects that it lacks.

The ranking of effects that could be missing and the planning of measurements that separate them
both use it, so that the power of the plan and the test of the diagnosis have the same information.

A column can also be eliminated from a fitted model without a refit. With A the whitened columns
that stay, H = AᵀA + β diag(1/σ²), and y the residual plus the contribution of the eliminated
columns,

    r₀ = y − A H⁻¹ Aᵀ y

is the residual against which these, and columns that could replace them, are scored.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.identification.carried.carried_prior import scales_of
from hilcal.identification.fit import Fit
from hilcal.identification.folds import folds_of, random_folds
from hilcal.identification.gauss_newton import columns_of
from hilcal.readings.whitening import Whitening
from hilcal.regression.evidence import FamilyScore, Spectrum, score_family
from hilcal.regression.leave_out import FamilyFolds, LeftOutResidual, ModelFolds, improves
from hilcal.regression.normal_equations import Basis, find_basis, normal_equations
from hilcal.regression.schur import Projection
from hilcal.types import Bools, Floats, Ints

LEAST_MISFIT = 3.0  # least value of a misfit, in standard deviations of χ²; a choice
MOST_AT_ONCE = 4_000_000
"""Most numbers computed together, 32 MB; freed with the last effect of them."""


@dataclass(frozen=True, eq=False)
class EffectColumns:
    """The columns of an effect in ordinary magnitudes of its parameters."""

    effect: Effect
    scale: Floats  # (P,) ordinary magnitudes, SI
    white_of_all: Floats  # (R, Q) columns of all effects whitened together
    columns: slice  # the P columns of this effect
    motion_of_readings: Floats  # (N, m, P) motion of the fitted readings, sensor axes, m and rad
    whitening: Whitening  # of the readings
    unloaded: Bools  # (N,) unloaded readings

    @property
    def white(self) -> Floats:
        """(R, P) whitened columns."""
        return self.white_of_all[:, self.columns]

    @cached_property
    def motion(self) -> Floats:
        """(D, 3, P) displacement of each measured position, m."""
        return self.whitening.raw(self.motion_of_readings[:, :3])

    @cached_property
    def unloaded_motion(self) -> Floats:
        """(U, 3, P) displacement of the target in each unloaded reading, sensor axes, m."""
        return np.asarray(self.motion_of_readings[self.unloaded, :3])


def computable(fit: Fit, effect: Effect) -> bool:
    """Whether the fitted readings have the columns that an effect needs."""
    return type(effect).computable(fit.solution.prediction.situation.states)


def effect_columns(fit: Fit, effect: Effect) -> EffectColumns:
    """Return the columns of an effect outside of the model, at the parameters of the fit."""
    return next(columns_of_each(fit, (effect,)))


def columns_of_each(fit: Fit, effects: Sequence[Effect]) -> Iterator[EffectColumns]:
    """Yield `effect_columns` of several effects."""
    return chain.from_iterable(columns_in_parts(fit, effects))


def columns_in_parts(fit: Fit, effects: Sequence[Effect]) -> Iterator[tuple[EffectColumns, ...]]:
    """Yield `effect_columns` of several effects in order, in parts that are computed together.

    A part has up to `MOST_AT_ONCE` numbers; the equilibrium is differentiated once for each part.
    """
    w, s = fit.whitening, fit.solution
    count, bare = len(s.prediction.situation.angle) * w.m, fit.readings[~fit.outlier].unloaded
    ends = np.cumsum([0, *(count * len(e.magnitudes) for e in effects)])
    start = 0
    while start < len(effects):
        fitting = int(np.searchsorted(ends, ends[start] + MOST_AT_ONCE, side="right")) - 1
        stop = max(fitting, start + 1)
        part, start = tuple(effects[start:stop]), stop
        scale = np.concatenate([e.magnitudes for e in part])
        columns = fit.model.jacobian_of(part, s.prediction, s.theta, w.m, scale=scale)
        white, edges = (
            w.whiten_readings(columns),
            np.cumsum([0, *(len(e.magnitudes) for e in part)]),
        )
        yield tuple(
            EffectColumns(e, e.magnitudes, white, within, columns[:, :, within], w, bare)
            for e, within in zip(part, map(slice, edges[:-1], edges[1:]), strict=True)
        )


@dataclass(frozen=True, slots=True, eq=False)
class ReducedModel:
    """A fitted linear model with some of its columns eliminated; columns are not copied."""

    columns: Floats  # (R, P) all columns of the model
    eliminated: Bools  # (P,) eliminated columns
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

        Of whitened columns X (R, Q), with XᵀX, and products (P, Q) of the model's columns with X.
        """
        held, flat = self.basis.with_prior, self.flat.T @ x
        sigma = self.basis.transform[held, len(flat) + np.arange(len(held))]
        lifted = self.inverse_root @ np.vstack([flat, sigma[:, None] * products[held]])
        return np.asarray(gram - lifted.T @ lifted)

    def score(self) -> FamilyScore:
        """Score the eliminated columns against the model without them."""
        x, products = self.columns[:, self.eliminated], self.gram[:, self.eliminated]
        s = self.information(x, products[self.eliminated], products)
        return score_family(s, x.T @ self.residual, self.rss, self.dof)


@dataclass(frozen=True, slots=True)
class HeldOut:
    """Reduction of the held-out error by a family."""

    share: float  # of the misfit; negative where predictions become worse
    significant: bool  # whether the reduction is significant against the scatter from pose to pose


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
    def marginal_residual(self) -> Floats:
        """(R,) whitened residual of the model with all parameters zero that have a prior."""
        s, random = self.fit.solution, self.projection.ridge > 0
        return np.asarray(s.white + self.rows @ np.where(random, s.coordinates(), 0.0))

    @cached_property
    def flat(self) -> int:
        """Number of coordinates without a prior."""
        return int(np.count_nonzero(self.projection.ridge == 0))

    @cached_property
    def test_noise(self) -> tuple[float, float]:
        """Sum of squares and degrees of freedom of the noise in tests of further columns."""
        return self.noise_of(self.residual, np.ones(len(self.residual), dtype=np.bool_))

    def noise_of(self, residual: Floats, rows: Bools) -> tuple[float, float]:
        """`test_noise` of the residual (R',) of the model refitted to some of the rows (R,).

        ‖r‖² and the degrees of freedom of the fit. A background leaves a small residual of few
        degrees of freedom, but further columns have all directions except those of parameters
        without a prior: with the whitened y and the sizes σ of the random parameters, Cov(y) = M⁻¹
        beside these, so that

            yᵀ M y = ‖r‖² + ‖u/σ‖² ~ f χ²,    f = R less the parameters without a prior
        """
        dropped = len(rows) - int(np.count_nonzero(rows))
        if not self.fit.model.background:
            return float(residual @ residual), max(self.fit.dof - dropped, 1.0)
        free = float(self.fit.whitening.rank - dropped - self.flat)
        return float(self.marginal_residual[rows] @ residual), max(free, 1.0)

    @cached_property
    def left_out(self) -> Floats:
        """(poses,) squared whitened residual of each pose, predicted without it.

        The strengths are those of the fit, as in `held_out`; `Fit.left_out` has strengths chosen
        without the pose.
        """
        return by_pose(self.fit, self.left_out_residual.residual)

    @cached_property
    def left_out_residual(self) -> LeftOutResidual:
        """The fit's residual, predicted without each fold of poses."""
        return self.folds.left_out(self.fit.white, of_fit=True)

    @cached_property
    def folds(self) -> ModelFolds:
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
        return [FamilyFolds(self.folds, x) for x in families]

    def score(
        self, x: Floats, s: Floats | Spectrum | None = None, largest: float = np.inf
    ) -> FamilyScore:
        """Score whitened columns X (R, P) as an addition; with S if known; see `score_of`."""
        return self.score_of(self.information(x) if s is None else s, x.T @ self.residual, largest)

    def score_of(self, s: Floats | Spectrum, g: Floats, largest: float = np.inf) -> FamilyScore:
        """Score a family by S, or its spectrum, g = Xᵀ r (P,), and the largest plausible size."""
        return score_family(s, g, *self.test_noise, largest=largest)

    def families(self, columns: Sequence[EffectColumns]) -> list[tuple[Floats, Floats]]:
        """Return S (P, P) and g = Xᵀ r (P,) of effects whose columns were whitened together."""
        if not columns:
            return []
        model_rows = np.column_stack([self.rows, self.residual])
        products = model_rows.T @ columns[0].white_of_all
        out = []
        for c in columns:
            of_effect = products[:, c.columns]
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
            after = by_pose(self.fit, family.left_out(self.left_out_residual, score.ridge))
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
    columns: Floats,  # (R, P) whitened columns A
    gram: Floats,  # (P, P) AᵀA
    white: Floats,  # (R,) whitened residual of the fit
    theta: Floats,  # (P,) parameters of the fit
    prior: Floats,  # (P,) prior standard deviations, infinite for flat, zero for held parameters
    out: Bools,  # (P,) columns to eliminate
    beta: float,  # noise factor of the fit
    rank: int,  # number of rows with information
) -> ReducedModel:
    """Eliminate columns from a fitted linear model."""
    retained = ~out & (prior > 0)
    basis = find_basis(columns, np.ones(columns.shape[1]), np.where(retained, prior, 0.0))
    y = white + columns @ np.where(out, theta, 0.0)
    equations = normal_equations(columns, y, basis, gram)
    # Priors are about zero, not about the parameters of the fit.
    count, ridge = len(basis.singular), beta * basis.prior_precision
    z = np.zeros(len(ridge))
    z[count:] = (theta / np.where(retained, prior, 1.0))[basis.with_prior]
    root = equations.inverse_root(beta)
    step = basis.transform @ (root.T @ (root @ (equations.rhs - ridge * z)))
    shrunk = float(np.sum(ridge * np.sum(root**2, axis=0)))
    dof = rank - (float(np.count_nonzero(np.any(root, axis=1))) - shrunk)
    rows = basis.flat_rows(columns)
    return ReducedModel(columns, out, basis, rows, root, gram, y - columns @ step, dof)
