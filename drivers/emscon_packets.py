"""Leica emScon: packets, numbers of commands and results, and their meaning.

Every packet is little-endian, packed to 4 bytes, and begins with its size (int32, header included)
and its type (uint32). A command is sent as its number and its parameters; the answer is its number,
its status and its content. A result is its status and the measurement. The server also sends errors
(command, status) and changes of its state, without a request.

Source: Leica Geosystems, emScon TPI V3.6, `ES_C_API_Def.h` (LTD, AT901 and AT40x trackers).
"""

import struct
from dataclasses import dataclass

import numpy as np

from hilcal.errors import DeviceError
from hilcal.measuring.devices import TargetLostError
from hilcal.types import Floats

PORT = 700
HEADER = struct.Struct("<iI")
LARGEST = 1 << 16  # bytes; no packet is longer

# types of packets
COMMAND, ERROR, SINGLE, PROBE, CHANGE, SINGLE2 = 0, 1, 2, 4, 8, 9

# commands
GET_SYSTEM_STATUS, SET_UNITS, GET_UNITS, INITIALIZE = 1, 5, 6, 7
GET_ENVIRONMENT, SET_MODE, GET_MODE, SET_COORDINATES, GET_COORDINATES = 21, 24, 25, 26, 27
SET_STATIONARY, GET_STATIONARY = 28, 29
SET_REFLECTOR, GET_REFLECTOR, GET_REFLECTORS, SET_SEARCH = 40, 41, 42, 43
SET_SETTINGS, GET_SETTINGS, START_MEASUREMENT = 47, 48, 49
GO_POSITION, FIND_REFLECTOR, UNKNOWN = 55, 63, 64
SET_STATISTICS, GET_STATISTICS, GET_STATUS_INFO, GET_TRACKER_INFO = 80, 81, 122, 132

# modes of measurement, changes of state, bits of GET_STATUS_INFO
STATIONARY, STATIONARY_6D = 0, 6
REFLECTOR_CHANGED, INITIALIZATION_CHANGED = 7, 151
SETTINGS_CHANGED = frozenset({6, 8, 12, 15, 16, 17, 18, 24})
RESTARTED = {850: "the sensor was connected again", 999: "its server was started again"}
CLOSING = {
    851: "its sensor is disconnected",
    997: "its controller closes the connection",
    998: "its server is being shut down",
}
REFLECTOR_FOUND, LEVELLED = 2048, 32768
BOOTED, INITIALIZED = 3, 5  # states of the tracker in GET_SYSTEM_STATUS
WEATHER = ("none: temperature, pressure, humidity as set", "read, but not used", "used")
"""States of the weather station in GET_SYSTEM_STATUS."""

OK, BUSY, NOT_IMPLEMENTED, NOT_INITIALIZED = 0, 1, 2, 39
SUCCESS = frozenset(
    {OK, *range(11, 22, 2)}
)  # odd 11 to 21: done, though a parameter is out of range
NO_DISTANCE, NO_RESULT = 37, 10009

NO_READING = {
    NO_DISTANCE: "no distance (the beam was broken; the reflector has to be found again)",
    NOT_INITIALIZED: "the tracker is no longer initialised; it has to find its zeros again",
    93: "the probe's orientation could not be measured",
    10004: "it is not ready to measure (no reflector in the beam?)",
    NO_RESULT: "no measurement (beam broken, or no reflector?)",
    10014: "it is not ready to measure (no reflector in the beam?)",
}
"""Statuses without a reading; another try after a search may give one."""

_MEANING = {
    BUSY: "busy with something else",
    NOT_IMPLEMENTED: "the command is not known",
    23: "the wrong reflector is set for this measurement",
    27: "no weather station",
    30: "no absolute distance meter",
    35: "another program uses it",
    38: "no tracker is connected to the controller",
    57: "temperature, pressure or humidity are out of range",
    75: "no measurement probe",
    76: "no measurement probe is active",
    92: "it cannot measure the orientation of a target in its present state",
    98: "invalid input",
    10010: "it is not level",
    10011: "another program is connected, and it allows one connection only",
    10012: "it is not warmed up",
    10013: "it does not stand firmly",
    10015: "no communication with the sensor",
    10016: "no battery in the sensor",
    10019: "it is not level enough to be initialised",
}


