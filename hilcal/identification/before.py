"""How large an error is before anything is fitted but the frames."""

from functools import lru_cache

import numpy as np

from hilcal.effects.protocol import FRAME_ROLES
from hilcal.identification.fit import Fit
from hilcal.identification.gauss_newton import solve
from hilcal.identification.residual import ErrorBlock, error_block, residual
from hilcal.model.model import Model
from hilcal.readings.whitening import whitening


@lru_cache(maxsize=1)
def error_before(fit: Fit) -> ErrorBlock:
    """Return the error of the rigid nominal arm at the readings of a fit, m.

    Of deflections it is the deflection itself, which a rigid arm does not have. Of absolute
    readings it is what remains where the unknown frames (registration, target) are fitted to the
    nominal arm alone: those of a fitted model make up for its other parameters, and are wrong for
    the nominal arm by as much.
    """
    used, w = fit.readings[~fit.outlier], fit.whitening
    frames = tuple(x for x in fit.model.effects if x.role in FRAME_ROLES)
    rigid = Model(fit.model.cell, frames if fit.mode == "absolute" else (), fit.model.catalogue)
    theta = np.zeros(0)
    if rigid.effects:
        theta = solve(rigid, used, whitening(used, fit.mode, fit.scaling), None, None).theta
    return error_block(residual(used, rigid.predict(used.states, theta), w), w)
