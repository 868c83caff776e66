"""Prior standard deviations and ordinary magnitudes declared by the effects of a model."""

import numpy as np

from hilcal.model.model import Model
from hilcal.types import Floats, Ints

FIRST_GUESS = 0.3
"""First prior standard deviation of a shrunk family, in ordinary magnitudes; a choice."""


def prior_of(model: Model) -> tuple[Floats, Ints]:
    """Starting prior (P,) of a model, and the shrinkage group (P,) of each parameter or −1.

    Random effects have the standard deviations stated in the model. Parameters with a carried prior
    are flat here, see `carried.Coordinates`.
    """
    prior, groups, used = [np.zeros(0)], [np.zeros(0, dtype=np.int64)], 0
    for e in model.effects:
        size = len(e.magnitudes)
        group, fixed = e.groups(), e.prior_std()
        if e.name in model.random:
            group, fixed = None, model.random[e.name]
        if group is not None:
            prior.append(FIRST_GUESS * e.magnitudes)
            groups.append(group + used)
            used += int(group.max()) + 1
        else:
            prior.append(np.full(size, np.inf) if fixed is None else fixed)
            groups.append(np.full(size, -1))
    std, number = np.concatenate(prior), np.concatenate(groups)
    if model.prior is not None:
        carried = model.prior.index_in(names_of(model))[0]
        std[carried], number[carried] = np.inf, -1
    return std, number


def names_of(model: Model) -> tuple[str, ...]:
    """Names of the parameters, "effect.parameter"."""
    return tuple(f"{e.name}.{p.name}" for e in model.effects for p in e.parameters)


def scales_of(model: Model) -> Floats:
    """(P,) ordinary magnitudes of the parameters."""
    return np.concatenate([np.zeros(0), *(e.magnitudes for e in model.effects)])
