"""How warm the joints and the air are in simulated cells."""

import numpy as np

from hilcal.types import Floats

AIR = 22.0
"""Air temperature of the cell behind the wires, and of a rehearsal's start, °C."""

_WARM_START = 4.0  # °C above the air at the world's start
_WARM_RISE = np.array([9.0, 11.0, 10.0, 8.0, 8.0, 7.0])  # °C above the air in the end
_WARM_TIME = 2400.0  # s, time constant of the warm-up


def warm_up(time: Floats, n: int = 6) -> Floats:
    """Return the (N, n) temperatures of the joints in the cell behind the wires, °C.

    T = air + rise + (start - rise) exp(-t / 2400 s), with `time` (N,) since its start, s.
    """
    left = np.exp(-np.asarray(time) / _WARM_TIME)[:, None]
    rise = np.resize(_WARM_RISE, n)
    return np.asarray(AIR + rise + (_WARM_START - rise) * left)
