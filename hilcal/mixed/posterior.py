"""The posterior of the standard deviations, and predictions averaged over it.

With few readings the likelihood hardly tells a standard deviation: its posterior is as wide as the
prior, and not normal. The mean of the coordinates over it predicts better than those at its maximum
(20 poses of a real arm: by 3 to 6 %). Drawn by a random walk (Metropolis, Rosenbluth, Rosenbluth,
Teller and Teller, J. Chem. Phys. 21 (1953) 1087) with steps of the covariance at the maximum.
"""

from collections.abc import Iterator

import numpy as np

from hilcal.mixed.equations import Equations, equations
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.types import Floats

BURN_IN = 0.15
"""Share of the steps that is not used: the walk begins at the maximum; a choice."""
STEP = 2.4
"""Steps of this over √d standard deviations accept a fifth to a quarter (Roberts, Gelman and Gilks,
Ann. Appl. Probab. 7 (1997) 110)."""


def walk(found: Variances, rng: np.random.Generator, steps: int) -> Iterator[Equations]:
    """Yield the equations at so many steps of the walk, those of the burn-in left out."""
    here, best = found.equations, found.log_posterior
    root = np.linalg.cholesky(found.covariance) * STEP / np.sqrt(len(found.log_std))
    for k in range(steps):
        try:
            there = equations(here.problem, here.log_std + root @ rng.standard_normal(len(root)))
            value = log_posterior(there)
        except np.linalg.LinAlgError:
            value = -np.inf
        if np.log(rng.random()) < value - best:
            here, best = there, value
        if k >= BURN_IN * steps:
            yield here


def averaged_coordinates(found: Variances, rng: np.random.Generator, steps: int) -> Floats:
    """(K,) mean of the coordinates over the posterior of the standard deviations."""
    total, count = np.zeros_like(found.equations.coordinates), 0
    for e in walk(found, rng, steps):
        total, count = total + e.coordinates, count + 1
    return np.asarray(total / count)
