"""What a GeoCOM instrument answers to a measurement, checked."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from drivers import geocom_codes as geo
from drivers.geocom_line import DEVICE, Reply
from hilcal.errors import DeviceError
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class PolarReading:
    """One measurement as the instrument gives it.

    Attributes:
        host_ns: `time.monotonic_ns` right after it came.
        hz: horizontal angle, rad.
        v: angle from the zenith, rad.
        distance: slope distance, m; 0 is none.
        angle_std: what it states of both angles, rad; 0 where it does not tell.
        tilt: inclination across and along, rad.
        measured_ms: when the distance was measured, ms of its own clock; 0 is unknown.
        warning: what it remarks.
    """

    host_ns: int
    hz: float
    v: float
    distance: float
    angle_std: float = 0.0
    tilt: tuple[float, float] | None = None
    measured_ms: float = 0.0
    warning: str = ""


def usable(answer: Reply) -> str:
    """Return the remark of a usable measurement, empty for none.

    Raises:
        TargetLostError: it has no distance.
        DeviceError: it is none.
    """
    if answer.code == geo.OK:
        return ""
    if answer.code in geo.WARNINGS:
        return geo.WARNINGS[answer.code]
    raise geo.failure("measuring", answer.code)


def numbers(answer: Reply, count: int) -> Floats:
    """Return the (count,) numbers of a measurement.

    Raises:
        DeviceError: there are more or fewer, or one is not finite.
    """
    numbers = np.array(answer.values, dtype=np.float64)
    if numbers.shape != (count,):
        _strange(f"{len(answer.values)} values instead of {count}")
    if not np.all(np.isfinite(numbers)):
        _strange("values that are no numbers")
    return numbers


def _strange(what: str) -> NoReturn:
    raise DeviceError(f"{DEVICE}: measuring: the instrument gives {what}; is it a GeoCOM station?")
