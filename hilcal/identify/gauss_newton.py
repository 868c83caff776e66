"""Whitened Gauss-Newton on the exact chain."""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Whitening
from hilcal.errors import CannotAnswerError
from hilcal.identify.residual import residual
from hilcal.model import Model, Prediction
from hilcal.regression.empirical_bayes import shrink
from hilcal.regression.normal_equations import Basis, NormalEquations, find_basis, normal_equations
from hilcal.regression.projection import Projection, projection
from hilcal.types import Floats, Ints

MAX_ITERATIONS = 20
CONVERGED = 1e-5
"""A step that moves the whitened readings by less than this, in units of the noise."""
SETTLED = 0.02
"""Priors and rank are decided anew until the residual changes by less than this share from
one step to the next, or is within the noise; then they are kept, so that the steps converge."""
FIRST_GUESS = 0.3
HALVINGS = 8
NOISE_STEPS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Where Gauss-Newton came to rest.

    Attributes:
        theta: (P,) parameters.
        prior: (P,) prior standard deviations (infinite: flat, zero: held at zero).
        beta: noise variance factor that the priors were weighed against.
        equations: normal equations at the solution, in identifiable coordinates z.
        live: (L,) indices of the parameters that are not held at zero.
        rows: (R, K) whitened derivative of the measurements by z.
        prediction: prediction at the solution.
        raw: (D, m) residual.
        white: (R,) whitened residual.
        jacobian: (D, m, L) derivative of the measurements by the live parameters; emptied once
            the folds of a fit have been predicted.
        effective: effective number of estimated parameters.
        iterations: steps taken.
        converged: whether the last step was negligible.
    """

    theta: Floats
    prior: Floats
    beta: float
    equations: NormalEquations
    live: Ints
    rows: Floats
    prediction: Prediction
    raw: Floats
    white: Floats
    jacobian: Floats
    effective: float
    iterations: int
    converged: bool

    def projection(self) -> Projection:
        """Return the projection off the columns of the model."""
        ridge = self.beta * self.equations.basis.prior_precision
        return projection(self.rows, ridge, self.equations.gram)

    def coordinates(self) -> Floats:
        """Return z (K,) of the parameters that have a prior; zero for flat directions."""
        basis = self.equations.basis
        z = np.zeros(len(self.equations.rhs))
        z[len(basis.singular) :] = self.theta[basis.held] / self.prior[basis.held]
        return z

    def projected_residual(self) -> Floats:
        """(R,) whitened residual after the model's remaining step: `white` to within that step."""
        return self.projection().residual(self.white, self.coordinates())


def prior_of(model: Model) -> tuple[Floats, Ints]:
    """Starting prior (P,) of a model, and the shrinkage group (P,) of each parameter or −1."""
    prior, groups, used = [], [], 0
    for e in model.effects:
        size = len(e.parameters)
        mine, fixed = e.groups(), e.prior_std()
        scale = np.array([p.scale for p in e.parameters])
        if mine is not None:
            prior.append(FIRST_GUESS * scale)
            groups.append(mine + used)
            used += int(mine.max()) + 1
        else:
            prior.append(np.full(size, np.inf) if fixed is None else fixed)
            groups.append(np.full(size, -1))
    if not prior:
        return np.zeros(0), np.zeros(0, dtype=np.int64)
    return np.concatenate(prior), np.concatenate(groups)


def scales_of(model: Model) -> Floats:
    """(P,) ordinary magnitudes of the parameters."""
    return np.array([p.scale for e in model.effects for p in e.parameters])


