"""How large an error is before anything is fitted but the frames."""

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.identify.errors import ErrorBlock, error_block
from hilcal.identify.fit import Fit
from hilcal.identify.full_prediction import full_prediction
from hilcal.identify.residual import residual
from hilcal.model import Model


def error_before(fit: Fit) -> ErrorBlock:
    """Return the error of the rigid nominal arm at the readings of a fit, m.

    Of deflections it is the deflection itself, which a rigid arm does not have. Of absolute
    readings it is what remains where frames (registration, target) are as fitted, and nothing else
    is wrong with the arm.
    """
    e = full_prediction(fit)
    kept = [
        (effect, fit.theta[s])
        for effect, s in zip(fit.model.effects, fit.model.slices(), strict=True)
        if effect.role in FRAME_ROLES and fit.mode == "absolute"
    ]
    rigid = Model(fit.model.cell, tuple(effect for effect, _ in kept), fit.model.catalogue)
    theta = np.concatenate([np.zeros(0), *(values for _, values in kept)])
    predicted = rigid.predict(e.readings.states, theta)
    return error_block(residual(e.readings, predicted, e.whitening), e.whitening)
