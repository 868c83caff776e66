"""OptoForce (OnRobot) HEX: streams from power-on, 1 Mbaud, 10 to 1000 Hz.

Frame (OptoForce, "OptoForce General DAQ", 6-axis): `AA 07 08 10`, `>HH6h` of counter, status,
wrench in counts, then the sum of all bytes before it as a big-endian u16: 22 bytes. The counts
per newton are each sensor's own; here 50 per N and 2000 per N·m.
"""

import struct
from typing import Any

import numpy as np

from hilcal.types import Floats

HEADER = b"\xaa\x07\x08\x10"
SCALE = np.repeat((50.0, 2000.0), 3)
_COUNTS = 32767
_OVERLOAD = 1 << 8

_BODY = struct.Struct(">HH6h")


class Hex:
    """The sensor's protocol; it keeps its rate."""

    baud = 1_000_000
    noise = (0.05, 0.001)

    def __init__(self, rate: float = 1000.0) -> None:
        """Switch on."""
        self.rate = rate
        self.streaming = True

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `Sensor.frame`."""
        counts = np.rint(wrench * SCALE)
        inside = np.clip(counts, -_COUNTS, _COUNTS)
        status = _OVERLOAD if np.any(inside != counts) else 0
        body = HEADER + _BODY.pack(number & 0xFFFF, status, *map(int, inside))
        return body + struct.pack(">H", sum(body) & 0xFFFF)

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Ignore what is sent."""
        return b""

    def admin(self, op: str, arguments: dict[str, Any]) -> bool:
        """No operations of its own."""
        return False
