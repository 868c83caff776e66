"""The information of the readings that a model was fitted to."""

import numpy as np

from hilcal.design.nominal_model import NominalModel
from hilcal.effects.protocol import Effect
from hilcal.identification.effect_columns import computable, effect_columns
from hilcal.identification.gauss_newton import whitened_jacobian
from hilcal.identification.priors import scales_of
from hilcal.types import Floats


def information_of(nominal: NominalModel, more: tuple[Effect, ...], scale: Floats) -> Floats:
    """Return AᵀA (P, P) of the readings that the assumed model was fitted to; zero without any.

    With the information of a prior that is carried over from another campaign.

    A is the Jacobian at the fit, whitened by the readings' own covariances: what the fit's normal
    equations hold, without its priors.

    Args:
        nominal: the model, whose live parameters come first.
        more: effects that are not in the model. Those that cannot be computed from these readings,
            which lack a column, have no information.
        scale: (P,) what one unit of each parameter is, SI.
    """
    fit, count = nominal.fit, len(nominal.live)
    known = np.zeros((len(scale), len(scale)))
    if nominal.carried is not None:
        known[:count, :count] = nominal.carried * (scale[:count, None] * scale[:count])
    if fit is None:
        return known
    ordinary = [scales_of(fit.model)[nominal.live]]
    s = fit.solution
    own = whitened_jacobian(fit.model, s.prediction, s.theta, fit.whitening, nominal.live)
    columns = [own * ordinary[0]]
    for e in more:
        ordinary.append(np.array([p.scale for p in e.parameters]))
        missing = np.zeros((len(fit.white), len(e.parameters)))
        columns.append(effect_columns(fit, e).white if computable(fit, e) else missing)
    a = np.hstack(columns) * (scale / np.concatenate(ordinary))
    return np.asarray(known + a.T @ a)
