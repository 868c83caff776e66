"""What points do not tell of their state: sides of approach, times, temperatures.

A table of points or a program seldom has them. A quantity x that an effect of the model needs is
then taken as it was on the whole while measuring, x̄, and what it moves there counts as a variance
of each axis of the tool's position p:

    v = mean over measured states of (|p(x) − p(x̄)|² + |(J(x) − J(x̄)) R|²) / 3

J the derivative of p by the parameters, R Rᵀ their covariance.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.model.model import Model
from hilcal.readings.readings import States
from hilcal.types import Floats

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
        variance: v, m².
    """

    mean: Floats
    variance: float

    def to_json(self) -> dict[str, object]:
        """Return it as JSON, SI."""
        return {"mean": self.mean.tolist(), "variance_m2": self.variance}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "Condition":
        """Return what `to_json` wrote."""
        return cls(np.array(content["mean"], dtype=float), float(content["variance_m2"]))


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
