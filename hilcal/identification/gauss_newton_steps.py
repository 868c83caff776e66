"""Gauss-Newton steps to a minimum, of readings in memory or in a stream.

    minimise ‖w(y)‖² + β ‖y/σ‖²

w (R,) whitened residual, y coordinates, σ their prior standard deviations, β the noise factor they
are weighed against. What a problem has to say of itself is `NewtonProblem`: the objective at a
point, and the linear problem there, whose rows may be any that have the same products.
"""

from dataclasses import dataclass, replace
from typing import ClassVar, Generic, TypeVar

import numpy as np

from hilcal.identification.coordinates import Coordinates
from hilcal.identification.priors import prior_of, scales_of
from hilcal.identification.regularisation import (
    LinearProblem,
    Regularisation,
    noise_factor,
    regularise,
)
from hilcal.identification.solver import shortened
from hilcal.model.model import Model
from hilcal.regression.normal_equations import TALL, triangle_of
from hilcal.types import Floats

MAX_ITERATIONS = 20
"""Most Gauss-Newton steps; a choice, the tests of convergence allow 8."""
CONVERGED = 1e-5
"""A step that moves the whitened readings by less than this, in units of the noise; a choice."""
SETTLED = 0.02
"""Priors and rank are chosen at each step until the residual changes by less than this share from
one step to the next, or is within the noise; then they are kept. A choice, no study set it."""
DEPTH = 3
"""EarlierFit steps that a step is combined with; a choice, there are as few weak directions."""
HALVINGS = 8
"""Most step lengths of a line search; a choice, no study set it."""


@dataclass(frozen=True, slots=True, eq=False)
class NewtonPoint:
    """A point of the parameters.

    Attributes:
        y: (P,) coordinates.
        theta: (P,) parameters.
        rss: sum of squares of the whitened residual.
        elements: its number of elements.
    """

    y: Floats
    theta: Floats
    rss: float
    elements: int

    def objective(self, by: Regularisation) -> float:
        """Return ‖w‖² + β ‖y/σ‖² over the y that have a prior."""
        held = np.isfinite(by.prior) & (by.prior > 0)
        penalty = by.beta * float(np.sum((self.y[held] / by.prior[held]) ** 2))
        return self.rss + penalty

    def mean_square(self, parameters: int = 0) -> float:
        """Return the mean square of the whitened residual with some parameters estimated."""
        return max(self.rss / max(self.elements - parameters, 1), 1e-300)


P = TypeVar("P", bound=NewtonPoint)


@dataclass(frozen=True, slots=True, eq=False)
class Minimum(Generic[P]):
    """Where the steps ended.

    Attributes:
        point: the last point.
        by: priors, noise factor and basis of the last linear problem.
        iterations: steps taken.
        converged: whether the last step was negligible.
        rows: (R, L) rows of the last linearisation, where the point is within a negligible step of
            it; else None.
    """

    point: P
    by: Regularisation
    iterations: int
    converged: bool
    rows: Floats | None


@dataclass(frozen=True, slots=True, eq=False)
class NewtonProblem(Generic[P]):
    """A model, its coordinates, and the readings that it is fitted to.

    Attributes:
        model: robot and effects.
        coordinates: of its parameters.
        whitened: whether rows are in units of the stated noise.
    """

    same_rows: ClassVar[bool] = True
    """Whether row i of every linearisation is of the same element of the readings."""

    model: Model
    coordinates: Coordinates
    whitened: bool

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

    Flat parameters step from where they are, so that unidentifiable directions stay put; those with
    a prior are solved for as a whole, since the prior is about zero.

    Many rows are reduced to a triangle once, which rank analysis, priors and solution then take in
    place of them; unless most columns have a prior, whose products alone cost less.
    """
    live = np.flatnonzero(prior > 0)
    origin = np.where(np.isinf(prior), point.y, 0.0)
    rows = a
    if len(a) > TALL and 2 * np.count_nonzero(np.isinf(prior)) > len(live):
        triangle = triangle_of(a, white)
        a, white = triangle[:, :-1], triangle[:, -1]
    target = white + a @ (point.y - origin)[live]
    return LinearProblem(live, origin, a, a.T @ a, target, rank, noise, whitened, rows)


def minimum(problem: NewtonProblem[P], start: Floats | None, prior: Floats | None) -> Minimum[P]:
    """Return the minimum from a start (P,) on, with priors (P,) that are kept where given."""
    model, of = problem.model, problem.coordinates
    sigma, groups = prior_of(model)
    choose = prior is None and bool((groups >= 0).any())
    sigma, scale = of.prior(sigma if prior is None else prior), of.scales(scales_of(model))
    y = np.zeros(model.size) if start is None else start
    point = problem.at(np.where(sigma > 0, y, 0.0))
    by: Regularisation  # set in the first step
    square, settled, converged = np.inf, False, False
    path = Acceleration()
    for iterations in range(1, MAX_ITERATIONS + 1):
        linear = problem.linearise(point, sigma)
        if not settled:
            by = regularise(linear, scale, sigma, groups, choose)
            sigma = by.prior
        linear = linear.restricted(sigma)
        weighed = bool((groups[linear.live] >= 0).any()) or bool(len(of.index))
        by, aim = _step(linear, by, weighed)
        moved = linear.rows @ (aim - point.y)[linear.live]
        shortcut = path.accelerated(aim, moved) if settled and problem.same_rows else None
        begin, point = point, _line_search(problem, point, aim, by, shortcut)
        before, square = square, point.mean_square(len(by.basis.singular))
        noise = max(square, by.beta) * linear.rank
        converged = settled and float(moved @ moved) <= CONVERGED**2 * noise
        if converged:
            moved = linear.rows @ (point.y - begin.y)[linear.live]
            near = float(moved @ moved) <= CONVERGED**2 * noise
            return Minimum(point, by, iterations, True, linear.rows if near else None)
        del linear  # before the next one is made
        settled = (problem.whitened and square < 1) or abs(square / before - 1) <= SETTLED
    return Minimum(point, by, iterations, False, None)


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
    problem: NewtonProblem[P], point: P, aim: Floats, by: Regularisation, shortcut: Floats | None
) -> P:
    """Go to the `shortcut` (P,), unless the objective grows; else towards `aim` (P,).

    On the way to `aim` half as far each time while the objective grows: the chain may be strongly
    nonlinear along a step in a weakly determined direction.
    """

    def cost(trial: P) -> float:
        return trial.objective(by)

    now, begin = cost(point), np.where(by.prior > 0, point.y, 0.0)
    found: P | None = None
    if shortcut is not None:
        found = shortened(problem.at, shortcut, 1, cost, now)
    if found is None:
        limit = now * (1 + 1e-9) + 1e-12
        found = shortened(lambda step: problem.at(begin + step), aim - begin, HALVINGS, cost, limit)
    return problem.at(begin) if found is None else found
