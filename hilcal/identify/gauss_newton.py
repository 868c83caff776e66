"""Whitened Gauss-Newton on the exact chain.

    minimise ‖w(θ)‖² + β ‖y/σ‖²,    θ = m + U y

w (R,) whitened residual, y coordinates in which the prior is independent and about zero, θ itself
without a carried prior (see `coordinates`), σ their prior standard deviations, β the noise factor
they are weighed against.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.data.readings import Readings
from hilcal.data.whitening import Whitening
from hilcal.errors import CannotAnswerError
from hilcal.identify.coordinates import Coordinates, coordinates_of
from hilcal.identify.priors import prior_of, scales_of
from hilcal.identify.regularisation import (
    LinearProblem,
    Regularisation,
    noise_factor,
    regularise,
    spent_parameters,
)
from hilcal.identify.residual import residual
from hilcal.model import Model, Prediction
from hilcal.regression.normal_equations import Basis, NormalEquations
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats, Ints

MAX_ITERATIONS = 20
"""Most Gauss-Newton steps; a choice, the tests of convergence allow 8."""
CONVERGED = 1e-5
"""A step that moves the whitened readings by less than this, in units of the noise; a choice."""
SETTLED = 0.02
"""Priors and rank are chosen at each step until the residual changes by less than this share from
one step to the next, or is within the noise; then they are kept. A choice, no study set it."""
DEPTH = 3
"""Earlier steps that a step is combined with; a choice, there are as few weak directions."""
HALVINGS = 8
"""Most step lengths of a line search; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """The minimum that Gauss-Newton reached.

    Attributes:
        theta: (P,) parameters.
        y: (P,) the same in coordinates in which the prior is independent.
        space: these coordinates.
        prior: (P,) prior standard deviations of y (infinite: flat, zero: held at zero).
        beta: noise variance factor that the priors were weighed against.
        equations: normal equations at the solution, in identifiable coordinates z of y.
        live: (L,) indices of the y that are not held at zero.
        rows: (R, K) whitened derivative of the measurements by z.
        prediction: prediction at the solution.
        raw: (D, m) residual.
        white: (R,) whitened residual.
        effective: degrees of freedom that the fit spends, the choice of strengths included.
        iterations: steps taken.
        converged: whether the last step was negligible.
    """

    theta: Floats
    y: Floats
    space: Coordinates
    prior: Floats
    beta: float
    equations: NormalEquations
    live: Ints
    rows: Floats
    prediction: Prediction
    raw: Floats
    white: Floats
    effective: float
    iterations: int
    converged: bool

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
        """Return z (K,) of the parameters that have a prior; zero for flat directions."""
        return _coordinates(self.equations.basis, self.y, self.prior)

    def projected_residual(self) -> Floats:
        """(R,) whitened residual after the model's remaining step: `white` to within that step."""
        return self.projection().residual(self.white, self.coordinates())


