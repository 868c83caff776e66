"""How far what a law adds to a model is what was hidden; for rehearsals and studies."""

import numpy as np

from hilcal.identification.fit import Fit
from hilcal.identification.linearisation import linearise
from hilcal.types import Floats


def agreement(before: Fit, after: Fit, moved: Floats) -> float:
    """Return the correlation of what was hidden with what the added effects do.

    Both are whitened, and what the model without the effect describes is projected out.

    Args:
        before: the fit without the added effects.
        after: the fit with more effects, behind those of the first model.
        moved: (N, 3) by how much the hidden law moves each reading, sensor axes, m.
    """
    linear, w = linearise(before), before.whitening
    truth = linear.project_out(w.whiten(w.raw(moved[~before.outlier])).reshape(-1))
    known = len(before.model.effects)
    effects, theta = after.model.effects[known:], after.theta[before.model.size :]
    jacobian = before.model.jacobian_of(effects, before.solution.prediction, before.theta, w.m)
    told = linear.project_out(w.whiten(w.raw(jacobian @ theta)).reshape(-1))
    size = float(np.linalg.norm(truth) * np.linalg.norm(told))
    return float(truth @ told) / max(size, 1e-300)
