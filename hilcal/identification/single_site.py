"""Readings that are off along what one site of the arm can do: a misfit, and no gross errors.

What a law of a joint, of a link that bends or of the force sensor does to a reading goes along one
direction there, whatever the law depends on; a gross error goes anywhere. Of a random error in m
dimensions the share beside a direction is sin² ~ Beta((m − 1)/2, 1/2), with p its distribution
function uniform. So n of F gross errors are as near to a site's direction as p_(n), ascending,
with the binomial probability P(B(F, p_(n)) ≥ n), times F and the number of sites for the least of
all. Where that is too small, what is along the site, at two poses at least, is a law's.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import beta, binom, chi2

from hilcal.identification.off_alike import SAME
from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

CHANCE = 1e-2
"""Probability that so many gross errors are along any one site, below which they are none; and that
the noise moves a reading so far beside its law's direction. Choices."""
FEWEST = 2
"""Poses that a law moves at least: an axis of a site and one of the sensor may agree at a pose."""
ROUGH = 0.05
"""Share of a law's shift that may be beside its direction, as the model is linear; a choice."""


def site_columns(model: Model, theta: Floats, prediction: Prediction, readings: Readings) -> Floats:
    """(N, m, P) changes of N readings by each site."""
    p = prediction
    moves = motion(model.cell, p.observation, p.situation.chain, p.deviation, readings.m)
    turns = [moves.by_slot(k, slice(3, 6)) for k in range(p.situation.wrench.shape[1])]
    sensor = np.stack([*_by_wrench(model, theta, p, readings)], axis=2)
    return np.concatenate([*turns, sensor], axis=2)


def _by_wrench(model: Model, theta: Floats, p: Prediction, readings: Readings) -> Iterator[Floats]:
    """Changes (N, m) by 1 N and 1 N·m along the axes of the flange, which the sensor reads."""
    states, at = readings.states, p.observation
    for part in (slice(0, 3), slice(3, 6)):
        for axis in np.moveaxis(p.situation.chain.rotation[-1], 2, 0):
            wrench = states.wrench.copy()
            wrench[:, part] += axis
            o = model.predict(replace(states, wrench=wrench), theta, p).observation
            turn = se3.rotation_vector(o.rotation @ at.rotation.swapaxes(1, 2))
            yield np.concatenate([o.position - at.position, turn], axis=1)[:, : readings.m]


def along_one_site(shift: Floats, columns: Floats, pose: Ints) -> Bools:
    """(F,) which readings that are off a law moves.

    Args:
        shift: (F, m) by how much, in units of the noise, the same for all directions: random ones
            are not drawn to those of little noise.
        columns: (F, m, P) changes by each site, in the same units.
        pose: (F,) where the readings are.
    """
    count, m, sites = columns.shape
    if not count:
        return np.zeros(0, dtype=np.bool_)
    square = np.sum(shift**2, axis=1)
    length = np.linalg.norm(columns, axis=1)
    along = np.einsum("fi,fip->fp", shift, columns) / np.where(length > 0, length, np.inf)
    beside = np.maximum(square[:, None] - along**2, 0.0)
    mine = beside <= (chi2.isf(CHANCE, m - 1) + ROUGH**2 * square)[:, None]
    p = np.where(mine, beta.cdf(beside / square[:, None], (m - 1) / 2, 0.5), 1.0)
    nearest: Floats = np.sort(p[_different(shift, pose)], axis=0)
    count = len(nearest)
    so_many = np.asarray(binom.sf(np.arange(count)[:, None], count, nearest))
    law = [
        k
        for k, least in enumerate(np.argmin(so_many, axis=0))
        if so_many[least, k] * count * sites < CHANCE
        and len(np.unique(pose[p[:, k] <= nearest[least, k]])) >= FEWEST
    ]
    return np.asarray(mine[:, law].any(axis=1))


def _different(shift: Floats, pose: Ints) -> Bools:
    """(F,) readings without the shift of an earlier one at their pose, which has one cause."""
    out = np.ones(len(pose), dtype=np.bool_)
    for p in np.unique(pose):
        rows = np.flatnonzero(pose == p)
        size = np.linalg.norm(shift[rows], axis=1)
        apart = np.linalg.norm(shift[rows, None] - shift[rows], axis=2)
        same = apart <= SAME * np.maximum(size[:, None], size)
        out[rows] = ~np.tril(same, -1).any(axis=1)
    return out
