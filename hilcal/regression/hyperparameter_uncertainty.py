"""Uncertainty of the parameters of a shrunk family due to that of its prior variance.

A group's prior N(0, τ²) is estimated from the data (`empirical_bayes`), from few parameters and
therefore badly: intervals for that τ alone would be too short for weak groups. The uncertainty is
that of the mixture over τ, around the estimate that is used:

    E[(θ − θ̂)²] = Σ_τ w_τ [ V_τ + (m_τ − θ̂)² ],   w_τ ∝ p(τ) |I + τ² L|^(−1/2) exp(½ bᵀ V_τ b)

with L and b the precision and the right-hand side of the group alone, V_τ = (L + I/τ²)⁻¹ and
m_τ = V_τ b. p(τ) is half-Cauchy; its scale is the spread at which noise alone is as large as the
group, so that a zero and a nonzero group are equally probable. Other groups keep their τ.

Parameters of dropped groups may differ from zero by as much as the noise allows. They are
integrated out with a prior of that size: with M the projection off their columns D with its ridge
β Λ (`projection`), A the columns of the others and Λ_z the ridge of these,

    Cov(z) = (Aᵀ M A + Λ_z)⁻¹

Sources: Kass and Steffey, *Approximate Bayesian inference in conditionally independent
hierarchical models*, J. Am. Stat. Assoc. 84 (1989) 717-726; Polson and Scott, *On the half-Cauchy
prior for a global scale parameter*, Bayesian Analysis 7 (2012) 887-902.
"""

import numpy as np

from hilcal.regression.factored import Tall, gram
from hilcal.regression.projection import Projection
from hilcal.regression.schur import inverse_root
from hilcal.types import Floats, Ints

GRID = np.logspace(-2.0, 3.0, 101)
"""Values of τ in units of the half-Cauchy's scale."""
ROUNDING = 1e-9
HIDDEN = 2.0
"""Variance that a dropped group may have, in units of that by noise alone:
the mean over τ of a group at the limit of being dropped."""


def hyperparameter_factors(
    covariance: Floats, theta: Floats, prior: Floats, groups: Ints
) -> Floats:
    """Return the factors (P,), at least 1, by which standard uncertainties grow.

    Args:
        covariance: (P, P) of the parameters at the chosen priors, in true units of noise.
        theta: (P,) estimates.
        prior: (P,) prior standard deviations, the same within a group; infinite or zero for
            parameters that are not shrunk or held at zero.
        groups: (P,) group of each parameter, −1 for those that are not shrunk.
    """
    out = np.ones(len(theta))
    shrunk = (groups >= 0) & np.isfinite(prior) & (prior > 0)
    for group in np.unique(groups[shrunk]):
        mine = np.flatnonzero(shrunk & (groups == group))
        out[mine] = _of_group(covariance[np.ix_(mine, mine)], theta[mine], float(prior[mine[0]]))
    return out


def _of_group(covariance: Floats, theta: Floats, prior: float) -> Floats:
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
    transform: Floats, p: Projection, columns: Tall, groups: Ints, beta: float
) -> Floats:
    """Return the factors (P,), at least 1, by which groups that were dropped widen all others.

    Args:
        transform: (P, K) parameters per coordinate z.
        p: the model by its coordinates z.
        columns: (R, Q) whitened derivatives D by the dropped parameters.
        groups: (Q,) their groups.
        beta: noise factor that priors are weighed against.
    """
    cross, own_gram = p.rows.T @ columns, gram(columns)
    norm2 = np.diag(own_gram)
    free = np.maximum(norm2 - np.sum((p.inverse_root @ cross) ** 2, axis=0), 0.0)
    reach = np.bincount(groups, weights=free) / np.maximum(np.bincount(groups), 1)
    # Columns in the span of the others have no information of their own: left out.
    seen = reach[groups] > ROUNDING * np.maximum(norm2, 1e-300)
    if not seen.any():
        return np.ones(len(transform))
    hidden = own_gram[np.ix_(seen, seen)] + np.diag(beta * reach[groups][seen] / HIDDEN)
    own = p.rows.T @ p.rows + np.diag(p.ridge)
    explained = inverse_root(hidden) @ cross[:, seen].T
    wide = inverse_root(own - explained.T @ explained)
    before = np.sum((transform @ p.inverse_root.T) ** 2, axis=1)
    after = np.sum((transform @ wide.T) ** 2, axis=1)
    there = before > 0
    return np.sqrt(np.where(there, np.maximum(after / np.where(there, before, 1.0), 1.0), 1.0))
