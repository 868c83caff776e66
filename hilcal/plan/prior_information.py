"""What has been measured already tells of the parameters."""

import numpy as np

from hilcal.effects.protocol import Effect
from hilcal.plan.nominal_model import Assumed
from hilcal.types import Floats


def information_of(assumed: Assumed, more: tuple[Effect, ...], scale: Floats) -> Floats:
    """Return AᵀA (P, P) of the readings that the assumed model was fitted to; zero without any.

    A are the derivatives at the fit, whitened by the readings' own covariances: exactly what
    the fit's normal equations hold, before its priors.

    Args:
        assumed: the model, whose live parameters come first.
        more: effects that are not in the model; what the readings cannot show of them because
            they lack a column stays unknown.
        scale: (P,) what one unit of each parameter is, SI.
    """
    fit = assumed.fit
    if fit is None:
        return np.zeros((len(scale), len(scale)))
    solution, w = fit.solution, fit.whitening
    shown = tuple(e for e in more if type(e).computable(solution.prediction.situation.states))
    model = fit.model
    start, place = len(assumed.live), [np.arange(len(assumed.live))]
    live = [assumed.live]
    at = model.size
    for e in more:
        size = len(e.parameters)
        if e in shown:
            place.append(start + np.arange(size))
            live.append(at + np.arange(size))
            at += size
        start += size
    where = np.concatenate(place)
    jacobian = model.jacobian_of(
        (*model.effects, *shown), solution.prediction, fit.theta, w.m, np.concatenate(live)
    )
    a = w.whiten(w.raw(jacobian * scale[where])).reshape(-1, len(where))
    out = np.zeros((len(scale), len(scale)))
    out[np.ix_(where, where)] = a.T @ a
    return out
