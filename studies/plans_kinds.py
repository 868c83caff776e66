"""The compared plans: of the planner, at random, and a grid as made by hand."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import cycle

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.design.choice import EFFORT, compound_objective
from hilcal.design.feasible import FeasibleSpace, draw_poses
from hilcal.design.information import DesignProblem, problem
from hilcal.design.nominal_model import NominalModel, nominal_model
from hilcal.design.optimum import best_design
from hilcal.design.predicted import (
    PredictedUncertainty,
    PredictionPoses,
    predicted_uncertainty,
    prediction_poses,
    rms,
)
from hilcal.errors import CannotAnswerError
from hilcal.types import Floats, Ints

LEVELS = (3, 4, 5, 6)
"""Levels per joint of a grid; the coarsest grid with enough feasible poses is used."""
TEST_POSES = 50
"""Number of drawn test poses where the configuration names none."""
MATCHED = 20
"""Random plans that determine the number of readings for a planned accuracy."""
MOST = 20
"""Largest number of readings that is tried, as a multiple of the plan's."""


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A cell to plan for.

    Attributes:
        cell: the cell.
        config: its configuration.
        space: its feasible states.
        nominal: the model.
        exact: the design problem of the model alone.
        robust: the problem with the potential terms of the configuration; None without any.
        work: test poses; drawn independently of the candidates where the configuration names none.
    """

    cell: Cell
    space: FeasibleSpace
    nominal: NominalModel
    exact: DesignProblem
    robust: DesignProblem | None
    work: PredictionPoses

    def with_others(self, chosen: "Chosen") -> float | None:
        """Predicted RMS position error, m, with potential terms estimated, too; else None."""
        if self.robust is None or chosen.problem not in (self.exact, self.robust):
            return None
        if self.robust.contents != self.exact.contents:
            return None
        return predicted_uncertainty(self.robust, chosen.counts, work=self.work).position_open


@dataclass(frozen=True, slots=True, eq=False)
class Chosen:
    """A plan.

    Attributes:
        problem: the design problem of its units.
        counts: (K,) number of repetitions of each unit.
        predicted: predicted uncertainty.
        efficiency: certified by the planner; None for other plans.
    """

    problem: DesignProblem
    counts: Floats
    predicted: PredictedUncertainty
    efficiency: float | None = None

    @property
    def readings(self) -> int:
        """Number of readings, the unloaded ones included."""
        return round(float(self.counts @ self.problem.units.cost))

    @property
    def poses(self) -> int:
        """Number of different poses."""
        return len({self.problem.contents[k][0] for k in np.flatnonzero(self.counts)})


def scene(cell: Cell, candidates: int, rng: np.random.Generator) -> Scene:
    """Draw candidates and test poses of a cell and set up its design problems.

    Raises:
        CannotAnswerError: no feasible pose, or no load that any of them bears.
        InputError: from the configuration's `[planning]`.
    """
    config = cell.configured()
    space = FeasibleSpace(cell)
    drawn = draw_poses(space, candidates, rng)
    apart = draw_poses(space, TEST_POSES, rng).q
    model = nominal_model(cell)
    alone = without_potential(config)
    exact = problem(model, alone, drawn.q, drawn.allowed)
    robust = problem(model, config, drawn.q, drawn.allowed) if config.planning.against else None
    work = prediction_poses(model, config, apart, space.allowed)
    return Scene(cell, space, model, exact, robust, work)


def without_potential(config: CellConfig) -> CellConfig:
    """Return the configuration of a plan for the model alone."""
    return config.with_keys("planning", against=())


def optimal(
    s: Scene, criterion: str, budget: int, rng: np.random.Generator, *, robust: bool = False
) -> Chosen:
    """Return the planner's plan of so many readings.

    Args:
        s: the cell.
        criterion: "D", "test", ...
        budget: number of readings with the unloaded ones.
        rng: generator.
        robust: whether the plan keeps power against the potential terms.
    """
    of_plan, config = s.exact, without_potential(s.cell.configured())
    if robust and s.robust is not None:
        of_plan, config = s.robust, s.cell.configured()
    objective = compound_objective(of_plan, config, criterion, s.work, float(budget), rng)
    design = best_design(objective, float(budget), rng, effort=EFFORT)
    counts = np.asarray(design.counts, dtype=float)
    return Chosen(
        of_plan, counts, predicted_uncertainty(of_plan, counts, work=s.work), design.efficiency
    )


def at_random(s: Scene, budget: int, rng: np.random.Generator) -> Chosen:
    """Return a plan of random feasible poses, each under every load that it bears."""
    order = rng.permutation(len(s.exact.candidates))
    return _of_poses(s.exact, cycle(order.tolist()), budget, s.work)


def grid(s: Scene, budget: int) -> Chosen:
    """Return a plan as made by hand: the feasible poses of a regular grid in joint space.

    The coarsest grid with enough poses is thinned evenly to the number of readings; each pose is
    read under every load that it bears.

    Raises:
        CannotAnswerError: no pose of the finest grid is feasible.
    """
    space = s.space
    for levels in LEVELS:
        share = (np.arange(levels) + 0.5) / levels
        unit = np.stack(np.meshgrid(*[share] * len(space.low), indexing="ij"), axis=-1)
        q = space.low + unit.reshape(-1, len(space.low)) * (space.high - space.low)
        q = q[space.allowed(q)]
        allowed = np.ones((len(q), len(space.loads)), dtype=np.bool_)
        for k, load in enumerate(space.loads[1:], start=1):
            allowed[:, k] = space.allowed(q, load)
        some = allowed[:, 1:].any(axis=1) | (s.exact.mode == "absolute")
        q, allowed = q[some], allowed[some]
        if allowed.sum() >= budget:
            break
    if not len(q):
        raise CannotAnswerError("no pose of a regular grid in joint space is feasible")
    of_grid = problem(s.nominal, without_potential(s.cell.configured()), q, allowed)
    poses = next((n for n in range(1, len(q)) if allowed[_even(len(q), n)].sum() >= budget), len(q))
    order = _even(len(q), poses)
    return _of_poses(of_grid, cycle(order.tolist()), budget, s.work)


def _even(count: int, number: int) -> Ints:
    """Indices (number,) spread evenly over `count`."""
    return np.asarray(np.floor((np.arange(number) + 0.5) * count / number), dtype=np.int64)


def matching(
    s: Scene, position: float, budget: int, rng: np.random.Generator, *, others: bool = False
) -> int | None:
    """Return the number of readings that random plans need for an accuracy at the test poses.

    It is the least number for which the predicted mean square over random plans is small enough;
    None where `MOST` times the budget does not suffice.

    Args:
        s: the cell.
        position: required RMS standard deviation, m.
        budget: number of readings to start from.
        rng: generator.
        others: whether the potential terms are estimated, too.
    """
    orders = [rng.permutation(len(s.exact.candidates)).tolist() for _ in range(MATCHED)]
    judge = s.robust if others and s.robust is not None else s.exact

    def reached(readings: int) -> bool:
        positions = []
        for order in orders:
            counts = _of_poses(s.exact, cycle(order), readings, s.work).counts
            p = predicted_uncertainty(judge, counts, work=s.work)
            positions.append(p.position_open if others else p.position)
        return rms(np.array(positions, dtype=float)) <= position

    low, high = 1, budget
    while not reached(high):
        if high >= MOST * budget:
            return None
        low, high = high, min(2 * high, MOST * budget)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _of_poses(
    design_problem: DesignProblem, order: Iterable[int], budget: int, work: PredictionPoses
) -> Chosen:
    """Add poses in order, each with as many loads as it bears, until the budget is used."""
    counts, remaining = np.zeros(len(design_problem.units)), float(budget)
    pose = np.array([p for p, _ in design_problem.contents])
    cost, least = design_problem.units.cost, float(design_problem.units.cost.min())
    for p in order:
        if remaining < least:
            break
        first, last = np.searchsorted(pose, [p, p + 1])
        units = np.arange(first, last)
        if design_problem.mode == "deflection" and len(units):
            units = units[cost[units] <= remaining]
            units = units[[int(np.argmax(cost[units]))]] if len(units) else units
        for k in units:
            if cost[k] <= remaining:
                counts[k] += 1.0
                remaining -= float(cost[k])
    return Chosen(design_problem, counts, predicted_uncertainty(design_problem, counts, work=work))
