"""Where physics acts on the chain: joint displacements, link twists, the sensor's side.

Deviations add exactly: the chain is evaluated once, on the sum.
"""

from dataclasses import dataclass

import numpy as np

from hilcal.robot.batch import by_field
from hilcal.types import Floats


@dataclass(frozen=True, slots=True, eq=False)
class Deviation:
    """Departure of N states from the nominal chain; None stands for zero.

    Attributes:
        dq: (N, n) joint displacements, rad: of the drives where joints are coupled (`Arm.drive`).
        twist: (N, n + 1, 6) small rigid displacement of everything beyond slot k, in the axes
            of slot k, m and rad.
        base: (N, 6) twist of the base relative to its registration, base axes.
        station: (N, 6) twist of the readings about the sensor's origin, sensor axes.
        target: (N, 6) displacement of the tracked target, flange axes.
        scale: (N,) relative scale error of the sensor's ranges.
        observer: (N, 6) twist of the position in the axes of what observes it, where there are
            several; of a distance, which no turn changes, element 3 is the offset, m.
    """

    dq: Floats | None = None
    twist: Floats | None = None
    base: Floats | None = None
    station: Floats | None = None
    target: Floats | None = None
    scale: Floats | None = None
    observer: Floats | None = None

    def __add__(self, other: "Deviation") -> "Deviation":
        """Add two deviations element by element."""
        return by_field((self, other), lambda given: np.asarray(sum(given[1:], given[0])))
