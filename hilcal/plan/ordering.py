"""What is to be put in order, and how."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from hilcal.data.plan import UNLOADED
from hilcal.plan.blocks import Stop


@dataclass(frozen=True, slots=True)
class Chosen:
    """Readings to take at a pose.

    Attributes:
        pose: its name.
        loads: under which loads, "none" among them where it is measured unloaded.
        count: how often all of it; each time is a cycle of its own.
    """

    pose: str
    loads: tuple[str, ...]
    count: int = 1


@dataclass(frozen=True, slots=True)
class Ordering:
    """How to order.

    Attributes:
        slack: share of the shortest campaign that may be spent on a random order; 0 for the
            shortest order. With 40 poses and four loads ρ falls from 0.64 to 0.14 for 2 %, and
            no further for 30 %.
        unloaded: "around" takes half of the unloaded readings before the loads and half after,
            "first" all before: deflections are then known while the loads are measured.
        reference_every_s: longest time between two readings at the reference pose, s.
        repeats: poses that are measured unloaded a second time, for the arm's repeatability.
        draws: random orders of which the least confounded is taken.
        drift: rate of the drift that figures are stated for, in one coordinate, m/s. There is
            no figure for all cells; 20 µm/h is a tenth of the drift that the effect
            `tracker_drift` takes as ordinary in a campaign of an hour.
        reading_std: standard uncertainty of a reading in one coordinate, m.
    """

    slack: float = 0.05
    unloaded: Literal["around", "first"] = "around"
    reference_every_s: float = 900.0
    repeats: int = 2
    draws: int = 16
    drift: float = 20e-6 / 3600
    reading_std: float = 15e-6


def stops_of(
    used: Sequence[str], chosen: Sequence[Chosen], repeats: int, rng: np.random.Generator
) -> dict[str, list[Stop]]:
    """Return the stops by load; each taking gets the first cycle that has none of its loads."""
    taken: dict[tuple[int, str], set[int]] = {}
    for c in chosen:
        pose = used.index(c.pose) + 1
        for _ in range(c.count):
            full = [taken.setdefault((pose, load), set()) for load in c.loads]
            cycle = next(k for k in range(10**9) if not any(k in cycles for cycles in full))
            for cycles in full:
                cycles.add(cycle)
    once = [p for (p, load), cycles in taken.items() if load == UNLOADED and len(cycles) == 1]
    again = sum(load == UNLOADED and len(cycles) > 1 for (_, load), cycles in taken.items())
    more = min(max(repeats - again, 0), len(once))
    for pose in rng.choice(once, more, replace=False) if more else ():
        mine = [cycles for (p, _), cycles in taken.items() if p == pose]
        taken[int(pose), UNLOADED].add(max(max(cycles) for cycles in mine) + 1)
    out: dict[str, list[Stop]] = {}
    for (pose, load), cycles in taken.items():
        out.setdefault(load, []).extend(Stop(pose, cycle) for cycle in sorted(cycles))
    return out
