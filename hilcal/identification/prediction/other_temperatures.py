"""The uncertainty of a prediction at temperatures that were not measured.

A model of readings at one temperature lacks the effects of temperature: nothing shows them. At
another temperature they act nevertheless. So in a state whose temperatures T are outside of the
measured ranges, [T] being the nearest measured ones, the effects of temperature that the model
lacks count with their ordinary sizes S:

    Cov = (J(T) − J([T])) S² (J(T) − J([T]))ᵀ

J is the derivative of a reading by their parameters. Inside of the ranges it is zero.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.model.model import Model
from hilcal.readings.readings import TEMPERATURES, Range, States, variables
from hilcal.types import Floats


def by_other_temperatures(model: Model, states: States, ranges: Sequence[Range], m: int) -> Floats:
    """Return Cov (N, m, m) of absolute readings.

    Args:
        model: the fitted model.
        states: the N states of the prediction.
        ranges: of the fitted readings, see `ranges_of`.
        m: 3 (positions) or 6 (poses).
    """
    measured = _nearest_measured(model, states, ranges)
    if measured is None:
        return np.zeros((len(states), m, m))
    lacking = replace(model, effects=(), background=frozenset(), readings=None, prior=None)
    for kind in model.catalogue.effects:
        of_temperature = any(name in need for need in kind.needs for name in TEMPERATURES)
        if not of_temperature or kind.name in model.names or kind.role in FRAME_ROLES:
            continue
        if kind.computable(states) and kind.applies(model.cell):
            lacking = lacking + model.catalogue.make(kind.name, model.cell, states, {}, m)
    theta = np.zeros(lacking.size)
    columns = [
        lacking.jacobian(lacking.predict(s, theta), theta, m, np.arange(lacking.size))
        for s in (states, measured)
    ]
    moved = (columns[0] - columns[1]) * np.concatenate(
        [e.magnitudes for e in lacking.effects] or [theta]
    )
    return np.asarray(moved @ np.swapaxes(moved, 1, 2))


def _nearest_measured(model: Model, states: States, ranges: Sequence[Range]) -> States | None:
    """Return states with the nearest measured temperatures; None where these are measured."""
    by_name = {r.variable: r for r in ranges}
    clipped = {
        name: np.clip(values, by_name[name].low, by_name[name].high)
        for name, unit, values in variables(states, model.cell.arm.units)
        if unit == "K" and name in by_name and by_name[name].beyond(values).any()
    }
    if not clipped:
        return None
    air, joints = states.air_temperature, states.joint_temperature
    if joints is not None:
        joints = np.column_stack(
            [clipped.get(f"joint {j + 1} temperature", t) for j, t in enumerate(joints.T)]
        )
    return replace(
        states, air_temperature=clipped.get("air temperature", air), joint_temperature=joints
    )
