"""Priors, noise factor and rank of a Gauss-Newton step, chosen from its linear problem.

Priors of shrunk families maximise the evidence (`regression.empirical_bayes`). The noise factor β
is the variance of the residual in units of the stated noise, at least 1, that the priors are
weighed against. The rank counts the flat directions that the data determine against the residual.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from hilcal.regression.empirical_bayes import maximise_evidence, spent_by_groups
from hilcal.regression.normal_equations import (
    Basis,
    FlatProducts,
    NormalEquations,
    find_basis,
    flat_products,
    flat_triangle,
    normal_equations,
)
from hilcal.types import Floats, Ints

NOISE_STEPS = 50
"""Most fixed-point iterations of the noise factor; a choice, no study set it."""
NOISE_TOLERANCE = 1e-9
"""Relative change of the noise factor at which it has converged; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class LinearProblem:
    """The whitened linear problem at one point: minimise ‖y − A (θ − θ_0)‖² over live parameters.

    Attributes:
        live: (L,) indices of the parameters that are not held at zero.
        origin: (P,) θ_0: the point for flat parameters, zero for those with a prior.
        a: (R', L) A, or rows that have the same products with each other and with y.
        gram: (L, L) AᵀA.
        target: (R',) y.
        rank: number of rows that carry information.
        noise: variance of the rows: 1 where the scaling whitens, else that of the residual.
        whitened: whether rows are in units of the stated noise.
        rows: (R, L) A itself, one row per element of the readings.

    Priors, noise factor and solution share what depends on the flat parameters alone.
    """

    live: Ints
    origin: Floats
    a: Floats
    gram: Floats
    target: Floats
    rank: int
    noise: float
    whitened: bool
    rows: Floats
    _triangles: dict[bytes, Floats] = field(default_factory=dict, repr=False)
    _products: dict[bytes, FlatProducts] = field(default_factory=dict, repr=False)

    def restricted(self, prior: Floats) -> "LinearProblem":
        """Return the problem without the parameters that a prior (P,) of zero holds at zero.

        It takes over the memory of the rows: this one cannot be used any more.
        """
        kept = prior[self.live] > 0
        if kept.all():
            return self
        gram = self.gram[np.ix_(kept, kept)]
        same = self.rows is self.a
        a = self.a[:, kept]
        rows = a if same else self.rows[:, kept]
        known = {key: of.restricted(kept) for key, of in self._products.items()}
        live = self.live[kept]
        return replace(self, live=live, a=a, gram=gram, rows=rows, _products=known)

    def basis(self, scale: Floats, prior: Floats, spread: float) -> Basis:
        """Return identifiable coordinates for magnitudes (P,), priors (P,), and the residual's σ.

        Without whitening only rounding decides the rank.
        """
        threshold = spread if self.whitened else None
        scale, prior = scale[self.live], prior[self.live]
        flat = np.flatnonzero(np.isinf(prior))
        key = self.live[flat].tobytes() + scale[flat].tobytes()
        if key not in self._triangles:
            self._triangles[key] = flat_triangle(self.a, flat, scale)
        return find_basis(self.a, scale, prior, threshold, self._triangles[key])

    def equations(self, basis: Basis) -> NormalEquations:
        """Return the normal equations in the coordinates of a basis."""
        turned = basis.transform[basis.flat, : len(basis.singular)]
        key = self.live[basis.flat].tobytes() + turned.tobytes()
        if key not in self._products:
            self._products[key] = flat_products(self.a, self.target, basis)
        return normal_equations(self.a, self.target, basis, self.gram, self._products[key])

    def rss(self, equations: NormalEquations, z: Floats) -> float:
        """Return ‖y − A (θ − θ_0)‖² at the coordinates z (K,) of normal equations."""
        yy = float(self.target @ self.target)
        return yy - 2 * float(equations.rhs @ z) + float(z @ equations.gram @ z)


@dataclass(frozen=True, slots=True, eq=False)
class Regularisation:
    """What a linear problem is solved with.

    Attributes:
        prior: (P,) prior standard deviations (infinite: flat, zero: held at zero).
        beta: noise variance factor that the priors are weighed against.
        basis: identifiable coordinates of the parameters that are not held at zero.
    """

    prior: Floats
    beta: float
    basis: Basis