@dataclass(frozen=True, slots=True, eq=False)
class _Point:
    """y (P,), parameters (P,), the prediction there, the residual (D, m), also whitened (R,)."""

    y: Floats
    theta: Floats
    prediction: Prediction
    raw: Floats
    white: Floats

    def objective(self, by: Regularisation) -> float:
        """Return ‖w‖² + β ‖y/σ‖² over the y that have a prior."""
        held = np.isfinite(by.prior) & (by.prior > 0)
        penalty = by.beta * float(np.sum((self.y[held] / by.prior[held]) ** 2))
        return float(np.sum(self.white**2)) + penalty

    def mean_square(self, parameters: int = 0) -> float:
        """Return the mean square of the whitened residual with some parameters estimated."""
        free = max(self.white.size - parameters, 1)
        return max(float(np.sum(self.white**2)) / free, 1e-300)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """A model, its coordinates, the readings that it is fitted to, and their scaling."""

    model: Model
    coordinates: Coordinates
    readings: Readings
    w: Whitening

    def at(self, y: Floats) -> _Point:
        """Return the point of coordinates (P,)."""
        theta = self.coordinates.theta(y)
        prediction = self.model.predict(self.readings.states, theta)
        raw = residual(self.readings, prediction, self.w)
        return _Point(y, theta, prediction, raw, self.w.whiten(raw).reshape(-1))

    def columns(self, point: _Point, live: Ints) -> Floats:
        """Whitened derivative (R, L) by the live coordinates."""
        return columns_of(self.model, self.coordinates, point.prediction, point.theta, self.w, live)


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
        start: (P,) starting parameters; zero unless given, the mean of a carried prior.
        prior: (P,) prior standard deviations to keep as they are; otherwise those of
            shrunk families are chosen by the evidence.
    """
    coordinates = coordinates_of(model)
    if len(coordinates.index):
        theta = coordinates.theta(np.zeros(model.size)) if start is None else start
        prediction = model.predict(readings.states, theta)
        a = whitened_jacobian(model, prediction, theta, w, np.arange(model.size))
        coordinates = coordinates.felt(a)
    problem = _Problem(model, coordinates, readings, w)
    y = None if start is None else coordinates.of_theta(start)
    point, by, iterations, converged = _minimise(problem, y, prior)
    live = np.flatnonzero(by.prior > 0)
    rows = by.basis.rows(problem.columns(point, live))
    beta = point.mean_square(len(by.basis.singular)) if w.scaling == "none" else by.beta
    # Formed anew at the solution, so that folds can be taken out of them exactly.
    basis = _all_parameters(by.basis, live, model.size)
    target = point.white + rows @ _coordinates(basis, point.y, by.prior)
    equations = NormalEquations(basis, rows.T @ rows, rows.T @ target)
    return Solution(
        theta=point.theta,
        y=point.y,
        space=coordinates,
        prior=by.prior,
        beta=beta,
        equations=equations,
        live=live,
        rows=rows,
        prediction=point.prediction,
        raw=point.raw,
        white=point.white,
        effective=spent_parameters(equations, beta, prior_of(model)[1]),
        iterations=iterations,
        converged=converged,
    )


def _minimise(
    problem: _Problem, start: Floats | None, prior: Floats | None
) -> tuple[_Point, Regularisation, int, bool]:
    """Return the minimum, what it was regularised by, the steps, and whether they converged."""
    model, of = problem.model, problem.coordinates
    sigma, groups = prior_of(model)
    choose = prior is None and bool((groups >= 0).any())
    sigma, scale = of.prior(sigma if prior is None else prior), of.scales(scales_of(model))
    y = np.zeros(model.size) if start is None else start
    point = problem.at(np.where(sigma > 0, y, 0.0))
    by: Regularisation  # set in the first step
    square, settled, converged = np.inf, False, False
    path = Acceleration()
    for iterations in range(1, MAX_ITERATIONS + 1):  # noqa: B007 - reported
        linear = _linearise(problem, point, sigma)
        if not settled:
            by = regularise(linear, scale, sigma, groups, choose)
            sigma = by.prior
        linear = linear.restricted(sigma)
        weighed = bool((groups[linear.live] >= 0).any()) or bool(len(of.index))
        by, aim = _step(linear, by, weighed)
        moved = linear.a @ (aim - point.y)[linear.live]
        shortcut = path.accelerated(aim, moved) if settled else None
        point = _line_search(problem, point, aim, by, shortcut)
        before, square = square, point.mean_square(len(by.basis.singular))
        noise = max(square, by.beta) * len(moved)
        converged = settled and float(moved @ moved) <= CONVERGED**2 * noise
        if converged:
            break
        del linear  # before the next one is made
        settled = (problem.w.scaling != "none" and square < 1) or abs(
            square / before - 1
        ) <= SETTLED
    return point, by, iterations, converged


def _linearise(problem: _Problem, point: _Point, prior: Floats) -> LinearProblem:
    """Return the linear problem at a point.

    Flat parameters step from where they are, so that unidentifiable directions stay put; those with
    a prior are solved for as a whole, since the prior is about zero.
    """
    w, live = problem.w, np.flatnonzero(prior > 0)
    a = problem.columns(point, live)
    origin = np.where(np.isinf(prior), point.y, 0.0)
    target = point.white + a @ (point.y - origin)[live]
    whitened = w.scaling != "none"
    noise = 1.0 if whitened else point.mean_square()
    return LinearProblem(live, origin, a, a.T @ a, target, w.rank, noise, whitened)


def whitened_jacobian(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live parameters."""
    jacobian = model.jacobian(prediction, theta, w.m, live)
    return w.whiten_readings(jacobian)


