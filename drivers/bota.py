"""Bota Systems Rokubi and SensONE over serial: they stream from power-on.

Frame (Bota Systems' public ROS drivers): `AA`; `<H6fIf` of status, wrench in N and N·m, device
time in µs, temperature in °C; CRC-16/X-25 of these 34 bytes, little-endian: 37 bytes. Status
bits: 0 skipped samples, 1 over range, 2 invalid measurement, 3 raw values.
"""

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers import force_stream as fs
from hilcal.drivers.links import crc_x25
from hilcal.measuring.devices import ForceSensorDevice
from hilcal.types import Floats

BAUD = 460800
SKIPPED = 1
_STATUS = (
    (2, "is loaded over its range; take the load off"),
    (4, "reports an invalid measurement"),
    (8, "sends raw values; configure it to send N and N·m"),
)


def _overload(wrench: Floats, status: int) -> str:
    """The error that the status reports; bit 0 (fewer samples averaged) is no error."""
    for bit, problem in _STATUS:
        if status & bit:
            return f"the Bota sensor {problem} (status {status:#06x})"
    if status & ~SKIPPED:
        return f"the Bota sensor reports the unknown status {status:#06x}"
    return ""


SENSOR = fs.SensorFormat(
    name="Bota sensor",
    frame=fs.FrameFormat(b"\xaa", 37, lambda frame: crc_x25(frame[1:])),
    body=np.dtype(
        [("status", "<u2"), ("wrench", "<f4", 6), ("ticks", "<u4"), ("temperature", "<f4")]
    ),
    unit=np.ones(6),
    losses=lambda: fs.ByDeviceClock(1e-6, 32),
    overload=_overload,
)


def open_force_sensor(config: CellConfig) -> ForceSensorDevice:
    """Open the port of [force_sensor] and wait for the first frame."""
    return fs.open_streaming(fs.checked_config(config), BAUD, SENSOR)