def regularise(
    p: LinearProblem, scale: Floats, prior: Floats, groups: Ints, choose: bool
) -> Regularisation:
    """Choose priors, noise factor and rank for a linear problem.

    Args:
        p: the problem.
        scale: (P,) ordinary magnitudes of the parameters.
        prior: (P,) prior standard deviations so far.
        groups: (P,) shrinkage group of each parameter, or −1.
        choose: whether the evidence chooses the priors of the shrunk families.
    """
    spread = _attainable_spread(p, scale, prior)
    beta = 1.0 if p.whitened else spread**2
    if choose:
        prior, beta = _family_priors(p, scale, prior, groups, spread)
    basis = p.basis(scale, prior, spread).restricted(prior[p.live] > 0)
    return Regularisation(prior, beta, basis)


def _attainable_spread(p: LinearProblem, scale: Floats, prior: Floats) -> float:
    """Root mean square of the residual at the solution of the linear problem.

    It does not depend on where the linearisation started, as the residual itself does.
    """
    basis = p.basis(scale, prior, 1.0)
    equations = p.equations(basis)
    rss = p.rss(equations, equations.solve(p.noise))
    return float(np.sqrt(max(rss, 1e-30) / max(p.rank - len(basis.singular), 1)))


def noise_factor(p: LinearProblem, equations: NormalEquations, beta: float = 1.0) -> float:
    """Fixed point of β = max(1, RSS(β) / (R − effective parameters)), given the priors.

    Args:
        p: the problem.
        equations: its normal equations.
        beta: where the iteration starts.
    """
    for _ in range(NOISE_STEPS):
        root = equations.inverse_root(beta)
        z = root.T @ (root @ equations.rhs)
        free = max(p.rank - effective_parameters(equations, beta, root), 1.0)
        beta, before = max(1.0, p.rss(equations, z) / free), beta
        if abs(beta - before) < NOISE_TOLERANCE * beta:
            break
    return beta


def effective_parameters(equations: NormalEquations, beta: float, root: Floats) -> float:
    """Effective number of parameters: flat directions + Σ (1 − β Λ_kk H⁻¹_kk) over the others.

    Args:
        equations: normal equations.
        beta: noise variance factor that the priors are weighed against.
        root: (K, K) T with Tᵀ T = H⁻¹.
    """
    return len(equations.basis.singular) + float(np.sum(_determined(equations, beta, root)))


def spent_parameters(equations: NormalEquations, beta: float, groups: Ints) -> float:
    """Degrees of freedom that a fit spends: `effective_parameters`, and the choice of strengths.

    Args:
        equations: normal equations over all parameters.
        beta: noise variance factor that the priors are weighed against.
        groups: (P,) shrinkage group of each parameter, or −1.
    """
    held = equations.basis.held
    determined = _determined(equations, beta, equations.inverse_root(beta))
    chosen = groups[held] >= 0
    own = float(np.sum(determined[~chosen])) + len(equations.basis.singular)
    if not chosen.any():
        return own
    _, group = np.unique(groups[held[chosen]], return_inverse=True)
    size = np.bincount(group)
    share = np.bincount(group, weights=determined[chosen]) / size
    return own + float(np.sum(spent_by_groups(share, size)))


def _determined(equations: NormalEquations, beta: float, root: Floats) -> Floats:
    """Share (H,) of each parameter with a prior that the data determine: 1 − β Λ_kk H⁻¹_kk."""
    flat, precision = len(equations.basis.singular), equations.basis.prior_precision
    variance = np.sum(root[:, flat:] ** 2, axis=0)
    return np.asarray(1 - beta * precision[flat:] * variance)


def _family_priors(
    p: LinearProblem, scale: Floats, prior: Floats, groups: Ints, spread: float
) -> tuple[Floats, float]:
    """Priors (P,) with those of the shrunk families chosen, and the noise factor."""
    beta = max(spread**2, 1.0)
    family = np.isin(np.arange(len(prior)), p.live) & (groups >= 0)
    if not family.any():
        return prior, beta
    # The families' columns unscaled, all others in well-conditioned coordinates.
    basis = p.basis(scale, np.where(family, 1.0, prior), spread)
    equations = p.equations(basis)
    of_family = np.append(np.zeros(len(basis.singular), dtype=bool), family[p.live[basis.held]])
    order = np.argsort(of_family, kind="stable")
    others = int(np.sum(~of_family))
    gram = equations.gram[np.ix_(order, order)]
    gram[np.arange(others), np.arange(others)] += beta * basis.prior_precision[order[:others]]
    found = maximise_evidence(
        gram,
        equations.rhs[order],
        float(p.target @ p.target),
        p.rank,
        others,
        groups[family],
        prior[family],
        beta,
    )
    out = prior.copy()
    out[family] = found.std
    return out, found.beta
