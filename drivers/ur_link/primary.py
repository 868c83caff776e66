"""The kinematics that the controller computes with, from its primary port.

A package is its size (i32, all included), its type (u8) and a body; of type 16, a robot state, the
body is a row of parts of the same form. Part 5, the kinematics, is of checksums (6 u32), theta, a,
d and alpha of classic rows (6 f64 each), and the status of the calibration (u32). The controller
sends it when a client has connected. All big-endian. Source: Universal Robots, "Remote Control via
TCP/IP", and `KinematicsInfo` of the Universal Robots Client Library.
"""

import struct

import numpy as np

from hilcal.drivers.ur_link.lines import Connection, LinkError
from hilcal.errors import InputError
from hilcal.robot.factory import FactoryKinematics, of_rows

PORT = 30001
_HEAD = struct.Struct(">iB")
_KINEMATICS = struct.Struct(">6I24dI")
_STATE, _PART = 16, 5
_LONGEST = 1 << 20
_PACKAGES = 50
"""Packages that are looked at: the state comes ten times a second, among messages."""


def kinematics(host: str, seconds: float) -> FactoryKinematics:
    """Return the kinematics of the controller's arm.

    Raises:
        LinkError: nobody answers, not as a controller does, or it does not tell them.
    """
    with Connection(host, PORT, "primary port", seconds) as line:
        for _ in range(_PACKAGES):
            size, kind = _HEAD.unpack(line.read(_HEAD.size))
            if not _HEAD.size <= size <= _LONGEST:
                raise LinkError(f"the primary port ({PORT}) does not answer as a controller does")
            body = line.read(size - _HEAD.size)
            part = _find(body) if kind == _STATE else None
            if part is not None:
                return _read(part)
    raise LinkError(f"the primary port ({PORT}) does not tell the arm's kinematics")


def _find(body: bytes) -> bytes | None:
    at = 0
    while at + _HEAD.size <= len(body):
        size, kind = _HEAD.unpack_from(body, at)
        if size < _HEAD.size or at + size > len(body):
            break
        if kind == _PART and size >= _HEAD.size + _KINEMATICS.size:
            return body[at + _HEAD.size : at + size]
        at += size
    return None


def _read(part: bytes) -> FactoryKinematics:
    told = _KINEMATICS.unpack_from(part)
    rows = np.array(told[6:30]).reshape(4, 6)
    try:
        return of_rows(rows, "the controller", told[30], tuple(told[:6]))
    except InputError as error:
        raise LinkError(f"the primary port ({PORT}): {error}") from None
