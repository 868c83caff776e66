"""Standard uncertainties of the parameters, also with a misfit, and which are identifiable.

While the residual is within the noise, Cov(θ) = T H⁻¹ Tᵀ. With a misfit, errors of neighbouring
readings are correlated and that formula is far too optimistic. Then the standard uncertainty is
the largest of three: the formal one times the root of the variance factor, and two delete-a-group
jackknives, with groups of consecutive readings and with groups close in joint space:

    Var(θ_p) = (G − 1)/G Σ_g (θ_p without g − mean)²

For shrunk families the uncertainty of their prior variance adds; see
`regression.hyperparameter_uncertainty`.

Source: Efron and Tibshirani, *An Introduction to the Bootstrap*, chapter 11.
"""

from dataclasses import dataclass

import numpy as np
from scipy.stats import chi2

from hilcal.identification.coordinates import Coordinates
from hilcal.identification.folds import block_folds, region_folds
from hilcal.identification.gauss_newton import Solution
from hilcal.identification.holdout import changes
from hilcal.identification.priors import prior_of, scales_of
from hilcal.identification.wide_effects import whitened_columns
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening
from hilcal.regression.hyperparameter_uncertainty import (
    dropped_group_factors,
    hyperparameter_factors,
)
from hilcal.regression.normal_equations import NULL_SHARE, Basis
from hilcal.types import Bools, Floats, Ints

LEARNT = 0.7
"""Ratio of posterior to prior standard deviation below which a parameter with a prior is
identifiable; a choice, no study set it."""
MEANINGLESS = 10.0
"""Standard uncertainty, in ordinary magnitudes, from which on a parameter is not identifiable; a
choice, no study set it."""
MISFIT_CHANCE = 0.01
"""p-value of χ² below which the residual is a misfit; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class Uncertainty:
    """Uncertainty and identifiability of the parameters.

    Attributes:
        std: (P,) standard uncertainties; infinite where not identifiable.
        formal: (P,) standard uncertainties under independent noise of the stated size alone.
        identifiable: (P,) which parameters the data determine.
        inflated: whether the residual is larger than noise, so that `std` is that of a misfit.
        null: names of the unidentifiable directions.
    """

    std: Floats
    formal: Floats
    identifiable: Bools
    inflated: bool
    null: tuple[str, ...]


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
    basis = solution.equations.basis
    scale = scales_of(model)
    spread = solution.equations.inverse(solution.beta)
    covariance = solution.transform @ spread @ solution.transform.T
    variance = np.diag(covariance).copy()
    variance[solution.space.index] += solution.space.rest / solution.beta
    noise = solution.beta if w.scaling == "none" else 1.0
    formal = np.sqrt(np.maximum(variance, 0.0) * noise)
    misfit = w.scaling != "none" and bool(chi2.sf(total, dof) < MISFIT_CHANCE)
    std = formal
    if misfit:
        std = formal * np.sqrt(total / dof)
        angle = readings.states.q[w.reading]
        for fold in (block_folds(pose), region_folds(angle, pose)):
            change = changes(model, solution, fold, w)
            count = len(change)
            off = change - change.mean(axis=0)
            jackknife = np.sqrt((count - 1) / count * np.sum(off**2, axis=0))
            std = np.maximum(std, jackknife)
    null = in_ordinary_magnitudes(solution.space, basis.null, scale)
    carried = solution.space.carried(len(scale))
    identifiable = identifiable_parameters(basis, solution.prior, carried, scale, std, null)
    std = std * _hyperparameter_factors(model, w, solution, covariance)
    return Uncertainty(
        np.where(identifiable, std, np.inf),
        formal,
        identifiable,
        misfit,
        name_directions(model, null),
    )


def _hyperparameter_factors(
    model: Model, w: Whitening, solution: Solution, covariance: Floats
) -> Floats:
    """Factors (P,) by which the unknown prior variances of shrunk families widen `std`."""
    groups, beta = prior_of(model)[1], solution.beta
    factor = hyperparameter_factors(beta * covariance, solution.theta, solution.prior, groups)
    dropped = np.flatnonzero((groups >= 0) & (solution.prior == 0))
    if w.scaling == "none" or not len(dropped) or not solution.rows.shape[1]:
        return factor
    columns = whitened_columns(model, solution.prediction, solution.theta, w, dropped)
    transform = solution.transform
    return factor * dropped_group_factors(
        transform, solution.projection(), columns, groups[dropped], beta
    )


def in_ordinary_magnitudes(space: Coordinates, null: Floats, scale: Floats) -> Floats:
    """Directions (P, U) in ordinary magnitudes (P,) of the parameters, of those of y."""
    found, index = space.transform(null).copy(), space.index
    found[index] /= scale[index, None]
    return found


def identifiable_parameters(
    basis: Basis, prior: Floats, carried: Bools, scale: Floats, std: Floats, null: Floats
) -> Bools:
    """(P,) parameters that unidentifiable directions hardly move, and that the data determine.

    Args:
        basis: identifiable coordinates of a fit.
        prior: (P,) prior standard deviations of its y.
        carried: (P,) parameters with a carried prior.
        scale: (P,) ordinary magnitudes.
        std: (P,) standard uncertainties.
        null: (P, U) unidentifiable directions, in ordinary magnitudes.
    """
    moved = scale * np.linalg.norm(null, axis=1)
    flat = (moved <= NULL_SHARE * std) & (std < MEANINGLESS * scale)
    learnt = std < LEARNT * np.where(np.isinf(prior), np.inf, prior)
    return np.where(basis.flat | carried, flat, learnt & (prior > 0))


def name_directions(model: Model, null: Floats, most: int = 3) -> tuple[str, ...]:
    """Name unidentifiable directions by the parameters that move together in them.

    The directions are brought to echelon form first, each pivoting on its largest element,
    so that every one involves few parameters. Factors are in ordinary magnitudes.
    """
    names = [f"{e.name}.{p.name}" for e in model.effects for p in e.parameters]
    rows = null.T.copy()
    for i in range(len(rows)):
        pivot = i + int(np.argmax(np.abs(rows[i:]).max(axis=1)))
        rows[[i, pivot]] = rows[[pivot, i]]
        column = int(np.argmax(np.abs(rows[i])))
        rows[i] /= rows[i, column]
        others = np.arange(len(rows)) != i
        rows[others] -= np.outer(rows[others, column], rows[i])
    out = []
    for row in rows:
        order = np.argsort(-np.abs(row), kind="stable")
        strong = [k for k in order if abs(row[k]) > 0.05]
        text = " ".join(
            ("+ " if row[k] > 0 else "− ") + _times(abs(row[k])) + names[k] for k in strong[:most]
        )
        more = f" … ({len(strong) - most} more)" if len(strong) > most else ""
        out.append(text.removeprefix("+ ") + more)
    return tuple(out)


def _times(factor: float) -> str:
    text = f"{factor:.2g}"
    return "" if text == "1" else f"{text}·"