def failure(action: str, status: int) -> DeviceError:
    """Return the exception for a status that is not `OK`; `action`: e.g. "measuring"."""
    if status in NO_READING:
        return TargetLostError(f"tracker: {action}: {NO_READING[status]} (status {status})")
    meaning = _MEANING.get(status)
    if meaning is None and (3 <= status <= 22 or 47 <= status <= 55):
        meaning = "a parameter is refused"
    cause = f"{meaning} (status {status})" if meaning else f"status {status}"
    return DeviceError(f"tracker: {action}: the tracker reports: {cause}")


def text(field: bytes) -> str:
    """Decode a null-terminated text of 16-bit characters."""
    return field.decode("utf-16-le", "replace").split("\0")[0].strip()


@dataclass(frozen=True, slots=True, eq=False)
class Measurement:
    """The result of a stationary measurement, in the units set (m, rad, °C, mbar, %)."""

    position: Floats  # (3,) m
    covariance: Floats
    """(3, 3) as the instrument states it a priori, m²; zero: none stated."""
    quaternion: Floats | None  # (4,) scalar first; None for a reflector
    angles: Floats  # (3,) the orientation as rotations about x, y, z, rad
    angle_covariance: Floats  # (3, 3) of these, rad²; zero: none stated


_SINGLE, _SINGLE2 = struct.Struct("<Ii17d"), struct.Struct("<Ii23d")
_PROBE = struct.Struct("<IiIiiiIii41d")


def measurement(kind: int, body: bytes) -> Measurement:
    """Parse a result of type `SINGLE`, `SINGLE2` or `PROBE`, without its status."""
    none = np.zeros((3, 3))
    if kind == PROBE:
        d = np.array(_PROBE.unpack(body)[9:])
        angular = _covariance(d[31:34], d[35:38])
        return Measurement(d[:3], _covariance(d[10:13], d[14:17]), d[17:21], d[21:24], angular)
    if kind == SINGLE2:
        d = np.array(_SINGLE2.unpack(body)[2:])
        return Measurement(d[:3], _covariance(d[13:16], d[17:20]), None, np.zeros(3), none)
    d = np.array(_SINGLE.unpack(body)[2:])
    return Measurement(d[:3], _covariance(d[10:13], np.zeros(3)), None, np.zeros(3), none)


def pack_measurement(
    m: Measurement, mode: int, environment: tuple[float, float, float]
) -> tuple[int, bytes]:
    """Return type and content of the result of a measurement; the inverse of `measurement`.

    `environment` is temperature °C, pressure mbar, relative humidity %.
    """
    stated = _stated(m.covariance)
    if m.quaternion is None:
        values = (*m.position, *stated, 0.0, 0.0, 0.0, *stated, *environment)
        return SINGLE2, _SINGLE2.pack(mode, 0, *values)
    angular = _stated(m.angle_covariance)
    values = (*m.position, *stated, *stated, *m.quaternion, *m.angles, *angular, *angular)
    return PROBE, _PROBE.pack(mode, 0, 0, 0, 1, 0, 0, 0, 0, *values, *environment)


def _covariance(std: Floats, mixed: Floats) -> Floats:
    """(3, 3) of standard deviations 1, 2, 3 and covariances 12, 13, 23."""
    with np.errstate(over="ignore"):
        out = np.diag(std**2)
    for value, (i, k) in zip(mixed, ((0, 1), (0, 2), (1, 2)), strict=True):
        out[i, k] = out[k, i] = value
    return out


def _stated(c: Floats) -> tuple[float, ...]:
    """Standard deviations, their total, and covariances 12, 13, 23."""
    std = np.sqrt(np.diag(c))
    return (*std, float(np.sqrt(np.trace(c))), c[0, 1], c[0, 2], c[1, 2])
