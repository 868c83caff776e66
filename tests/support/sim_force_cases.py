"""Plain readers of the simulated force sensors, apart from the real drivers."""

import contextlib
import struct
import time
from collections.abc import Callable, Iterator

import minimalmodbus
import numpy as np
import serial
from scipy import stats

from drivers.simulated.force.bota import crc16_x25
from drivers.simulated.force.ft300 import crc16_modbus
from drivers.simulated.force.gauge import DRIFT_STD
from tests.support.sim_serial_cases import Instrument

WRENCH = (1.0, -2.0, 30.0, 0.1, 0.2, -0.3)
BOTA = struct.Struct("<H6fIf")
STREAM = 0x0200


def bota_frame(data: bytes) -> tuple[float, ...] | None:
    crc = int.from_bytes(data[35:], "little")
    return BOTA.unpack(data[1:35]) if crc == crc16_x25(data[1:35]) else None


def ft300_frame(data: bytes) -> tuple[float, ...] | None:
    if int.from_bytes(data[14:], "little") != crc16_modbus(data[:14]):
        return None
    counts = struct.unpack("<6h", data[2:14])
    return tuple(c / s for c, s in zip(counts, (100, 100, 100, 1000, 1000, 1000), strict=True))


def hex_frame(data: bytes) -> tuple[float, ...] | None:
    if int.from_bytes(data[20:], "big") != sum(data[:20]) & 0xFFFF:
        return None
    return struct.unpack(">HH6h", data[4:20])


SHAPES: dict[str, tuple[bytes, int, int, Callable[[bytes], tuple[float, ...] | None]]] = {
    "bota": (b"\xaa", 37, 460800, bota_frame),
    "ft300": (b"\x20\x4e", 16, 19200, ft300_frame),
    "hex": (b"\xaa\x07\x08\x10", 22, 1_000_000, hex_frame),
}


class Reader:
    """A plain resynchronising reader; it counts the bytes that fit no frame."""

    def __init__(self, sensor: Instrument, kind: str, baud: int | None = None) -> None:
        self.header, self.size, rate, self.parse = SHAPES[kind]
        self.port = serial.Serial(str(sensor.port), baud or rate, timeout=0.05, exclusive=True)
        self.buffer = b""
        self.skipped = 0

    def __enter__(self) -> "Reader":
        return self

    def __exit__(self, *_: object) -> None:
        self.port.close()

    def frames(self, count: int, patience: float = 10.0) -> np.ndarray:
        """Return `count` frames, fewer where they do not come in `patience` s."""
        out: list[tuple[float, ...]] = []
        deadline = time.monotonic() + patience
        while len(out) < count and time.monotonic() < deadline:
            self.buffer += self.port.read(self.port.in_waiting or 1)
            out += self._cut(count - len(out))
        return np.array(out)

    def _cut(self, most: int) -> Iterator[tuple[float, ...]]:
        at = 0
        while most and len(self.buffer) - at >= self.size:
            data = self.buffer[at : at + self.size]
            frame = self.parse(data) if data.startswith(self.header) else None
            if frame is None:
                self.skipped += 1
                at += 1
            else:
                at += self.size
                most -= 1
                yield frame
        self.buffer = self.buffer[at:]


@contextlib.contextmanager
def modbus(sensor: Instrument) -> Iterator[minimalmodbus.Instrument]:
    client = minimalmodbus.Instrument(str(sensor.port), 9)
    client.serial.baudrate, client.serial.timeout = 19200, 0.5
    try:
        yield client
    finally:
        client.serial.close()


@contextlib.contextmanager
def streaming(sensor: Instrument) -> Iterator[Reader]:
    """An FT 300 that streams, and does not any more afterwards."""
    with modbus(sensor) as client:
        client.write_register(410, STREAM)
    with Reader(sensor, "ft300") as reader:
        try:
            yield reader
        finally:
            reader.port.write(b"\xff" * 50)
            reader.port.flush()
            while reader.port.read(1000):
                pass


def expected(state: dict[str, object]) -> np.ndarray:
    return np.array(WRENCH) + np.array(state["bias"])


def assert_normal(frames: np.ndarray, mean: np.ndarray, std: np.ndarray, kelvin: float) -> None:
    """Mean and variance are right; the zero may have drifted by five sigma over `kelvin`."""
    count = len(frames)
    slack = 5 * std / np.sqrt(count) + 5 * DRIFT_STD * abs(kelvin)
    assert np.all(np.abs(frames.mean(axis=0) - mean) < slack)
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], count - 2)
    since = np.arange(count) - (count - 1) / 2  # the sensor warms up meanwhile: a straight line
    slope = since @ frames / (since @ since)
    noise = frames - frames.mean(axis=0) - np.outer(since, slope)
    square = (noise**2).sum(axis=0) / std**2
    assert np.all((low < square) & (square < high))
