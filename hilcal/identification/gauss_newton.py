"""Whitened Gauss-Newton on the exact chain, of readings in memory or in a stream.

    minimise ‖w(θ)‖² + β ‖y/σ‖²,    θ = m + U y

with w (R,) the whitened residual. In the coordinates y the prior is independent and about zero
(`carried_prior.Coordinates`); without a carried prior they are θ itself. σ are their prior standard
deviations. The noise factor β is the variance of the residual in units of the stated noise, at
least 1. Priors of shrunk families maximise the evidence (`regression.empirical_bayes`). The rank is
the number of flat directions that the data determine better than the residual's scatter.

A `NewtonProblem` states the objective at a point and the linear problem there, whose rows may be
replaced by any rows with the same products.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.errors import CannotAnswerError
from hilcal.identification.carried.carried_prior import (
    Coordinates,
    coordinates_of,
    prior_of,
    scales_of,
)
from hilcal.identification.residual import residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode, Whitening
from hilcal.regression.empirical_bayes import maximise_evidence, spent_by_groups
from hilcal.regression.normal_equations import (
    Basis,
    NormalEquations,
    find_basis,
    normal_equations,
    triangle_of,
)
from hilcal.regression.schur import Projection, projection
from hilcal.shown import Brief
from hilcal.types import Bools, Floats, Ints

# All of these are choices.
TALL = 10_000  # rows from which a step first reduces them to their triangle (QR), which makes the
# rank analysis and normal equations of 150,000 rows of 30 ten times faster
MAX_ITERATIONS = 20  # steps; the tests of convergence allow 8
CONVERGED = 1e-5  # motion of the whitened readings by the last step, in units of the noise
SETTLED = 0.02  # priors and rank are chosen anew until the residual changes by less than this share
# of itself, or of the noise, in a step
NEAR = 0.02  # motion of the readings by a step, in units of the noise, below which it is
# extrapolated
MEMORY = 5  # earlier steps of the extrapolation
HALVINGS = 8  # most step lengths of a line search
NOISE_STEPS, NOISE_TOLERANCE = 50, 1e-9  # iterations of the noise factor, and relative change


@dataclass(frozen=True, slots=True, eq=False)
class LinearProblem:
    """Minimise ‖y − A (θ − θ_0)‖² over live parameters; A and y are whitened."""

    live: Ints  # (L,) indices of the parameters that are not held at zero
    origin: Floats  # (P,) θ_0: the point for flat parameters, zero for those with a prior
    a: Floats  # (R', L) A, or rows with the same products AᵀA and Aᵀy
    gram: Floats  # (L, L) AᵀA
    target: Floats  # (R',) y
    rank: int  # number of rows that carry information
    noise: float  # variance of the rows: 1 if whitened, else that of the residual
    whitened: bool  # whether rows are in units of the stated noise
    rows: Floats  # (R, L) A itself, one row per element of the readings

    def restricted(self, prior: Floats) -> "LinearProblem":
        """Return the problem without the parameters that a prior (P,) of zero holds at zero."""
        free = prior[self.live] > 0
        if free.all():
            return self
        a = self.a[:, free]
        rows = a if self.rows is self.a else self.rows[:, free]
        return replace(
            self, live=self.live[free], a=a, gram=self.gram[np.ix_(free, free)], rows=rows
        )

    def basis(self, scale: Floats, prior: Floats, spread: float) -> Basis:
        """Return identifiable coordinates; rounding alone decides the rank of unwhitened rows."""
        threshold = spread if self.whitened else None
        return find_basis(self.a, scale[self.live], prior[self.live], threshold)

    def equations(self, basis: Basis) -> NormalEquations:
        """Return the normal equations in the coordinates of a basis."""
        return normal_equations(self.a, self.target, basis, self.gram)

    def rss(self, equations: NormalEquations, z: Floats) -> float:
        """Return ‖y − A (θ − θ_0)‖² at the coordinates z (K,) of normal equations."""
        yy = float(self.target @ self.target)
        return yy - 2 * float(equations.rhs @ z) + float(z @ equations.gram @ z)


@dataclass(frozen=True, slots=True, eq=False)
class Regularisation:
    """Priors, noise factor and rank of a linear problem."""

    prior: Floats  # (P,) prior standard deviations (infinite: flat, zero: held at zero)
    beta: float  # noise variance factor that multiplies the prior precisions
    basis: Basis  # identifiable coordinates of the parameters that are not held at zero


def regularise(
    p: LinearProblem,
    scale: Floats,  # (P,) ordinary magnitudes
    prior: Floats,  # (P,) current prior standard deviations
    groups: Ints,  # (P,) shrinkage groups, or −1
    choose: bool,  # whether the evidence chooses the priors of shrunk families
) -> Regularisation:
    """Choose priors, noise factor and rank for a linear problem."""
    # The rms residual at the solution does not depend on the point of linearisation.
    basis = p.basis(scale, prior, 1.0)
    equations = p.equations(basis)
    rss = p.rss(equations, equations.solve(p.noise))
    spread = float(np.sqrt(max(rss, 1e-30) / max(p.rank - len(basis.singular), 1)))
    beta = 1.0 if p.whitened else spread**2
    if choose:
        prior, beta = _family_priors(p, scale, prior, groups, spread)
    basis = p.basis(scale, prior, spread).restricted(prior[p.live] > 0)
    return Regularisation(prior, beta, basis)


def _family_priors(
    p: LinearProblem, scale: Floats, prior: Floats, groups: Ints, spread: float
) -> tuple[Floats, float]:
    """Return the priors (P,) with chosen ones of shrunk families, and the noise factor."""
    beta = max(spread**2, 1.0)
    family = np.isin(np.arange(len(prior)), p.live) & (groups >= 0)
    if not family.any():
        return prior, beta
    # The families' columns are unscaled, all others in well-conditioned coordinates.
    basis = p.basis(scale, np.where(family, 1.0, prior), spread)
    equations = p.equations(basis)
    of_family = np.append(
        np.zeros(len(basis.singular), dtype=bool), family[p.live[basis.with_prior]]
    )
    order, unshrunk = np.argsort(of_family, kind="stable"), int(np.sum(~of_family))
    gram = equations.gram[np.ix_(order, order)]
    gram[np.arange(unshrunk), np.arange(unshrunk)] += beta * basis.prior_precision[order[:unshrunk]]
    square, rhs = float(p.target @ p.target), equations.rhs[order]
    best = maximise_evidence(
        gram, rhs, square, p.rank, unshrunk, groups[family], prior[family], beta
    )
    out = prior.copy()
    out[family] = best.std
    return out, best.beta


def noise_factor(p: LinearProblem, equations: NormalEquations, beta: float = 1.0) -> float:
    """Fixed point of β = max(1, RSS(β) / (R − effective parameters)), with fixed priors."""
    for _ in range(NOISE_STEPS):
        root = equations.inverse_root(beta)
        z = root.T @ (root @ equations.rhs)
        free = max(p.rank - effective_parameters(equations, beta, root), 1.0)
        beta, previous = max(1.0, p.rss(equations, z) / free), beta
        if abs(beta - previous) < NOISE_TOLERANCE * beta:
            break
    return beta


def effective_parameters(equations: NormalEquations, beta: float, root: Floats) -> float:
    """Number of flat directions plus Σ (1 − β Λ_kk H⁻¹_kk) over parameters with a prior.

    T (K, K) is the `root` with Tᵀ T = H⁻¹.
    """
    return len(equations.basis.singular) + float(np.sum(_determined(equations, beta, root)))


def spent_parameters(equations: NormalEquations, beta: float, groups: Ints) -> float:
    """Degrees of freedom that a fit uses: `effective_parameters` and the choice of strengths.

    The equations are over all parameters, `groups` (P,) their shrinkage groups, or −1.
    """
    group = groups[equations.basis.with_prior]
    determined = _determined(equations, beta, equations.inverse_root(beta))
    chosen = group >= 0
    unshrunk = float(np.sum(determined[~chosen])) + len(equations.basis.singular)
    place = np.unique(group[chosen], return_inverse=True)[1]
    size = np.bincount(place)
    share = np.bincount(place, weights=determined[chosen]) / size
    return unshrunk + float(np.sum(spent_by_groups(share, size)))


def _determined(equations: NormalEquations, beta: float, root: Floats) -> Floats:
    """Share 1 − β Λ_kk H⁻¹_kk (H,) that the data determine, of each parameter with a prior."""
    flat, precision = len(equations.basis.singular), equations.basis.prior_precision
    variance = np.sum(root[:, flat:] ** 2, axis=0)
    return np.asarray(1 - beta * precision[flat:] * variance)


@dataclass(frozen=True, slots=True, eq=False)
class NewtonPoint:
    """A point of the parameters."""

    y: Floats  # (P,) coordinates
    theta: Floats  # (P,) parameters
    rss: float  # sum of squares of the whitened residual
    elements: int  # number of elements of the residual

    def objective(self, regularisation: Regularisation) -> float:
        """Return ‖w‖² + β ‖y/σ‖² over the y with a prior."""
        held = np.isfinite(regularisation.prior) & (regularisation.prior > 0)
        return self.rss + regularisation.beta * float(
            np.sum((self.y[held] / regularisation.prior[held]) ** 2)
        )

    def mean_square(self, parameters: int = 0) -> float:
        """Return ‖w‖² over the degrees of freedom, with a number of estimated parameters."""
        return max(self.rss / max(self.elements - parameters, 1), 1e-300)


P = TypeVar("P", bound=NewtonPoint)
T = TypeVar("T")


class Minimum(NamedTuple, Generic[P]):
    """End of the iteration."""

    point: P
    regularisation: Regularisation  # of the last linear problem
    iterations: int
    converged: bool  # whether the last step was negligible
    rows: Floats | None  # (R, L) of the last linearisation if it is valid at the point


@dataclass(frozen=True, slots=True, eq=False)
class NewtonProblem(Generic[P]):
    """A model, its coordinates, and the readings of the fit."""

    model: Model
    coordinates: Coordinates
    whitened: bool  # whether rows are in units of the stated noise

    def at(self, y: Floats) -> P:
        """Return the point of coordinates (P,)."""
        raise NotImplementedError

    def linearise(self, point: P, prior: Floats) -> LinearProblem:
        """Return the linear problem at a point over the coordinates whose prior (P,) is not 0."""
        raise NotImplementedError


def linear_problem(
    point: NewtonPoint,
    prior: Floats,
    a: Floats,
    white: Floats,
    rank: int,
    noise: float,
    whitened: bool,
) -> LinearProblem:
    """Return the linear problem of whitened rows (R, L) and residual (R,) at a point.

    The unknowns are steps of flat parameters, so that unidentifiable directions do not move, and
    values of parameters with a prior. Many rows are reduced to a triangle, unless most columns have
    a prior, as their products cost less.
    """
    live, rows = np.flatnonzero(prior > 0), a
    origin = np.where(np.isinf(prior), point.y, 0.0)
    if len(a) > TALL and 2 * np.count_nonzero(np.isinf(prior)) > len(live):
        triangle = triangle_of(a, white)
        a, white = triangle[:, :-1], triangle[:, -1]
    target = white + a @ (point.y - origin)[live]
    return LinearProblem(live, origin, a, a.T @ a, target, rank, noise, whitened, rows)


def minimum(problem: NewtonProblem[P], start: Floats | None, prior: Floats | None) -> Minimum[P]:
    """Return the minimum reached from a start (P,); `prior` (P,) fixes the priors."""
    model, space = problem.model, problem.coordinates
    sigma, groups = prior_of(model)
    choose = prior is None and bool((groups >= 0).any())
    sigma = space.prior(sigma if prior is None else prior)
    scale = space.scales(scales_of(model))
    y = np.zeros(model.size) if start is None else start
    point = problem.at(np.where(sigma > 0, y, 0.0))
    chosen: Regularisation  # set in the first step
    kept, square, settled = sigma, np.inf, False
    past: list[tuple[Floats, Floats]] = []
    for iterations in range(1, MAX_ITERATIONS + 1):
        # A family dropped far from the minimum may be needed at it: all are judged at each point.
        linear = problem.linearise(point, kept if settled else sigma)
        if not settled:
            chosen = regularise(linear, scale, sigma, groups, choose)
            kept = chosen.prior
        linear = linear.restricted(kept)
        equations = linear.equations(chosen.basis)
        if (groups[linear.live] >= 0).any() or len(space.index):  # priors that β multiplies
            chosen = replace(chosen, beta=noise_factor(linear, equations, chosen.beta))
        aim = linear.origin.copy()
        aim[linear.live] += chosen.basis.transform @ equations.solve(chosen.beta)
        moved = linear.rows @ (aim - point.y)[linear.live]
        near = settled and float(moved @ moved) <= NEAR**2 * max(square, chosen.beta) * linear.rank
        past = [*past[-MEMORY:], (aim, moved)] if near else []
        if past:
            aim = _extrapolated(past)
        start_point, point = point, _line_search(problem, point, aim, chosen)
        square = point.mean_square(len(chosen.basis.singular))
        noise = max(square, chosen.beta) * linear.rank
        if settled and float(moved @ moved) <= CONVERGED**2 * noise:
            moved = linear.rows @ (point.y - start_point.y)[linear.live]
            valid = float(moved @ moved) <= CONVERGED**2 * noise
            return Minimum(point, chosen, iterations, True, linear.rows if valid else None)
        del linear  # frees memory for the next one
        least = float(point.elements) if problem.whitened else 0.0
        settled = abs(point.rss - start_point.rss) <= SETTLED * max(point.rss, least)
    return Minimum(point, chosen, iterations, False, None)


def _extrapolated(past: Sequence[tuple[Floats, Floats]]) -> Floats:
    """Return where the aims (P,) of steps lead that move the whitened readings by (R,).

    Gauss-Newton's steps fall slowly along directions that the readings hardly determine. Of all
    weighted means of the last aims, weights of sum one, that with the least mean motion is returned
    (Anderson, J. ACM 12 (1965) 547-560).
    """
    aims, moved = (np.array(x) for x in zip(*past, strict=True))
    weight = np.linalg.lstsq(np.diff(moved, axis=0).T, moved[-1], rcond=None)[0]
    return np.asarray(aims[-1] - weight @ np.diff(aims, axis=0))


def shortened(
    moved: Callable[[Floats], T],
    step: Floats,
    most: int,
    cost: Callable[[T], float] | None = None,
    limit: float = np.inf,
) -> T | None:
    """Return the first result of the full step, half of it, … whose cost is at most the limit.

    None without one; `moved` and `cost` may raise CannotAnswerError.
    """
    for halving in range(most):
        try:
            reached = moved(0.5**halving * step)
            if cost is None or cost(reached) <= limit:
                return reached
        except CannotAnswerError:
            continue
    return None


def _line_search(problem: NewtonProblem[P], point: P, aim: Floats, chosen: Regularisation) -> P:
    """Go towards `aim` (P,).

    The step is halved while the objective grows, as the chain may be strongly nonlinear.
    """
    y = np.where(chosen.prior > 0, point.y, 0.0)
    limit = point.objective(chosen) * (1 + 1e-9) + 1e-12
    reached = shortened(
        lambda step: problem.at(y + step), aim - y, HALVINGS, lambda p: p.objective(chosen), limit
    )
    return problem.at(y) if reached is None else reached


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Brief):
    """The minimum reached by Gauss-Newton."""

    theta: Floats  # (P,) parameters
    y: Floats  # (P,) coordinates in which the prior is independent
    space: Coordinates  # mapping between y and theta
    prior: Floats  # (P,) prior standard deviations of y (infinite: flat, zero: held at zero)
    beta: float  # noise variance factor that multiplies the prior precisions
    equations: NormalEquations  # at the solution, in identifiable coordinates z of y
    rows: Floats  # (R, K) whitened derivative of the measurements by z
    prediction: Prediction
    raw: Floats  # (D, m) residual
    white: Floats  # (R,) whitened residual
    effective: float  # degrees of freedom that the fit uses, with the choice of strengths
    iterations: int
    converged: bool  # whether the last step was negligible

    @property
    def live(self) -> Ints:
        """(L,) indices of the y that are not held at zero."""
        return np.flatnonzero(self.prior > 0)

    @property
    def transform(self) -> Floats:
        """(P, K) change of the parameters by z."""
        return self.space.transform(self.equations.basis.transform)

    @property
    def estimated(self) -> Bools:
        """(P,) parameters that are not held at zero."""
        return np.asarray((self.prior != 0) | self.space.carried(len(self.theta)))

    def projection(self) -> Projection:
        """Return the projection off the columns of the model."""
        ridge = self.beta * self.equations.basis.prior_precision
        return projection(self.rows, ridge, self.equations.gram)

    def coordinates(self) -> Floats:
        """Return z (K,) of the parameters with a prior; zero for flat directions."""
        return prior_coordinates(self.equations.basis, self.y, self.prior)


@dataclass(frozen=True, slots=True, eq=False)
class _Iterate(NewtonPoint):
    prediction: Prediction
    raw: Floats
    white: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Problem(NewtonProblem[_Iterate]):
    readings: Readings
    w: Whitening

    def at(self, y: Floats) -> _Iterate:
        theta = self.coordinates.theta(y)
        prediction = self.model.predict(self.readings.states, theta)
        raw = residual(self.readings, prediction, self.w)
        white = self.w.whiten(raw).reshape(-1)
        return _Iterate(y, theta, float(np.sum(white**2)), white.size, prediction, raw, white)

    def linearise(self, point: _Iterate, prior: Floats) -> LinearProblem:
        a = self.columns(point, np.flatnonzero(prior > 0))
        noise = 1.0 if self.whitened else point.mean_square()
        return linear_problem(point, prior, a, point.white, self.w.rank, noise, self.whitened)

    def columns(self, point: _Iterate, live: Ints) -> Floats:
        """Whitened derivative (R, L) by the live coordinates."""
        return columns_of(self.model, self.coordinates, point.prediction, point.theta, self.w, live)


def solve(
    model: Model,
    readings: Readings,  # without gross errors
    w: Whitening,  # their scaling
    start: Floats | None = None,  # (P,) first parameters; else zero, or a carried prior's mean
    prior: Floats | None = None,  # (P,) fixed prior standard deviations; else the evidence chooses
    # those of shrunk families
) -> Solution:
    """Fit all parameters of the model to the readings."""
    space = coordinates_of(model)
    if len(space.index):
        theta = space.theta(np.zeros(model.size)) if start is None else start
        prediction = model.predict(readings.states, theta)
        a = whitened_jacobian(model, prediction, theta, w, np.arange(model.size))
        space = space.restricted(a)
    problem = _Problem(model, space, w.scaling != "none", readings, w)
    end = minimum(problem, None if start is None else space.of_theta(start), prior)
    point, chosen = end.point, end.regularisation
    live = np.flatnonzero(chosen.prior > 0)
    rows = chosen.basis.rows(problem.columns(point, live) if end.rows is None else end.rows)
    beta = point.mean_square(len(chosen.basis.singular)) if w.scaling == "none" else chosen.beta
    # Formed from the rows themselves, so that folds can be subtracted exactly.
    basis = over_all_parameters(chosen.basis, live, model.size)
    target = point.white + rows @ prior_coordinates(basis, point.y, chosen.prior)
    equations = NormalEquations(basis, rows.T @ rows, rows.T @ target)
    return Solution(
        theta=point.theta,
        y=point.y,
        space=space,
        prior=chosen.prior,
        beta=beta,
        equations=equations,
        rows=rows,
        prediction=point.prediction,
        raw=point.raw,
        white=point.white,
        effective=spent_parameters(equations, beta, prior_of(model)[1]),
        iterations=end.iterations,
        converged=end.converged,
    )


def whitened_jacobian(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live parameters; see `derivative`."""
    jacobian = derivative(model, prediction, theta, w.m, w.mode, live)
    return w.whiten_readings(jacobian, overwrite=True)


