"""What the tests of fits share."""

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from hilcal.cell import Cell
from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import Fit, fit
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Mode
from hilcal.refinement import Refinement, refine
from hilcal.robot import se3

MODES = ("absolute", "deflection")


def fitted_model(
    cell: Cell, readings: Readings, mode: Mode, names: Collection[str] | None = None
) -> Fit:
    """The baseline, or the named effects beside unknown frames, fitted to readings."""
    if names is None:
        return fit(baseline(cell, readings, mode), readings, mode)
    return fit(with_effects(cell, readings, mode, names), readings, mode)


def parameters_by_effect(fitted: Fit) -> dict[str, tuple[float, float]]:
    names = [f"{e.name}.{p.name}" for e in fitted.model.effects for p in e.parameters]
    return dict(zip(names, zip(fitted.theta, fitted.uncertainty.std, strict=True), strict=True))


def compliances(fitted: Fit) -> np.ndarray:
    rows = fitted.model.slices()[fitted.model.names.index("joint_compliance")]
    return fitted.theta[rows]


def predicted(model: Model, readings: Readings, theta: np.ndarray) -> Readings:
    """Noiseless readings of the model itself."""
    o = model.predict(readings.states, theta).observation
    turn = se3.rotation_vector(o.rotation)
    return replace(readings, value=np.hstack([o.position, turn])[:, : readings.m])


def refined(cell: Cell, readings: Readings, mode: Mode) -> Refinement:
    return refine(baseline(cell, readings, mode), readings, mode)
