"""Random temperatures of joints and air over a campaign."""

import numpy as np

from hilcal.drivers.simulated.truth import AIR
from hilcal.types import Floats

_RISE = (5.0, 20.0)  # °C, rise of a joint's temperature in a rehearsal
_RISE_TIME = (1500.0, 4500.0)  # s, its time constant
_JOINT_STD = 0.05  # °C, noise of a sensor in a joint
_DAY = 86400.0  # s
_DAY_SWING = (0.5, 1.5)  # °C, amplitude of the daily cycle
_ROOM_RISE = (0.5, 2.5)  # °C, rise of the room's temperature by the machines
_ROOM_TIME = (3600.0, 10800.0)  # s, its time constant
_CYCLE = (1200.0, 2700.0)  # s, period of the air conditioning
_CYCLE_SWING = (0.05, 0.25)  # °C, its amplitude
_AIR_STD = 0.02  # °C, noise of an air thermometer


def joints(time: Floats, n: int, rng: np.random.Generator) -> Floats:
    """Return the (N, n) measured temperatures of the joints of an arm, °C.

    T_j = 22 °C + r_j (1 - exp(-t / tau_j)) plus noise: the joints of an arm that was at rest warm
    up by 5 to 20 °C within some hours, each by another amount.

    Args:
        time: (N,) since the arm was switched on, s.
        n: number of joints.
        rng: generator.
    """
    rise, pace = rng.uniform(*_RISE, n), rng.uniform(*_RISE_TIME, n)
    warm = rise * -np.expm1(-np.asarray(time)[:, None] / pace)
    return np.asarray(AIR + warm + _JOINT_STD * rng.standard_normal((len(time), n)))


def air(time: Floats, rng: np.random.Generator) -> Floats:
    """Return the (N,) measured temperatures of the air in a hall, °C, which drift by a few °C.

    They are the sum of a daily cycle, warming by machines, the cycle of the air conditioning, and
    noise.

    Args:
        time: (N,) since the campaign's start, s.
        rng: generator.
    """
    hour, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    day = np.sin(2.0 * np.pi * time / _DAY + hour) - np.sin(hour)
    room = -np.expm1(-time / rng.uniform(*_ROOM_TIME))
    cycle = np.sin(2.0 * np.pi * time / rng.uniform(*_CYCLE) + phase)
    swing = (rng.uniform(*_DAY_SWING), rng.uniform(*_ROOM_RISE), rng.uniform(*_CYCLE_SWING))
    start = AIR + rng.uniform(-1.0, 1.0)
    smooth = start + swing[0] * day + swing[1] * room + swing[2] * cycle
    return np.asarray(smooth + _AIR_STD * rng.standard_normal(len(time)))
