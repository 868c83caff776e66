"""Standard uncertainties of the parameters, also with a misfit, and which are identifiable.

While the residual is within the noise, Cov(θ) = T H⁻¹ Tᵀ. A scaling G other than gc leaves the
noise correlated, C = G V Gᵀ: then, with the rows B,

    Cov(θ) = T H⁻¹ (Bᵀ C B + β² Λ) H⁻¹ Tᵀ

With a misfit, errors of neighbouring readings are correlated and that formula is far too
optimistic. Then the standard uncertainty is the largest of three: the formal one times the root of
the variance factor, and two delete-a-group jackknives, with groups of consecutive readings and with
groups close in joint space (Efron and Tibshirani, *An Introduction to the Bootstrap*, chapter 11):

    Var(θ_p) = (G − 1)/G Σ_g (θ_p without g − mean)²

A shrunk group's prior N(0, τ²) is estimated from few parameters, and therefore badly. The
uncertainty is that of the mixture over τ, around the estimate that is used (Kass and Steffey,
J. Am. Stat. Assoc. 84 (1989) 717-726):

    E[(θ − θ̂)²] = Σ_τ w_τ [ V_τ + (m_τ − θ̂)² ],   w_τ ∝ p(τ) |I + τ² L|^(−1/2) exp(½ bᵀ V_τ b)

with L and b the precision and the right-hand side of the group alone, V_τ = (L + I/τ²)⁻¹ and
m_τ = V_τ b. p(τ) is half-Cauchy (Polson and Scott, Bayesian Analysis 7 (2012) 887-902); its scale
is the spread at which noise alone is as large as the group, so that a zero and a nonzero group are
equally probable. Other groups keep their τ.

Parameters of dropped groups may differ from zero by as much as the noise allows. They are
integrated out with a prior of that size: with M the projection off their columns D with its ridge
β Λ (`projection`), A the columns of the others and Λ_z their ridge, Cov(z) = (Aᵀ M A + Λ_z)⁻¹.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from hilcal.identification.carried.carried_prior import Coordinates, names_of, prior_of, scales_of
from hilcal.identification.folds import block_folds, parameter_changes, region_folds
from hilcal.identification.gauss_newton import Solution, whitened_jacobian
from hilcal.identification.noise.full_covariance import whitened_blocks
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening
from hilcal.regression.normal_equations import NULL_SHARE, Basis, echelon
from hilcal.regression.schur import Projection, inverse_root
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints

IDENTIFIABLE_RATIO = 0.7
"""Posterior over prior standard deviation below which one is identifiable; a choice."""
LARGEST_STD = 10.0  # standard uncertainty, in ordinary magnitudes, from which none is; a choice
MISFIT_LEVEL = 0.01  # p-value of χ² below which the residual is a misfit; a choice
GRID = np.logspace(-2.0, 3.0, 101)  # values of τ in units of the half-Cauchy's scale
ROUNDING = 1e-9
MOST_NAMED = 3  # parameters by which an unidentifiable direction is named
DROPPED_VARIANCE = 2.0  # variance that a dropped group may have, in units of that by noise alone:
# the mean over τ of a group at the limit of being dropped


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty(Brief):
    """Uncertainty and identifiability of the parameters."""

    std: Floats  # (P,) standard uncertainties; infinite where not identifiable
    formal: Floats  # (P,) under independent noise of the stated size alone
    identifiable: Bools  # (P,) which parameters the data determine
    inflated: bool  # whether the residual is larger than noise, so that `std` is that of a misfit
    null: tuple[str, ...]  # names of the unidentifiable directions


def uncertainty(
    model: Model,
    readings: Readings,
    w: Whitening,
    solution: Solution,
    pose: Ints,
    total: float,
    dof: float,
) -> Uncertainty:
    """Uncertainties of a solution in the scaling `w`, with gc-whitened χ² `total` on `dof`."""
    basis, scale, space = solution.equations.basis, scales_of(model), solution.space
    spread = solution.equations.inverse(solution.beta)
    covariance = solution.transform @ spread @ solution.transform.T
    stated = covariance
    if w.scaling != "gc":
        inner = _of_noise(solution.rows, whitened_blocks(readings, w))
        inner += np.diag(solution.beta**2 * basis.prior_precision)
        stated = solution.transform @ spread @ inner @ spread @ solution.transform.T
    variance = np.diag(stated).copy()
    variance[space.index] += space.omitted_variance / solution.beta
    formal = np.sqrt(np.maximum(variance, 0.0))
    misfit, std = bool(scipy.stats.chi2.sf(total, dof) < MISFIT_LEVEL), formal
    if misfit:
        std = formal * np.sqrt(total / dof)
        angle = readings.states.q[w.reading]
        for fold in (block_folds(pose), region_folds(angle, pose)):
            change = parameter_changes(model, solution, fold, w)
            count, off = len(change), change - change.mean(axis=0)
            std = np.maximum(std, np.sqrt((count - 1) / count * np.sum(off**2, axis=0)))
    null = in_ordinary_magnitudes(space, basis.null, scale)
    carried = space.carried(len(scale))
    identifiable = identifiable_parameters(basis, solution.prior, carried, scale, std, null)
    # The unknown prior variances of shrunk families widen both their own `std` and all others.
    groups, beta, prior = prior_of(model)[1], solution.beta, solution.prior
    factor = hyperparameter_factors(beta * covariance, solution.theta, prior, groups)
    dropped = np.flatnonzero((groups >= 0) & (prior == 0))
    if w.scaling != "none" and len(dropped) and solution.rows.shape[1]:
        columns = whitened_jacobian(model, solution.prediction, solution.theta, w, dropped)
        of_model = solution.transform, solution.projection()
        factor = factor * dropped_group_factors(*of_model, columns, groups[dropped], beta)
    std = np.where(identifiable, std * factor, np.inf)
    return Uncertainty(std, formal, identifiable, misfit, name_directions(model, null))


def _of_noise(rows: Floats, covariance: Sequence[Floats]) -> Floats:
    """Return Σ Bᵀ C B (K, K) over the groups of rows B (R, K), C (G, S, S) of each bucket."""
    out, start = np.zeros((rows.shape[1],) * 2), 0
    for c in covariance:
        b = rows[start : start + c.shape[0] * c.shape[1]].reshape(*c.shape[:2], -1)
        out += np.einsum("gsk,gst,gtl->kl", b, c, b, optimize=True)
        start += c.shape[0] * c.shape[1]
    return out


def in_ordinary_magnitudes(space: Coordinates, null: Floats, scale: Floats) -> Floats:
    """Directions (P, U) of y as directions of θ, in ordinary magnitudes (P,)."""
    out, index = space.transform(null).copy(), space.index
    out[index] /= scale[index, None]
    return out


def identifiable_parameters(
    basis: Basis, prior: Floats, carried: Bools, scale: Floats, std: Floats, null: Floats
) -> Bools:
    """(P,) parameters that unidentifiable directions hardly move, and that the data determine.

    `prior` (P,) is that of the coordinates y, `carried` (P,) marks parameters with a carried prior;
    `scale`, `std` (P,) and directions `null` (P, U) are as in `uncertainty`.
    """
    moved = scale * np.linalg.norm(null, axis=1)
    flat = (moved <= NULL_SHARE * std) & (std < LARGEST_STD * scale)
    narrowed = std < IDENTIFIABLE_RATIO * np.where(np.isinf(prior), np.inf, prior)
    return np.where(basis.flat | carried, flat, narrowed & (prior > 0))


def name_directions(model: Model, null: Floats) -> tuple[str, ...]:
    """Name unidentifiable directions by the parameters that move together in them.

    Each is pivoted on its largest element, so that it involves few parameters. Factors are in
    ordinary magnitudes.
    """
    names, out = names_of(model), []
    for row in echelon(null.T, (range(len(null)),)):
        order = np.argsort(-np.abs(row), kind="stable")
        strong = [k for k in order if abs(row[k]) > 0.05]
        factors = [f"{abs(row[k]):.2g}" for k in strong[:MOST_NAMED]]
        text = " ".join(
            f"{'+' if row[k] > 0 else '−'} {'' if f == '1' else f'{f}·'}{names[k]}"
            for k, f in zip(strong, factors, strict=False)
        )
        more = len(strong) - MOST_NAMED
        suffix = f" … ({more} more)" if more > 0 else ""
        out.append(text.removeprefix("+ ") + suffix)
    return tuple(out)


def hyperparameter_factors(
    covariance: Floats, theta: Floats, prior: Floats, groups: Ints
) -> Floats:
    """Return the factors (P,), at least 1, by which standard uncertainties grow.

    `covariance` is that at the chosen priors, in true units of noise. `prior` is the same within a
    group; infinite or zero for parameters that are not shrunk or held at zero, whose group is −1.
    """
    out = np.ones(len(theta))
    shrunk = (groups >= 0) & np.isfinite(prior) & (prior > 0)
    for group in np.unique(groups[shrunk]):
        rows = np.flatnonzero(shrunk & (groups == group))
        out[rows] = _group_factors(
            covariance[np.ix_(rows, rows)], theta[rows], float(prior[rows[0]])
        )
    return out


def _group_factors(covariance: Floats, theta: Floats, prior: float) -> Floats:
    """Factors (n,) of one group whose covariance (n, n) is that at its prior."""
    values, axes = np.linalg.eigh(covariance)
    values = np.maximum(values, ROUNDING**2 * max(float(values[-1]), 1e-300))
    # Precision of the data alone, along the axes of the covariance.
    data = np.maximum(1.0 / values - prior**-2.0, 0.0)
    if not data.any():
        return np.ones(len(theta))
    estimate = axes.T @ theta
    b = estimate / values
    tau2 = (GRID[:, None] ** 2) * len(data) / data.sum()
    variance = 1.0 / (data + 1.0 / tau2)
    log = -0.5 * np.log1p(tau2 * data).sum(axis=1) + 0.5 * (b**2 * variance).sum(axis=1)
    weight = np.exp(log - log.max()) * GRID / (1.0 + GRID**2)  # dτ is τ dlog τ
    weight /= weight.sum()
    away = variance * b - estimate
    mixed = (axes**2) @ (weight @ variance)
    shift = np.einsum("t,ti,tj->ij", weight, away, away)
    mixed += np.einsum("pi,ij,pj->p", axes, shift, axes)
    return np.asarray(np.sqrt(np.maximum(mixed / np.diag(covariance), 1.0)))


def dropped_group_factors(
    transform: Floats, p: Projection, columns: Floats, groups: Ints, beta: float
) -> Floats:
    """Return the factors (P,), at least 1, by which groups that were dropped widen all others.

    `transform` (P, K) gives the parameters by coordinates z, `p` is the model by z, `columns` are
    the whitened derivatives D (R, Q) by the dropped parameters, `groups` (Q,) their groups.
    """
    cross, gram = p.rows.T @ columns, columns.T @ columns
    norm2 = np.diag(gram)
    free = np.maximum(norm2 - np.sum((p.inverse_root @ cross) ** 2, axis=0), 0.0)
    reach = np.bincount(groups, weights=free) / np.maximum(np.bincount(groups), 1)
    # Columns in the span of the others add no information, and are left out.
    informed = reach[groups] > ROUNDING * np.maximum(norm2, 1e-300)
    if not informed.any():
        return np.ones(len(transform))
    hidden = gram[np.ix_(informed, informed)] + np.diag(
        beta * reach[groups][informed] / DROPPED_VARIANCE
    )
    precision = p.rows.T @ p.rows + np.diag(p.ridge)
    explained = inverse_root(hidden) @ cross[:, informed].T
    wide = inverse_root(precision - explained.T @ explained)
    variance = np.sum((transform @ p.inverse_root.T) ** 2, axis=1)
    widened = np.sum((transform @ wide.T) ** 2, axis=1)
    positive = variance > 0
    ratio = widened / np.where(positive, variance, 1.0)
    return np.sqrt(np.where(positive, np.maximum(ratio, 1.0), 1.0))
