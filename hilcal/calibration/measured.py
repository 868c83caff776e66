"""The measured ranges of a calibration, points outside of them, and means of missing columns.

A table of points or a program seldom states temperatures, times or sides of approach. Where an
effect of the model needs such a quantity x, its mean x̄ while measuring is used. The motion of the
tool by x − x̄ at measured states then counts as a variance of each axis of the tool's position p:

    v = mean over measured states of (|p(x) − p(x̄)|² + |(J(x) − J(x̄)) R|²) / 3

J is the derivative of p by the parameters, R Rᵀ their covariance. The same v counts at a time after
the last reading: what the time did while measuring, as the arm warmed up, it may do anew.

The force sensor is mounted between flange and tool. With R its axes and p its origin in base axes,
r the load point, and (f, M) the change of its reading by the load, sensor axes:

    force = R f,   moment = R M − (r − p) × R f
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.prediction.predictive import Predictive
from hilcal.identification.prediction.validation import POSITION_STD, farthest_m2
from hilcal.measuring.force import shift
from hilcal.model.model import Model
from hilcal.readings.readings import (
    TEMPERATURES,
    Range,
    Readings,
    States,
    angle_name,
    ranges_of,
    travel_name,
    turning_variables,
    variables,
)
from hilcal.robot import se3
from hilcal.robot.chain import evaluate
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True)
class Outside:
    """Points outside of a measured range."""

    range: Range  # the range; for the uncertainty, its limit, m
    points: Bools  # (N,) points outside
    values: Floats  # (N,) values of all points


@dataclass(frozen=True, slots=True)
class MeasuredRanges:
    """Ranges of the fitted readings."""

    ranges: tuple[Range, ...]  # of joint angles, force, moment, temperatures
    most_std_m: float  # std of the target, by the parameters alone, of points far from fitted ones

    @classmethod
    def of(
        cls, states: States, p: Predictive, kappa: float, units: Sequence[str]
    ) -> "MeasuredRanges":
        """Return the ranges of fitted states; `kappa` is the factor of the covariance C."""
        return cls(ranges_of(states, units), float(np.sqrt(kappa * farthest_m2(p))))

    def mid_range_q(self, n: int) -> Floats:
        """(n,) joint values in the middle of their ranges, rad or m; zero where unknown."""
        middles = {r.variable: 0.5 * (r.low + r.high) for r in self.ranges}
        names = (travel_name(j) if travel_name(j) in middles else angle_name(j) for j in range(n))
        return np.array([middles.get(name, 0.0) for name in names])

    def outside(self, states: States, std_m: Floats | None, turns: Bools) -> list[Outside]:
        """Return the variables whose ranges points leave.

        `std_m` (N,) are the standard deviations of the predictions, None if unknown; `turns` (n,)
        are joints whose values are equivalent modulo whole turns.
        """
        ranges, turning = {r.variable: r for r in self.ranges}, turning_variables(turns)
        units = ["m" if travel_name(j) in ranges else "rad" for j in range(states.q.shape[1])]
        outside = [
            Outside(ranges[name], ranges[name].beyond(values, turning=name in turning), values)
            for name, _, values in variables(states, units)
            if name in ranges
        ]
        if std_m is not None:
            limit = Range(POSITION_STD, "m", 0.0, self.most_std_m)
            outside.append(Outside(limit, std_m > self.most_std_m, std_m))
        return [o for o in outside if o.points.any()]

    def turned_on(self, states: States) -> list[Outside]:
        """Return the joint angles outside of their ranges, without regard to whole turns."""
        none = np.zeros(states.q.shape[1], dtype=np.bool_)
        return [o for o in self.outside(states, None, none) if o.range.unit == "rad"]


CONDITION_NAMES = {
    "time": "time",
    "load_time": "time under load",
    "air_temperature": "air temperature",
    "joint_temperature": "joint temperatures",
    "approach": "sides of approach",
}
"""Columns of `States` whose mean a calibration may know, with their names for people."""
MAX_STATES = 200  # measured states at which variances are computed, evenly spread; a choice


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """Mean of a quantity while measuring, and variance of the position about it."""

    mean: Floats  # x̄: a number, or (n,)
    variance_m2: float  # v, m²
    high: Floats | None = None  # largest measured value; None in older files


def missing_columns(model: Model, states: States) -> tuple[str, ...]:
    """Columns that effects of a model need and states lack, in the order of `CONDITION_NAMES`."""
    needs = {n for e in model.effects if not e.computable(states) for n in e.needs}
    columns = {column for need in needs for column in need.split(" or ")}
    return tuple(c for c in CONDITION_NAMES if c in columns and getattr(states, c) is None)


def conditions_of(
    model: Model, states: States, position_and_spread: Callable[[States], tuple[Floats, Floats]]
) -> dict[str, Condition]:
    """Return the conditions that effects of a model need, by column."""
    names = missing_columns(model, States(states.q, states.wrench))
    sample = states[:: -(-len(states) // MAX_STATES)]
    reference, out = position_and_spread(sample) if names else (np.zeros(0), np.zeros(0)), {}
    for name in names:
        column = getattr(states, name)
        if column is None:
            continue
        mean = column.mean(axis=0)
        constant: dict[str, Any] = {name: np.broadcast_to(mean, getattr(sample, name).shape).copy()}
        position, spread = position_and_spread(replace(sample, **constant))
        moved = np.sum((reference[0] - position) ** 2) + np.sum((reference[1] - spread) ** 2)
        variance = float(moved) / (3 * len(sample))
        out[name] = Condition(np.asarray(mean), variance, np.asarray(column.max(axis=0)))
    return out


def with_mean_temperatures(readings: Readings, conditions: Mapping[str, Condition]) -> Readings:
    """Return readings whose lacking temperatures are those of `conditions`, v in their covariance.

    So a model that needs a temperature can be tested by readings of an arm that no longer reports
    it.
    """
    lacking = [n for n in TEMPERATURES if n in conditions and getattr(readings.states, n) is None]
    if not lacking:
        return readings
    filled: dict[str, Any] = {
        n: np.broadcast_to(m := conditions[n].mean, (len(readings), *m.shape)).copy()
        for n in lacking
    }
    more = np.zeros((readings.m, readings.m))
    more[:3, :3] = sum(conditions[n].variance_m2 for n in lacking) * np.eye(3)
    return replace(
        readings,
        states=replace(readings.states, **filled),
        covariance=readings.covariance + more,
        stated=None if readings.stated is None else readings.stated + more,
    )


@dataclass(frozen=True, slots=True, eq=False)
class SensorMount:
    """Pose of the force sensor."""

    origin_m: Floats  # (3,) its origin, flange axes, m
    rotvec_rad: Floats  # (3,) its axes in flange axes, a rotation vector, rad

    @classmethod
    def of(cls, cell: Cell) -> Self | None:
        """Return the pose of a cell's sensor; None without a sensor."""
        sensor = None if cell.config is None else cell.config.force_sensor
        if sensor is None:
            return None
        return cls(np.array(sensor.origin_m), np.array(sensor.rotvec_rad))

    def load_wrench(self, cell: Cell, q: Floats, reading: Floats) -> Floats:
        """Return force and moment (N, 6) of the load at the load point, base axes, N and N·m.

        `reading` (N, 6) is the change of the sensor's reading by the load at q (N, n), rad, sensor
        axes. The arm is the nominal one.
        """
        chain = evaluate(cell.arm, q)
        axes = se3.product(chain.rotation[-1], se3.rotation(self.rotvec_rad))
        turned = [se3.apply(axes, part) for part in (reading[:, :3], reading[:, 3:])]
        lever = chain.point(cell.load_point) - chain.point(self.origin_m)
        return shift(np.concatenate(turned, axis=1), lever)