def columns_of(
    model: Model,
    coordinates: Coordinates,
    prediction: Prediction,
    theta: Floats,
    w: Whitening,
    live: Ints,
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live coordinates y."""
    if not len(coordinates.index):
        return whitened_jacobian(model, prediction, theta, w, live)
    needed = np.union1d(live, coordinates.index)
    found = whitened_jacobian(model, prediction, theta, w, needed)
    a = np.zeros((len(found), model.size))
    a[:, needed] = found
    return coordinates.columns(a)[:, live]


def _step(
    linear: LinearProblem, by: Regularisation, weighed: bool
) -> tuple[Regularisation, Floats]:
    """Solve the linear problem for (P,) y; priors that are weighed need the noise factor first."""
    equations = linear.equations(by.basis)
    if weighed:
        by = replace(by, beta=noise_factor(linear, equations, by.beta))
    aim = linear.origin.copy()
    aim[linear.live] += by.basis.transform @ equations.solve(by.beta)
    return by, aim


class Acceleration:
    """Anderson's acceleration of the steps that follow once priors and rank are settled.

    Where a residual remains, steps in a weakly determined direction shrink by a constant factor
    only. With f_i the motion of the whitened readings by step i, and g_i where it leads to, the
    combination Σ α_i f_i, Σ α_i = 1, of the last steps that is shortest leads to Σ α_i g_i.

    Source: Walker and Ni, *Anderson acceleration for fixed-point iterations*, SIAM J. Numer. Anal.
    49 (2011) 1715-1735.
    """

    def __init__(self) -> None:
        """Begin without steps."""
        self._aims: list[Floats] = []
        self._moves: list[Floats] = []

    def accelerated(self, aim: Floats, moved: Floats) -> Floats | None:
        """Return where the steps so far lead to; None after the first.

        Args:
            aim: (P,) where the step leads to by itself.
            moved: (R,) its motion of the whitened readings.
        """
        self._aims, self._moves = [*self._aims[-DEPTH:], aim], [*self._moves[-DEPTH:], moved]
        if len(self._aims) == 1:
            return None
        differences = np.diff(self._moves, axis=0)
        gamma = np.linalg.lstsq(differences.T, moved, rcond=None)[0]
        return np.asarray(aim - gamma @ np.diff(self._aims, axis=0))


def _line_search(
    problem: _Problem, point: _Point, aim: Floats, by: Regularisation, shortcut: Floats | None
) -> _Point:
    """Go to the `shortcut` (P,), unless the objective grows; else towards `aim` (P,).

    On the way to `aim` half as far each time while the objective grows: the chain may be strongly
    nonlinear along a step in a weakly determined direction.
    """
    now = point.objective(by)
    if shortcut is not None:
        try:
            trial = problem.at(shortcut)
            if trial.objective(by) <= now:
                return trial
        except CannotAnswerError:
            pass
    begin = np.where(by.prior > 0, point.y, 0.0)
    for halving in range(HALVINGS):
        share = 0.5**halving
        try:
            trial = problem.at(aim if share == 1 else begin + share * (aim - begin))
        except CannotAnswerError:
            continue
        if trial.objective(by) <= now * (1 + 1e-9) + 1e-12:
            return trial
    return problem.at(begin)


def _coordinates(basis: Basis, y: Floats, prior: Floats) -> Floats:
    """Return z (K,) of the y that have a prior; zero for flat directions."""
    z = np.zeros(len(basis.prior_precision))
    z[len(basis.singular) :] = y[basis.held] / prior[basis.held]
    return z


def _all_parameters(basis: Basis, live: Ints, size: int) -> Basis:
    """Express a basis over the live parameters over all of them."""
    transform = np.zeros((size, basis.transform.shape[1]))
    transform[live] = basis.transform
    null = np.zeros((size, basis.null.shape[1]))
    null[live] = basis.null
    flat = np.zeros(size, dtype=bool)
    flat[live] = basis.flat
    return replace(basis, transform=transform, null=null, flat=flat, held=live[basis.held])
