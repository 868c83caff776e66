"""What the tests of fits share."""

from dataclasses import replace

import numpy as np

from hilcal.identification.fit import Fit
from hilcal.model.model import Model
from hilcal.readings.readings import Readings
from hilcal.robot import se3

MODES = ("absolute", "deflection")


def named(found: Fit) -> dict[str, tuple[float, float]]:
    """Value and standard uncertainty by name."""
    names = [f"{e.name}.{p.name}" for e in found.model.effects for p in e.parameters]
    return dict(zip(names, zip(found.theta, found.uncertainty.std, strict=True), strict=True))


def compliances(found: Fit) -> np.ndarray:
    rows = found.model.slices()[found.model.names.index("joint_compliance")]
    return found.theta[rows]


def predicted(model: Model, readings: Readings, theta: np.ndarray) -> Readings:
    """Noiseless readings of the model itself."""
    o = model.predict(readings.states, theta).observation
    turn = se3.rotation_vector(o.rotation)
    return replace(readings, value=np.hstack([o.position, turn])[:, : readings.m])
