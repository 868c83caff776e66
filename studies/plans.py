"""Gain by planning: true errors of planned, random and hand-made campaigns.

Plans of the same number of readings are carried out on simulated arms without effects beyond the
model, and each campaign is identified. Two claims are tested: the true errors of parameters and
positions agree with the predicted ones, so that they shrink as predicted from plan to plan; and the
planner needs at most half of the readings of a random plan for the same accuracy at the test poses.
The arms come from an external function, so that the plan is tested against independent mechanics.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np

from hilcal.cell import Cell
from hilcal.config import CellConfig
from hilcal.engine import IN_PROCESS, Engine
from studies.plans_errors import Arm, Errors, PreparedPlan, Subject, prepared, run_campaign, subject
from studies.plans_kinds import Chosen, Scene, at_random, grid, matching, optimal, scene
from studies.plans_statistics import MeanAndStd, Summary, summary

TEST, PARAMETERS = "test", "D"
RANDOM, GRID = "random", "grid"
DOUBLE = "random, twice"
ROBUST = ", robust"
TOLERANCE = 0.1
"""Largest accepted relative deviation of true from predicted errors."""

MakeArm = Callable[[Cell, int], Arm]
"""Make a simulated arm by its number: equal numbers give equal arms."""


@dataclass(frozen=True, slots=True)
class Line:
    """One kind of plan on one robot.

    Attributes:
        kind: "test" and "D" by these criteria; with ", robust" for plans that keep power against
            the effects of `[planning] against`; "random", "grid".
        efficiency: certified by the planner; None for other plans.
        position_open: predicted RMS error at the test poses with potential terms estimated, too,
            m; None for random plans and grids.
        random_readings: number of readings that random plans need for the predicted error at the
            test poses; None if not computed or not reached.
        random_readings_open: the same for `position_open`.
        result: of the campaigns.
    """

    kind: str
    efficiency: float | None
    position_open: float | None
    random_readings: int | None
    random_readings_open: int | None
    result: Summary


@dataclass(frozen=True, slots=True)
class Shrinkage:
    """Ratios of the errors of the random plan to those of another plan of as many readings.

    Attributes:
        kind: of the other plan.
        parameter: predicted ratio of the parameter errors.
        parameter_real: ratio of the true errors.
        position: predicted ratio of the errors at the test poses.
        position_real: ratio of the true errors.
        twice: ratio of the true errors at the test poses for random plans with twice the
            readings: at least 1 if the plan needs at most half of the readings.
    """

    kind: str
    parameter: float
    parameter_real: MeanAndStd
    position: float
    position_real: MeanAndStd
    twice: MeanAndStd

    @property
    def agreement(self) -> MeanAndStd:
        """True over predicted shrinkage of the parameter error."""
        real = self.parameter_real
        return MeanAndStd(real.value / self.parameter, real.std / self.parameter)

    @property
    def position_agreement(self) -> MeanAndStd:
        """True over predicted shrinkage of the error at the test poses."""
        real = self.position_real
        return MeanAndStd(real.value / self.position, real.std / self.position)


@dataclass(frozen=True, slots=True)
class PlansStudy:
    """One robot.

    Attributes:
        robot: its model.
        mode: readings, "deflection" or "absolute".
        readings: number of readings of each plan with the unloaded ones.
        campaigns: number of campaigns of each kind of plan.
        where: text on the predicted quantity at the test poses.
        lines: the kinds of plans.
    """

    robot: str
    mode: str
    readings: int
    campaigns: int
    where: str
    lines: tuple[Line, ...]

    def of(self, kind: str) -> Line:
        """Return the line of a kind."""
        return next(line for line in self.lines if line.kind == kind)

    @property
    def planned(self) -> tuple[Line, ...]:
        """Lines of the planner's plans."""
        return tuple(line for line in self.lines if line.efficiency is not None)

    def shrinkage(self) -> tuple[Shrinkage, ...]:
        """Return the gain of each of the planner's plans over random plans."""
        base, twice = self.of(RANDOM).result, self.of(DOUBLE).result
        return tuple(
            Shrinkage(
                kind=line.kind,
                parameter=base.parameter / line.result.parameter,
                parameter_real=_ratio(base.parameter_real, line.result.parameter_real),
                position=base.position / line.result.position,
                position_real=_ratio(base.position_real, line.result.position_real),
                twice=_ratio(twice.position_real, line.result.position_real),
            )
            for line in self.planned
        )