def derivative(
    model: Model, prediction: Prediction, theta: Floats, m: int, mode: Mode,
    live: Ints | None = None,
) -> Floats:  # fmt: skip
    """Derivative (N, m, L) of readings by the live parameters, from which these are estimated.

    It is `Model.jacobian`, but in absolute readings the columns of targets with a prior are those
    of the arm without its errors. A target has a prior where the flange turns so little that the
    poses do not determine its place (`baseline.with_effects`). At parameters that were estimated
    from the same readings the flange also turns by the estimated errors of the arm; these follow
    the residual, so that the derivative there tells the place with an information that the readings
    do not have: with one orientation, joint values as the controller computes them, the target of a
    real UR10 came out 1.4 m from the flange, with a standard deviation of 0.1 m.
    """
    live = np.arange(model.size) if live is None else live
    jacobian = model.jacobian(prediction, theta, m, live)
    if mode != "absolute":
        return jacobian
    of_target, of_frames = np.zeros((2, model.size), dtype=np.bool_)
    for e, rows in zip(model.effects, model.slices(), strict=True):
        of_frames[rows] = e.role in FRAME_ROLES
        of_target[rows] = e.role == "target" and e.prior_std() is not None
    columns = np.flatnonzero(of_target[live])
    if len(columns) and np.any(theta[~of_frames]):
        without_errors = np.where(of_frames, theta, 0.0)
        nominal = model.predict(prediction.situation.states, without_errors)
        jacobian[:, :, columns] = model.jacobian(nominal, without_errors, m, live[columns])
    return jacobian


