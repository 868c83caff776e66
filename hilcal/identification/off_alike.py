"""Readings in a row that are off by the same shift: no gross errors, but one cause.

Another reflector, a target that was moved on the tool, a tracker that was bumped: from one reading
to another one all are off alike, in the axes of the sensor or of the target.
"""

import numpy as np

from hilcal.readings.readings import Readings
from hilcal.types import Bools, Floats, Ints

SAME = 0.25
"""Largest difference of two shifts that are the same one, as a share of the larger; a choice."""
BETWEEN = 1
"""Readings between two alike ones that may be off otherwise; a choice."""
RUN = 4
"""Fewest readings that are off alike; a choice: two in a row agree by chance."""
ACCIDENTAL = 0.05
"""Share of the readings up to which those that are off alike count as gross errors; a choice."""


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