def plans_study(
    cell: Cell,
    make_arm: MakeArm,
    *,
    readings: int = 100,
    campaigns: int = 50,
    candidates: int | None = None,
    seed: int = 0,
    engine: Engine = IN_PROCESS,
    advance: Callable[[int], None] = lambda step: None,
) -> PlansStudy:
    """Compare plans on one robot.

    Each campaign number has one arm for all kinds of plans, and a newly drawn random plan.

    Args:
        cell: the cell.
        config: its configuration.
        make_arm: makes simulated arms.
        readings: number of readings of each plan with the unloaded ones.
        campaigns: number of campaigns of each kind of plan.
        candidates: number of candidate poses; as configured by default.
        seed: of everything random.
        engine: runs the campaigns; this process by default.
        advance: called after each campaign.

    Raises:
        CannotAnswerError: from the cell, where it leaves no pose, or from a fit.
        InputError: from the configuration.
    """
    config = cell.configured()
    rng = np.random.default_rng(seed)
    s = scene(cell, candidates or config.planning.candidates, rng)
    fixed: dict[str, Chosen] = {GRID: grid(s, readings)}
    for robust in (False, True)[: 1 if s.robust is None else 2]:
        for criterion in (TEST, PARAMETERS):
            name = criterion + (ROBUST if robust else "")
            fixed[name] = optimal(s, criterion, readings, rng, robust=robust)
    many = {RANDOM: readings, DOUBLE: 2 * readings}
    kinds = kinds_of(config)
    asked: list[_Campaign] = []
    for number in range(campaigns):
        arm = subject(s, make_arm(cell, number))
        for index, kind in enumerate(kinds):
            noise = np.random.default_rng([seed, number, index])
            chosen = fixed[kind] if kind in fixed else at_random(s, many[kind], noise)
            asked.append(_Campaign(prepared(chosen), arm, noise))
    done = engine.map(partial(_run, cell=cell), asked, advance=advance)
    errors = {kind: done[index :: len(kinds)] for index, kind in enumerate(kinds)}
    opened = {k: s.with_others(fixed[k]) if k in fixed else None for k in kinds}
    lines = tuple(
        Line(
            kind=kind,
            efficiency=fixed[kind].efficiency if kind in fixed else None,
            position_open=opened[kind],
            random_readings=_needs(s, kind, fixed, readings, seed),
            random_readings_open=_needs(s, kind, fixed, readings, seed, others=opened[kind]),
            result=summary(errors[kind]),
        )
        for kind in kinds
    )
    return PlansStudy(
        config.robot.model, s.exact.mode, readings, campaigns, s.work.description, lines
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Campaign:
    """A plan, the arm to measure, and the generator of the noise."""

    plan: PreparedPlan
    arm: Subject
    noise: np.random.Generator


def _run(asked: _Campaign, cell: Cell) -> Errors:
    return run_campaign(cell, asked.plan, asked.arm, asked.noise)


def kinds_of(config: CellConfig) -> tuple[str, ...]:
    """Return the compared kinds of plans."""
    planned = (TEST, PARAMETERS)
    robust = tuple(kind + ROBUST for kind in planned) if config.planning.against else ()
    return (*planned, *robust, RANDOM, GRID, DOUBLE)


def _needs(
    s: Scene,
    kind: str,
    fixed: Mapping[str, Chosen],
    readings: int,
    seed: int,
    *,
    others: float | None = 0.0,
) -> int | None:
    """Number of readings that random plans need for the predicted accuracy of a planner's plan.

    If `others` is not zero, it is this accuracy, with the potential terms estimated, too.
    """
    if kind not in fixed or fixed[kind].efficiency is None or others is None:
        return None
    position = others or fixed[kind].predicted.position
    rng = np.random.default_rng([seed, 1])
    return None if position is None else matching(s, position, readings, rng, others=others > 0)


def _ratio(a: MeanAndStd, b: MeanAndStd) -> MeanAndStd:
    """Divide figures, with the uncertainty of independent figures."""
    value = a.value / b.value
    return MeanAndStd(value, value * float(np.hypot(a.std / a.value, b.std / b.value)))
