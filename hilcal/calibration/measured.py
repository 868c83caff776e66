"""What a calibration was measured at, which points lie outside of it, and what they leave untold.

A table of points or a program seldom has them. A quantity x that an effect of the model needs is
then taken as it was on the whole while measuring, x̄, and what it moves there counts as a variance
of each axis of the tool's position p:

    v = mean over measured states of (|p(x) − p(x̄)|² + |(J(x) − J(x̄)) R|²) / 3

J the derivative of p by the parameters, R Rᵀ their covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.identification.predictive import Predictive
from hilcal.identification.validation import FAR
from hilcal.model.model import Model
from hilcal.readings.ranges import (
    Range,
    angle_name,
    ranges_of,
    travel_name,
    turning_variables,
    variables,
)
from hilcal.readings.readings import States
from hilcal.types import Bools, Floats


@dataclass(frozen=True, slots=True)
class Outside:
    """Points outside of what was measured.

    Attributes:
        of: the range that they leave; for the uncertainty, its limit, m.
        points: (N,) which points.
        values: (N,) their values.
    """

    of: Range
    points: Bools
    values: Floats


@dataclass(frozen=True, slots=True)
class Measured:
    """Where the fitted readings lie.

    Attributes:
        ranges: of joint angles, force, moment, temperatures.
        most_std_m: standard deviation of a prediction, by the parameters alone, from which on a
            point is far from all fitted ones; see `extrapolation`. For the tracked target.
    """

    ranges: tuple[Range, ...]
    most_std_m: float

    @classmethod
    def of(cls, states: States, p: Predictive, noise: Floats, units: Sequence[str]) -> "Measured":
        """Return where fitted states lie.

        Args:
            p: what the fit knows of others.
            noise: (D,) trace of the position's covariance of each measurement, by noise and
                misfit, m².
            units: (n,) of the joints' values.
        """
        spread = noise * p.leverage / (1 - p.leverage)
        return cls(ranges_of(states, units), float(np.sqrt(FAR * np.quantile(spread, 0.99))))

    def middle(self, n: int) -> Floats:
        """(n,) joint values in the middle of what was measured, rad or m; zero where unknown."""
        known = {r.variable: 0.5 * (r.low + r.high) for r in self.ranges}
        names = (travel_name(j) if travel_name(j) in known else angle_name(j) for j in range(n))
        return np.array([known.get(name, 0.0) for name in names])

    def outside(self, states: States, std_m: Floats | None, turns: Bools) -> list[Outside]:
        """Return what points leave, by variable.

        Args:
            states: N points.
            std_m: (N,) standard deviation of the predictions; None where it is not known.
            turns: (n,) joints that are the same whole turns on.
        """
        known, turning = {r.variable: r for r in self.ranges}, turning_variables(turns)
        units = ["m" if travel_name(j) in known else "rad" for j in range(states.q.shape[1])]
        found = [
            Outside(known[name], known[name].beyond(values, turning=name in turning), values)
            for name, _, values in variables(states, units)
            if name in known
        ]
        if std_m is not None:
            limit = Range("standard deviation of the position", "m", 0.0, self.most_std_m)
            found.append(Outside(limit, std_m > self.most_std_m, std_m))
        return [o for o in found if o.points.any()]

    def turned_on(self, states: States) -> list[Outside]:
        """Return what points leave in joint angles that are counted without whole turns."""
        none = np.zeros(states.q.shape[1], dtype=np.bool_)
        return [o for o in self.outside(states, None, none) if o.of.unit == "rad"]


WORDS = {
    "time": "time",
    "load_time": "time under load",
    "air_temperature": "air temperature",
    "joint_temperature": "joint temperatures",
    "approach": "sides of approach",
}
"""Columns of `States` that a calibration knows a mean of, as people call them."""
MOST = 200
"""Measured states that are looked at, evenly spread; a choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Condition:
    """A quantity on the whole while measuring.

    Attributes:
        mean: x̄: a number, or (n,).
        variance_m2: v, m².
    """

    mean: Floats
    variance_m2: float


def needed(model: Model, states: States) -> tuple[str, ...]:
    """Columns that effects of a model need and states do not have, in the order of `WORDS`."""
    needs = {n for e in model.effects if not e.computable(states) for n in e.needs}
    columns = {column for need in needs for column in need.split(" or ")}
    return tuple(c for c in WORDS if c in columns and getattr(states, c) is None)


def conditions_of(
    model: Model, states: States, moves: Callable[[States], tuple[Floats, Floats]]
) -> dict[str, Condition]:
    """Return the conditions that effects of a model need, by column.

    Args:
        states: that it was fitted to.
        moves: position (N, 3) of the tool and J R (N, 3, K) at N states.
    """
    names = needed(model, States(states.q, states.wrench))
    some = states[:: -(-len(states) // MOST)]
    own = moves(some) if names else None
    out = {}
    for name in names:
        column = getattr(states, name)
        if column is None or own is None:
            continue
        mean = column.mean(axis=0)
        usual: dict[str, Any] = {name: np.broadcast_to(mean, getattr(some, name).shape).copy()}
        position, spread = moves(replace(some, **usual))
        moved = np.sum((own[0] - position) ** 2) + np.sum((own[1] - spread) ** 2)
        out[name] = Condition(np.asarray(mean), float(moved) / (3 * len(some)))
    return out
