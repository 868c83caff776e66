"""Residuals, measured − predicted, of readings or deflections."""

import numpy as np

from hilcal.model.model import Prediction
from hilcal.readings.readings import Readings
from hilcal.readings.whitening import Whitening, measured, relative_rotation
from hilcal.robot import se3
from hilcal.types import Floats


def residual(readings: Readings, prediction: Prediction, w: Whitening) -> Floats:
    """Measured − predicted (D, m).

    The rotation part of a pose reading is Log(R_measured R_predictedᵀ), a small rotation in
    sensor axes; of a deflection it is the difference of the relative rotations.
    """
    o = prediction.observation
    position = w.raw(readings.value[:, :3] - o.position)
    if w.m == 3:
        return position
    if w.mode == "deflection":
        turn = measured(readings, w)[:, 3:] - relative_rotation(o.rotation, w)
    else:
        read = se3.rotation(readings.value[:, 3:])
        turn = w.raw(se3.rotation_vector(read @ np.swapaxes(o.rotation, 1, 2)))
    return np.concatenate([position, turn], axis=1)