def columns_of(
    model: Model,
    space: Coordinates,
    prediction: Prediction,
    theta: Floats,
    w: Whitening,
    live: Ints,
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live coordinates y."""
    if not len(space.index):
        return whitened_jacobian(model, prediction, theta, w, live)
    needed = np.union1d(live, space.index)
    columns = whitened_jacobian(model, prediction, theta, w, needed)
    a = np.zeros((len(columns), model.size))
    a[:, needed] = columns
    return space.columns(a)[:, live]


def prior_coordinates(basis: Basis, y: Floats, prior: Floats) -> Floats:
    """Return z (K,) of the y with a prior; zero for flat directions."""
    flat = np.zeros(len(basis.singular))
    return np.concatenate([flat, y[basis.with_prior] / prior[basis.with_prior]])


def over_all_parameters(basis: Basis, live: Ints, size: int) -> Basis:
    """Extend a basis over the live parameters to all parameters."""
    transform = np.zeros((size, basis.transform.shape[1]))
    null, flat = np.zeros((size, basis.null.shape[1])), np.zeros(size, dtype=bool)
    transform[live], null[live], flat[live] = basis.transform, basis.null, basis.flat
    return replace(
        basis, transform=transform, null=null, flat=flat, with_prior=live[basis.with_prior]
    )
