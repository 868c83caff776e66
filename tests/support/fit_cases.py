"""What the tests of fits share."""

from dataclasses import replace

import numpy as np

from hilcal.identification.baseline import baseline, with_effects
from hilcal.identification.fit import fit
from hilcal.refinement import refine
from hilcal.robot import se3

MODES = ("absolute", "deflection")


def fitted_model(cell, readings, mode, names=None):
    """The baseline, or the named effects beside unknown frames, fitted to readings."""
    if names is None:
        return fit(baseline(cell, readings, mode), readings, mode)
    return fit(with_effects(cell, readings, mode, names), readings, mode)


def parameters_by_effect(fitted):
    names = [f"{e.name}.{p.name}" for e in fitted.model.effects for p in e.parameters]
    return dict(zip(names, zip(fitted.theta, fitted.uncertainty.std, strict=True), strict=True))


def compliances(fitted):
    rows = fitted.model.slices()[fitted.model.names.index("joint_compliance")]
    return fitted.theta[rows]


def predicted(model, readings, theta):
    """Noiseless readings of the model itself."""
    o = model.predict(readings.states, theta).observation
    turn = se3.rotation_vector(o.rotation)
    return replace(readings, value=np.hstack([o.position, turn])[:, : readings.m])


def refined(cell, readings, mode):
    return refine(baseline(cell, readings, mode), readings, mode)
