"""Bota Systems Rokubi and SensONE: streams from power-on.

Frame (Bota Systems' public Arduino and ROS drivers): `AA`, `<H6fIf` of status, wrench, device
time in µs and °C, then CRC-16/X25 over those 34 bytes, little-endian: 37 bytes at 460800 Bd.
Status bits: 0 skipped samples, 1 over range, 2 invalid measurement, 3 raw values.
"""

import binascii
import struct
from typing import Any

import numpy as np

from hilcal.types import Floats

HEADER = b"\xaa"
OVER_RANGE = 1 << 1
RANGE = np.array([500.0, 500.0, 1200.0, 15.0, 15.0, 10.0])
"""Full scale of a SensONE, N and N·m."""

_BODY = struct.Struct("<H6fIf")
_CRC = struct.Struct("<H")
_MIRRORED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def crc16_x25(data: bytes) -> int:
    """Return the CRC-16/X25: the mirror image of CRC-16/CCITT, start FFFF, inverted."""
    mirrored = binascii.crc_hqx(data.translate(_MIRRORED), 0xFFFF)
    return (_MIRRORED[mirrored & 0xFF] << 8 | _MIRRORED[mirrored >> 8]) ^ 0xFFFF


class Bota:
    """The sensor's protocol; it takes no commands while it runs."""

    baud = 460800
    noise = (0.05, 0.002)

    def __init__(self, rate: float = 1000.0) -> None:
        """Switch on."""
        self.rate = rate
        self.streaming = True
        self.saturated = False
        self._start_us = 0

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `Sensor.frame`."""
        inside = np.clip(wrench, -RANGE, RANGE)
        over = self.saturated or bool(np.any(inside != wrench))
        time_us = (self._start_us + round(number * 1e6 / self.rate)) & 0xFFFFFFFF
        body = _BODY.pack(OVER_RANGE if over else 0, *inside, time_us, temperature)
        return HEADER + body + _CRC.pack(crc16_x25(body))

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Ignore what is sent."""
        return b""

    def admin(self, op: str, arguments: dict[str, Any]) -> bool:
        """`saturate {on}` sets the status; `clock {us}` sets the time of frame 0."""
        if op == "saturate":
            self.saturated = bool(arguments["on"])
        elif op == "clock":
            self._start_us = int(arguments["us"])
        else:
            return False
        return True
