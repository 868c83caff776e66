"""The uncertainty of a prediction at temperatures that were not measured.

A model of readings at nearly one temperature does not name the effects of temperature: nothing
shows them. At another temperature they act nevertheless. So in a state whose temperatures T are
outside of the measured ranges, [T] being the nearest measured ones, the effects of temperature that
the model does not name count with what the readings leave of their ordinary sizes S:

    Cov = (J(T) − J([T])) C (J(T) − J([T]))ᵀ,    C = (S⁻² + Xᵀ M X/σ²)⁻¹

J is the derivative of a reading by their parameters, X that of the fitted readings, whitened, less
those at mean temperatures, and M the projection off the columns of the model. Inside of the ranges
Cov is zero.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.model.model import Model
from hilcal.readings.readings import TEMPERATURES, Range, Readings, States, ranges_of, variables
from hilcal.readings.whitening import Whitening
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class OtherTemperatures:
    """The effects of temperature that a model of absolute readings does not name."""

    unnamed: Model  # the L parameters of these effects alone
    covariance: Floats  # (L, L) C
    ranges: tuple[Range, ...]  # of the fitted readings

    def of_readings(self, states: States, m: int, cell: Cell) -> Floats:
        """Return Cov (N, m, m) of readings, m = 3 (positions) or 6 (poses), in sensor axes.

        `cell` has the registration and the target, which may be others than those fitted.
        """
        moved = self._moved(states, m, cell)
        return np.asarray(moved @ self.covariance @ np.swapaxes(moved, 1, 2))

    def rows(self, states: States, m: int, cell: Cell) -> Floats:
        """Return a root (N, m, L) of Cov whose L columns are of all readings together."""
        return np.asarray(self._moved(states, m, cell) @ np.linalg.cholesky(self.covariance))

    def _moved(self, states: States, m: int, cell: Cell) -> Floats:
        """(N, m, L) change of readings by the parameters, beyond that at measured temperatures."""
        clipped = self._nearest_measured(states)
        if not clipped or not self.unnamed.effects:
            return np.zeros((len(states), m, len(self.covariance)))
        theta, model = np.zeros(self.unnamed.size), replace(self.unnamed, cell=cell)
        air, joints = states.air_temperature, states.joint_temperature
        # where a temperature is unknown, any constant makes the difference zero
        air = np.zeros(len(states)) if air is None else air
        joints = np.zeros_like(states.q) if joints is None else joints
        measured = (
            clipped.get("air temperature", air),
            np.column_stack(
                [clipped.get(f"joint {j + 1} temperature", t) for j, t in enumerate(joints.T)]
            ),
        )
        columns = []
        for of_air, of_joints in ((air, joints), measured):
            at = replace(states, air_temperature=of_air, joint_temperature=of_joints)
            columns.append(model.jacobian(model.predict(at, theta), theta, m))
        return np.asarray(columns[0] - columns[1])

    def _nearest_measured(self, states: States) -> dict[str, Floats]:
        """Return the nearest measured temperatures (N,) of variables that leave their ranges."""
        by_name = {r.variable: r for r in self.ranges}
        return {
            name: np.clip(values, by_name[name].low, by_name[name].high)
            for name, unit, values in variables(states, self.unnamed.cell.arm.units)
            if unit == "K" and name in by_name and by_name[name].beyond(values).any()
        }


def other_temperatures(
    model: Model, fitted: Readings, w: Whitening, a: Floats, root: Floats, noise: float
) -> OtherTemperatures:
    """Return the effects of temperature that a model does not name, by its fitted readings.

    Args:
        model: the fitted model.
        fitted: its readings.
        w: their scaling.
        a: (R, P) whitened derivatives of the readings by coordinates of the model.
        root: (P, K) root of the covariance of these coordinates.
        noise: σ², variance of the whitened readings.
    """
    unnamed, states = unnamed_effects(model, fitted.states), fitted.states
    theta = np.zeros(unnamed.size)
    every = np.arange(len(theta))
    x, of_means = (
        whitened_jacobian(unnamed, unnamed.predict(at, theta), theta, w, every)
        for at in (states, _at_mean_temperatures(states))
    )
    x = x - of_means  # links of other lengths do the same as a constant temperature
    x = x * _sizes(unnamed)
    along = root.T @ (a.T @ x) / noise
    information = np.eye(len(theta)) + x.T @ x / noise - along.T @ along
    covariance = np.linalg.inv(information) * _sizes(unnamed) * _sizes(unnamed)[:, None]
    return OtherTemperatures(unnamed, covariance, ranges_of(states, model.cell.arm.units))


def unnamed_effects(model: Model, states: States) -> Model:
    """Return a model of the effects of temperature that a model does not name."""
    unnamed = replace(
        model, effects=(), random={}, background=frozenset(), readings=None, prior=None
    )
    for kind in model.catalogue.effects:
        of_temperature = any(name in need for need in kind.needs for name in TEMPERATURES)
        if not of_temperature or kind.of_setup or kind.name in model.named:
            continue
        if kind.computable(states) and kind.applies(model.cell):
            unnamed = unnamed + model.catalogue.make(kind.name, model.cell, states)
    return unnamed


def _at_mean_temperatures(states: States) -> States:
    columns = {name: getattr(states, name) for name in TEMPERATURES}
    means: dict[str, Any] = {
        name: np.broadcast_to(x.mean(axis=0), x.shape)
        for name, x in columns.items()
        if x is not None
    }
    return replace(states, **means)


def _sizes(unnamed: Model) -> Floats:
    return np.concatenate([np.zeros(0), *(e.magnitudes for e in unnamed.effects)])
