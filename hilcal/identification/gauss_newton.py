"""Whitened Gauss-Newton on the exact chain.

    minimise ‖w(θ)‖² + β ‖y/σ‖²,    θ = m + U y

w (R,) whitened residual, y coordinates in which the prior is independent and about zero, θ itself
without a carried prior (see `coordinates`), σ their prior standard deviations, β the noise factor
they are weighed against.
"""

from dataclasses import dataclass, replace

import numpy as np

from hilcal.identification.coordinates import Coordinates, coordinates_of
from hilcal.identification.gauss_newton_steps import (
    NewtonPoint,
    NewtonProblem,
    linear_problem,
    minimum,
)
from hilcal.identification.priors import prior_of
from hilcal.identification.regularisation import LinearProblem, spent_parameters
from hilcal.identification.residual import residual
from hilcal.model.model import Model, Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening
from hilcal.regression.normal_equations import Basis, NormalEquations
from hilcal.regression.projection import Projection, projection
from hilcal.types import Bools, Floats, Ints


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

    @property
    def ridge(self) -> Floats:
        """(K,) prior precisions of z, weighed against the noise factor."""
        return self.beta * self.equations.basis.prior_precision

    def projection(self) -> Projection:
        """Return the projection off the columns of the model."""
        return projection(self.rows, self.ridge, self.equations.gram)

    def coordinates(self) -> Floats:
        """Return z (K,) of the parameters that have a prior; zero for flat directions."""
        return prior_coordinates(self.equations.basis, self.y, self.prior)

    def projected_residual(self) -> Floats:
        """(R,) whitened residual after the model's remaining step: `white` to within that step."""
        return self.projection().residual(self.white, self.coordinates())


@dataclass(frozen=True, slots=True, eq=False)
class _Iterate(NewtonPoint):
    """A point with the prediction there, the residual (D, m), also whitened (R,)."""

    prediction: Prediction
    raw: Floats
    white: Floats


@dataclass(frozen=True, slots=True, eq=False)
class _Problem(NewtonProblem[_Iterate]):
    """Readings that fit into memory, and their scaling."""

    readings: Readings
    w: Whitening

    def at(self, y: Floats) -> _Iterate:
        theta = self.coordinates.theta(y)
        prediction = self.model.predict(self.readings.states, theta)
        raw = residual(self.readings, prediction, self.w)
        white = self.w.whiten(raw).reshape(-1)
        return _Iterate(y, theta, float(np.sum(white**2)), white.size, prediction, raw, white)

    def linearise(self, point: _Iterate, prior: Floats) -> LinearProblem:
        live = np.flatnonzero(prior > 0)
        noise = 1.0 if self.whitened else point.mean_square()
        a = self.columns(point, live)
        return linear_problem(point, prior, a, point.white, self.w.rank, noise, self.whitened)

    def columns(self, point: _Iterate, live: Ints) -> Floats:
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
    problem = _Problem(model, coordinates, w.scaling != "none", readings, w)
    y = None if start is None else coordinates.of_theta(start)
    found = minimum(problem, y, prior)
    point, by = found.point, found.by
    live = np.flatnonzero(by.prior > 0)
    columns = problem.columns(point, live) if found.rows is None else found.rows
    rows = by.basis.rows(columns)
    beta = point.mean_square(len(by.basis.singular)) if w.scaling == "none" else by.beta
    # Formed anew at the solution, so that folds can be taken out of them exactly.
    basis = over_all_parameters(by.basis, live, model.size)
    target = point.white + rows @ prior_coordinates(basis, point.y, by.prior)
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
        iterations=found.iterations,
        converged=found.converged,
    )


def whitened_jacobian(
    model: Model, prediction: Prediction, theta: Floats, w: Whitening, live: Ints
) -> Floats:
    """Whitened derivative (R, L) of the measurements by the live parameters."""
    return w.whiten_readings(model.jacobian(prediction, theta, w.m, live), overwrite=True)


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


def prior_coordinates(basis: Basis, y: Floats, prior: Floats) -> Floats:
    """Return z (K,) of the y that have a prior; zero for flat directions."""
    z = np.zeros(len(basis.prior_precision))
    z[len(basis.singular) :] = y[basis.held] / prior[basis.held]
    return z


def over_all_parameters(basis: Basis, live: Ints, size: int) -> Basis:
    """Express a basis over the live parameters over all of them."""
    transform = np.zeros((size, basis.transform.shape[1]))
    transform[live] = basis.transform
    null = np.zeros((size, basis.null.shape[1]))
    null[live] = basis.null
    flat = np.zeros(size, dtype=bool)
    flat[live] = basis.flat
    return replace(basis, transform=transform, null=null, flat=flat, held=live[basis.held])
