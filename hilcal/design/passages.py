"""Which straight motions between the poses of a plan are clear, and what they take."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from hilcal.design.timing import Pace
from hilcal.design.tour import NEVER
from hilcal.types import Bools, Floats, Ints

Passable = Callable[[Floats, Floats, str], Bools]
"""passable(start (n,), ends (M, n), load) -> (M,): which straight motions in joint space are
clear under a load."""
NEAR = 24
"""Neighbours of a pose to which motions are tested; to others the arm goes by the reference.
A choice."""


@dataclass(frozen=True, slots=True, eq=False)
class Ways:
    """Ways under one load between the reference, index 0, and P poses.

    Attributes:
        direct: (P + 1, P + 1) seconds of straight motions, `NEVER` where none is known clear.
        seconds: the same, or by the reference with a reading there where that is needed.
    """

    direct: Floats
    seconds: Floats

    def among(self, which: Ints) -> "Ways":
        """Return the ways between the reference and some stops, poses (m,) from 1.

        Between two stops at the same pose the arm goes by the reference: it is to arrive anew.
        """
        grid = np.ix_(*[np.concatenate([[0], which])] * 2)
        return Ways(self.direct[grid], self.seconds[grid])


def ways(q: Floats, load: str, passable: Passable, pace: Pace, near: int = NEAR) -> Ways:
    """Return the ways between poses under a load.

    Args:
        q: (P + 1, n) joint angles, rad; the reference first.
        load: name of the load that hangs.
        passable: which motions are clear.
        pace: seconds of motions and readings.
        near: neighbours to which motions are tested; the nearest in time.
    """
    legs = pace.legs(q, q)
    count = len(q)
    close = np.argsort(legs, axis=1, kind="stable")[:, : near + 1]
    tested = np.zeros((count, count), dtype=np.bool_)
    tested[np.arange(count)[:, None], close] = True
    tested |= tested.T
    tested[0] = tested[:, 0] = True
    np.fill_diagonal(tested, False)
    direct = np.full((count, count), NEVER)
    for k in range(count):
        ends = np.flatnonzero(tested[k])
        if len(ends):
            clear = ends[passable(q[k], q[ends], load)]
            direct[k, clear] = legs[k, clear]
    around = direct[:, :1] + pace.reading_s + direct[:1]
    return Ways(direct, np.minimum(np.minimum(direct, around), NEVER))
