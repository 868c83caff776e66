"""The posterior of the standard deviations, and predictions averaged over it.

With few readings the likelihood hardly tells a standard deviation: its posterior is as wide as the
prior, and not normal. The mean of the coordinates over it predicts better than those at its maximum
(20 poses of a real arm: by 3 to 6 %), and its covariance is what bands need. Drawn by a random walk
(Metropolis, Rosenbluth, Rosenbluth, Teller and Teller, J. Chem. Phys. 21 (1953) 1087) with steps of
the covariance at the maximum.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hilcal.mixed.equations import Equations, equations
from hilcal.mixed.variances import Variances, log_posterior
from hilcal.types import Floats

BURN_IN = 0.15
"""Share of the steps that is not used: the walk begins at the maximum; a choice."""
THINNED = 10
"""Steps from one covariance that is averaged to the next; a choice: steps of a walk are alike."""
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


@dataclass(frozen=True, slots=True, eq=False)
class Average:
    """Coordinates over the posterior of the standard deviations.

    Attributes:
        coordinates: (K,) mean.
        covariance: (K, K) of their errors: the mean covariance at given standard deviations, and
            the covariance of the coordinates between them.
    """

    coordinates: Floats
    covariance: Floats


def average(found: Variances, rng: np.random.Generator, steps: int) -> Average:
    """Average the coordinates and the covariance of their errors over the posterior."""
    coordinates: list[Floats] = []
    covariance, count = np.zeros_like(found.equations.covariance), 0
    for k, e in enumerate(walk(found, rng, steps)):
        coordinates.append(e.coordinates)
        if k % THINNED == 0:
            covariance, count = covariance + e.covariance, count + 1
    between = np.cov(np.array(coordinates), rowvar=False, bias=True)
    return Average(np.mean(coordinates, axis=0), covariance / count + between)