def solve(
    model: Model,
    readings: Readings,
    w: Whitening,
    start: Floats | None = None,
    prior: Floats | None = None,
) -> Solution:
    """Fit all parameters of the model to the readings.

    Args:
        model: robot and effects.
        readings: what was measured.
        w: the scaling.
        start: (P,) starting parameters, zero unless given.
        prior: (P,) prior standard deviations to keep as they are; otherwise those of
            shrunk families are chosen by the evidence.
    """
    theta = np.zeros(model.size) if start is None else start
    scale, whitened = scales_of(model), w.scaling != "none"
    sigma, groups = prior_of(model)
    choose = prior is None and bool((groups >= 0).any())
    if prior is not None:
        sigma = prior
    theta = np.where(sigma > 0, theta, 0.0)
    beta = 1.0
    basis: Basis  # set in the first step
    prediction = model.predict(readings.states, theta)
    raw = residual(readings, prediction, w)
    settled, square = False, float(np.finfo(float).max)
    for iterations in range(1, MAX_ITERATIONS + 1):  # noqa: B007 - reported
        live = np.flatnonzero(sigma > 0)
        a = whitened_jacobian(model, prediction, theta, w, live)
        # Flat parameters step from where they are, so that what cannot be seen stays put;
        # those with a prior are solved for as a whole, since the prior pulls to zero.
        resting = np.where(np.isinf(sigma), theta, 0.0)
        target = w.whiten(raw).reshape(-1) + a @ (theta - resting)[live]
        gram = a.T @ a
        if not settled:
            problem = _Problem(a, gram, target, w.rank, live)
            now = _mean_square(w.whiten(raw), 0)
            spread = _attainable_spread(problem, sigma, scale, 1.0 if whitened else now, whitened)
            beta = 1.0 if whitened else spread**2
            if choose:
                sigma, beta = _choose_prior(problem, sigma, scale, groups, spread, whitened)
                kept = sigma[live] > 0
                a, gram, live = a[:, kept], gram[np.ix_(kept, kept)], live[kept]
            basis = find_basis(a, scale[live], sigma[live], spread if whitened else None)
        equations = normal_equations(a, target, basis, gram)
        if bool((groups[live] >= 0).any()):
            beta = _noise_factor(equations, float(target @ target), w.rank)
        updated = resting.copy()
        updated[live] += basis.transform @ equations.solve(beta)
        step = a @ (updated - theta)[live]
        goal = _Goal(model, readings, w, sigma, beta)
        theta, prediction, raw = _walk(goal, theta, raw, updated)
        before, square = square, _mean_square(w.whiten(raw), len(basis.singular))
        converged = settled and float(step @ step) <= CONVERGED**2 * max(square, beta) * len(step)
        if converged:
            break
        settled = bool((whitened and square < 1) or abs(square - before) <= SETTLED * before)
    del a, gram
    jacobian = w.raw(model.jacobian(prediction, theta, w.m, live))
    rows = w.whiten(jacobian).reshape(-1, len(live)) @ basis.transform
    white = w.whiten(raw).reshape(-1)
    if not whitened:
        beta = _mean_square(white, len(basis.singular))
    # Formed anew at the solution, so that folds can be taken out of them exactly.
    z = np.zeros(basis.transform.shape[1])
    z[len(basis.singular) :] = theta[live[basis.held]] / sigma[live[basis.held]]
    everywhere = _all_parameters(basis, live, model.size)
    equations = NormalEquations(everywhere, rows.T @ rows, rows.T @ (white + rows @ z))
    return Solution(
        theta=theta,
        prior=sigma,
        beta=beta,
        equations=equations,
        live=live,
        rows=rows,
        prediction=prediction,
        raw=raw,
        white=white,
        jacobian=jacobian,
        effective=len(basis.singular) + _effective(equations, beta),
        iterations=iterations,
        converged=converged,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Goal:
    """What Gauss-Newton makes small: ‖r‖² + β ‖θ/σ‖² over the parameters with a prior."""

    model: Model
    readings: Readings
    w: Whitening
    sigma: Floats
    beta: float

    def __call__(self, theta: Floats, raw: Floats) -> float:
        held = np.isfinite(self.sigma) & (self.sigma > 0)
        pull = self.beta * float(np.sum((theta[held] / self.sigma[held]) ** 2))
        return float(np.sum(self.w.whiten(raw) ** 2)) + pull


def _walk(
    goal: _Goal, theta: Floats, raw: Floats, aim: Floats
) -> tuple[Floats, Prediction, Floats]:
    """Go towards `aim`, half as far each time while the goal grows.

    A weakly determined direction can be so long a way that the chain bends on it.
    """
    now = goal(theta, raw)
    theta = np.where(goal.sigma > 0, theta, 0.0)
    share = 1.0
    for _ in range(HALVINGS):
        trial = aim if share == 1 else theta + share * (aim - theta)
        try:
            prediction = goal.model.predict(goal.readings.states, trial)
        except CannotAnswerError:
            share /= 2
            continue
        left = residual(goal.readings, prediction, goal.w)
        if goal(trial, left) <= now * (1 + 1e-9) + 1e-12:
            return trial, prediction, left
        share /= 2
    prediction = goal.model.predict(goal.readings.states, theta)
    return theta, prediction, residual(goal.readings, prediction, goal.w)


def whitened_jacobian(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live parameters."""
    jacobian = model.jacobian(prediction, theta, w.m, live)
    return w.whiten(w.raw(jacobian)).reshape(-1, len(live))


def _attainable_spread(
    p: "_Problem", sigma: Floats, scale: Floats, beta: float, whitened: bool
) -> float:
    """Root mean square of the residual that the linear problem leaves.

    It does not depend on where the linearisation started, as the residual itself does.
    """
    basis = find_basis(p.a, scale[p.live], sigma[p.live], 1.0 if whitened else None)
    equations = normal_equations(p.a, p.target, basis, p.gram)
    z = equations.solve(beta)
    left = float(p.target @ p.target) - 2 * float(equations.rhs @ z) + float(z @ equations.gram @ z)
    return float(np.sqrt(max(left, 1e-30) / max(p.rank - len(basis.singular), 1)))


def _noise_factor(equations: NormalEquations, norm2: float, rank: int) -> float:
    """Noise factor β at which a given prior is in balance, as the evidence finds it."""
    beta = 1.0
    for _ in range(NOISE_STEPS):
        z = equations.solve(beta)
        left = norm2 - 2 * float(equations.rhs @ z) + float(z @ equations.gram @ z)
        free = len(equations.basis.singular) + _effective(equations, beta)
        beta, before = max(1.0, left / max(rank - free, 1.0)), beta
        if abs(beta - before) < 1e-9 * beta:
            break
    return beta


def _mean_square(white: Floats, parameters: int) -> float:
    return max(float(np.sum(white**2)) / max(white.size - parameters, 1), 1e-300)


def _all_parameters(basis: Basis, live: Ints, size: int) -> Basis:
    """Express a basis over the live parameters over all of them."""
    transform = np.zeros((size, basis.transform.shape[1]))
    transform[live] = basis.transform
    null = np.zeros((size, basis.null.shape[1]))
    null[live] = basis.null
    flat = np.zeros(size, dtype=bool)
    flat[live] = basis.flat
    return replace(basis, transform=transform, null=null, flat=flat, held=live[basis.held])


def _effective(equations: NormalEquations, beta: float) -> float:
    """Effective number of parameters that have a prior: Σ (1 − β Λ_kk H⁻¹_kk)."""
    precision = equations.basis.prior_precision
    held = precision > 0
    if not held.any():
        return 0.0
    covariance = np.diag(equations.inverse(beta))[held]
    return float(np.sum(1 - beta * precision[held] * covariance))


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The whitened linear problem at the live parameters."""

    a: Floats
    gram: Floats
    target: Floats
    rank: int
    live: Ints


def _choose_prior(
    p: _Problem,
    sigma: Floats,
    scale: Floats,
    groups: Ints,
    spread: float,
    whitened: bool,
) -> tuple[Floats, float]:
    """Evidence step: prior standard deviations of the shrunk families, noise factor."""
    family = groups[p.live] >= 0
    if not family.any():
        return sigma, max(spread**2, 1.0)
    # The families' columns unscaled, all others in well-conditioned coordinates.
    unit = np.where(family, 1.0, sigma[p.live])
    basis = find_basis(p.a, scale[p.live], unit, spread if whitened else None)
    equations = normal_equations(p.a, p.target, basis, p.gram)
    of_family = np.append(np.zeros(len(basis.singular), dtype=bool), family[basis.held])
    order = np.argsort(of_family, kind="stable")
    rest = int(np.sum(~of_family))
    beta = max(spread**2, 1.0)
    gram = equations.gram[np.ix_(order, order)]
    gram[np.arange(rest), np.arange(rest)] += beta * basis.prior_precision[order[:rest]]
    chosen = p.live[family]
    found = shrink(
        gram,
        equations.rhs[order],
        float(p.target @ p.target),
        p.rank,
        rest,
        groups[chosen],
        sigma[chosen],
        beta,
    )
    out = sigma.copy()
    out[chosen] = found.std
    return out, found.beta
