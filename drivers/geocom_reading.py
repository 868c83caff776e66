"""What a GeoCOM instrument answers to a measurement, checked."""

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from drivers import geocom_codes as geo
from drivers.geocom_line import DEVICE, Reply
from hilcal.errors import DeviceError
from hilcal.types import Floats

TURN = 2.0 * np.pi + 1e-6
"""Of a full circle, rad, with what rounding adds."""
LARGEST_STD = 0.01
"""rad; a choice, a thousand times what the poorest total station states (2 mgon)."""
LARGEST_TILT = 0.5 * np.pi
"""rad; no station measures upside down."""


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


def plausible(polar: PolarReading) -> PolarReading:
    """Return a measurement whose angles are some that an instrument can have.

    Raises:
        DeviceError: an angle beyond a full turn (`TURN`), or a standard deviation or inclination
            of angles beyond `LARGEST_STD`, `LARGEST_TILT`.
    """
    if not (abs(polar.hz) <= TURN and 0.0 <= polar.v <= TURN):
        _strange(f"angles of {polar.hz:.6g} and {polar.v:.6g} rad")
    if not 0.0 <= polar.angle_std <= LARGEST_STD:
        _strange(f"a standard deviation of its angles of {polar.angle_std:.3g} rad")
    if polar.tilt is not None and max(map(abs, polar.tilt)) > LARGEST_TILT:
        _strange(f"an inclination of {max(map(abs, polar.tilt)):.3g} rad")
    return polar


def _strange(what: str) -> NoReturn:
    raise DeviceError(f"{DEVICE}: measuring: the instrument gives {what}; is it a GeoCOM station?")
