"""OptoForce and OnRobot HEX over serial, streaming.

Frame (OptoForce General DAQ protocol): `AA 07 08 10`; `>HH6h` of counter, status and wrench in
counts; the sum of all bytes before it as a big-endian u16: 22 bytes at 1 MBd. What a count is
stands in each sensor's own sheet, so the configuration has to give it:

    [force_sensor]
    driver = "hex"
    port = "/dev/serial/by-id/..."
    options = { counts_per_N = 50.0, counts_per_Nm = 2000.0, rate_hz = 1000.0 }
"""

from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.force_stream import (
    ByDeviceClock,
    FrameFormat,
    SensorFormat,
    checked_config,
    open_streaming,
)
from hilcal.errors import InputError
from hilcal.measuring.devices import ForceSensorDevice
from hilcal.types import Floats

BAUD = 1_000_000
FULL_COUNT = 32767
NAME = "OnRobot HEX"
_BODY = np.dtype([("ticks", ">u2"), ("status", ">u2"), ("wrench", ">i2", 6)])


def _checksum(frame: bytes) -> bytes:
    return (sum(frame) & 0xFFFF).to_bytes(2, "big")


def _sensor(counts_per_N: float, counts_per_Nm: float, rate: float) -> SensorFormat:
    unit = 1.0 / np.repeat((counts_per_N, counts_per_Nm), 3)

    def overload(wrench: Floats, status: int) -> str:
        if status:
            return f"the {NAME} reports status {status:#06x}: overloaded or failed"
        if np.any(np.abs(wrench) >= 0.9999 * FULL_COUNT * unit):
            return f"the {NAME} is loaded over its range; take the load off"
        return ""

    frame = FrameFormat(b"\xaa\x07\x08\x10", 22, _checksum, weak=True)
    return SensorFormat(NAME, frame, _BODY, unit, lambda: ByDeviceClock(1.0 / rate, 16), overload)


def open_force_sensor(config: CellConfig) -> ForceSensorDevice:
    """Open the port of [force_sensor] and wait for the first frame."""
    section = checked_config(config, ("counts_per_N", "counts_per_Nm", "rate_hz"))
    given = {"rate_hz": 1000.0, **section.options}
    values = []
    for name in ("counts_per_N", "counts_per_Nm", "rate_hz"):
        value: Any = given.get(name)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not number or not 0.0 < float(value) < 1e9:
            raise InputError(
                f'[force_sensor] options: driver "{section.driver}" needs {name}, a number over 0 '
                "(see the sensor's own sheet)"
            )
        values.append(float(value))
    return open_streaming(section, BAUD, _sensor(*values))
