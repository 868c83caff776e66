"""OptoForce and OnRobot HEX over serial, streaming.

Frame (OptoForce General DAQ protocol): `AA 07 08 10`; `>HH6h` of counter, status and wrench in
counts; the sum of all these bytes as a big-endian u16: 22 bytes at 1 MBd. The counts per unit are
on the data sheet of each sensor, so the configuration has to give them:

    [force_sensor]
    driver = "hex"
    port = "/dev/serial/by-id/..."
    options = { counts_per_N = 50.0, counts_per_Nm = 2000.0, rate_hz = 1000.0 }
"""

import numpy as np
from pydantic import Field

from hilcal.config import CellConfig
from hilcal.drivers import force_stream as fs
from hilcal.measuring.devices import ForceSensorDevice
from hilcal.toml import Positive, Section, check_section
from hilcal.types import Floats

BAUD = 1_000_000
FULL_COUNT = 32767
NAME = "OnRobot HEX"
_SHEET = "a number over 0, from the sensor's own sheet"
_BODY = np.dtype([("ticks", ">u2"), ("status", ">u2"), ("wrench", ">i2", 6)])


def _sensor(counts_per_N: float, counts_per_Nm: float, rate: float) -> fs.SensorFormat:
    unit = 1.0 / np.repeat((counts_per_N, counts_per_Nm), 3)

    def overload(wrench: Floats, status: int) -> str:
        if status:
            return f"the {NAME} reports status {status:#06x}: overloaded or failed"
        if np.any(np.abs(wrench) >= 0.9999 * FULL_COUNT * unit):
            return f"the {NAME} is loaded over its range; take the load off"
        return ""

    frame = fs.FrameFormat(
        b"\xaa\x07\x08\x10", 22, lambda f: (sum(f) & 0xFFFF).to_bytes(2, "big"), weak_checksum=True
    )
    return fs.SensorFormat(
        NAME, frame, _BODY, unit, lambda: fs.ByDeviceClock(1.0 / rate, 16), overload
    )


class HexOptions(Section):
    """[force_sensor.options]: keys of the driver "hex"."""

    counts_per_N: Positive = Field(description=_SHEET)
    counts_per_Nm: Positive = Field(description=_SHEET)
    rate_hz: Positive = Field(1000.0, description="records per second, over 0")


def open_force_sensor(config: CellConfig) -> ForceSensorDevice:
    """Open the port of [force_sensor] and wait for the first frame."""
    section = fs.checked_config(config, tuple(HexOptions.model_fields))
    o = check_section(dict(section.options), HexOptions, "[force_sensor] options")
    return fs.open_streaming(section, BAUD, _sensor(o.counts_per_N, o.counts_per_Nm, o.rate_hz))
