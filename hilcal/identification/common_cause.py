"""Readings that are off for one cause, and so are no gross errors.

In a row, by the same shift: another reflector, a target that was moved on the tool, a tracker that
was bumped. From one reading to another one all are off alike, in the axes of the sensor or of the
target (`off_alike`).

Along what one site of the arm can do: what a law of a joint, of a link that bends or of the force
sensor does to a reading goes along one direction there, whatever the law depends on; a gross error
goes anywhere. Of a random error in m dimensions the share beside a direction is
sin² ~ Beta((m − 1)/2, 1/2), with p its distribution function uniform. So n of F gross errors are as
near to a site's direction as p_(n), ascending, with the binomial probability P(B(F, p_(n)) ≥ n),
times F and the number of sites for the least of all. Where that is too small, what is along the
site, at two poses at least, is a law's (`along_one_site`).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.stats import beta, binom, chi2

from hilcal.model.model import Model, Prediction
from hilcal.model.observe import motion
from hilcal.readings.readings import Readings
from hilcal.robot import se3
from hilcal.types import Bools, Floats, Ints

SAME = 0.25
"""Largest difference of two shifts that are the same one, as a share of the larger; a choice."""
BETWEEN = 1
"""Readings between two alike ones that may be off otherwise; a choice."""
RUN = 4
"""Fewest readings that are off alike; a choice: two in a row agree by chance."""
ACCIDENTAL = 0.05
"""Share of the readings up to which those that are off alike count as gross errors; a choice."""
CHANCE = 1e-2
"""Probability that so many gross errors are along any one site, below which they are none; and that
the noise moves a reading so far beside its law's direction. Choices."""
FEWEST = 2
"""Poses that a law moves at least: an axis of a site and one of the sensor may agree at a pose."""
ROUGH = 0.05
"""Share of a law's shift that may be beside its direction, as the model is linear; a choice."""


def off_alike(readings: Readings, tested: Bools, off: Ints, shift: Floats, axes: Floats) -> Ints:
    """Return the rows that are off alike, more than `ACCIDENTAL` of the tested ones, or none.

    Args:
        readings: N readings, in their order.
        tested: (N,) which take part.
        off: (F,) rows that are far off, ascending.
        shift: (F, 3) by how much, sensor axes.
        axes: (F, 3, 3) orientation of the target, sensor axes.
    """
    order = np.zeros(len(readings), dtype=np.int64)
    found = np.zeros(len(off), dtype=np.bool_)
    target = readings.target
    for k in np.unique(target[off]):
        mine = tested & (target == k)
        order[mine] = np.arange(np.count_nonzero(mine))
        at = np.flatnonzero(target[off] == k)
        turned = (shift[at, None] @ axes[at])[:, 0]
        found[at] = _in_a_row(order[off[at]], shift[at]) | _in_a_row(order[off[at]], turned)
    few = np.count_nonzero(found) <= ACCIDENTAL * np.count_nonzero(tested)
    return off[:0] if few else off[found]


def _in_a_row(order: Ints, shift: Floats) -> Bools:
    """(F,) which shifts (F, 3) are the same as `RUN` in a row, all readings between off as well."""
    count = len(shift)
    run, size = np.arange(count), np.linalg.norm(shift, axis=1)
    for ahead in range(1, BETWEEN + 2):
        for k in range(count - ahead):
            then = k + ahead
            apart = np.linalg.norm(shift[then] - shift[k])
            if order[then] - order[k] == ahead and apart <= SAME * max(size[k], size[then]):
                run[run == run[then]] = run[k]
    return np.asarray(np.bincount(run, minlength=count)[run] >= RUN)


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
