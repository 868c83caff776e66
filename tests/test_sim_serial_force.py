"""The simulated force sensors, read by pyserial and minimalmodbus."""

import contextlib
import os
import signal
import struct
import time
from collections.abc import Callable, Iterator

import minimalmodbus
import numpy as np
import pytest
import serial
from scipy import stats
from sim_serial_cases import Instrument, force_sensor

from drivers.simulated.force.bota import OVER_RANGE, crc16_x25
from drivers.simulated.force.ft300 import crc16_modbus
from drivers.simulated.force.gauge import DRIFT_STD, ROOM

WRENCH = (1.0, -2.0, 30.0, 0.1, 0.2, -0.3)
BOTA = struct.Struct("<H6fIf")
STREAM = 0x0200


@pytest.fixture(scope="module")
def bota() -> Iterator[Instrument]:
    with force_sensor("bota", WRENCH) as sensor:
        yield sensor


@pytest.fixture(scope="module")
def ft300() -> Iterator[Instrument]:
    with force_sensor("ft300", WRENCH) as sensor:
        yield sensor


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
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], count - 1)
    square = ((frames - frames.mean(axis=0)) ** 2).sum(axis=0) / std**2
    assert np.all((low < square) & (square < high))


def test_checksums_have_their_catalogue_values() -> None:
    assert crc16_x25(b"123456789") == 0x906E  # CRC RevEng catalogue
    assert crc16_modbus(b"123456789") == 0x4B37


def test_bota_streams_what_is_true_with_its_bias_and_noise(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        frames = reader.frames(1000)
    state = bota.admin("state")
    assert len(frames) == 1000
    assert np.all(frames[:, 0] == 0)
    std = np.repeat((0.05, 0.002), 3)
    assert_normal(frames[:, 1:7], expected(state), std, state["temperature"] - ROOM)
    assert frames[-1, 8] == pytest.approx(state["temperature"], abs=0.05)


def test_bota_loses_nothing_at_1_khz(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        reader.frames(10)
        before, skipped = bota.admin("state"), reader.skipped
        frames = reader.frames(3000)
        after = bota.admin("state")
    assert len(frames) == 3000
    assert np.all(np.diff(frames[:, 7]) == 1000)  # µs
    assert reader.skipped == skipped
    assert after["dropped"] == before["dropped"]
    assert after["lost"] == 0


def test_its_clock_neither_hurries_nor_lags() -> None:
    began = time.monotonic()
    with force_sensor("bota") as sensor:
        ready = time.monotonic()
        time.sleep(1.0)
        wanted = 1000 * (time.monotonic() - ready)
        while (frames := sensor.admin("state")["frames"]) < wanted:
            assert time.monotonic() < ready + 20
        assert frames <= 1000 * (time.monotonic() - began) + 1


def test_bota_catches_up_after_a_delay(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        first = reader.frames(10)[-1, 7]
        os.kill(bota.process.pid, signal.SIGSTOP)
        time.sleep(0.5)
        os.kill(bota.process.pid, signal.SIGCONT)
        frames = reader.frames(1000)
    assert frames[0, 7] == first + 1000
    assert np.all(np.diff(frames[:, 7]) == 1000)


def test_bota_clock_wraps(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        number = bota.admin("state")["frames"]
        bota.admin("clock", us=2**32 - 1000 * number - 500_000)
        times = reader.frames(1500)[:, 7].astype(np.int64)
        bota.admin("clock", us=0)
    times = times[np.argmax(times > 2**31) :]  # some were on their way
    assert times[0] > 2**31 > times[-1]
    assert times.max() < 2**32
    assert np.all(np.diff(times) % 2**32 == 1000)


def test_a_stall_is_a_gap_in_device_time(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        bota.admin("stall", on=True)
        before = reader.frames(10_000, patience=0.5)
        assert len(reader.frames(1, patience=0.4)) == 0
        number = bota.admin("stall", on=False)["frames"]
        after = reader.frames(100)
    assert np.all(np.diff(after[:, 7]) == 1000)
    assert after[0, 7] >= 1000 * (number - 100)
    assert len(before) == 0 or after[0, 7] - before[-1, 7] > 400_000


def test_overload_and_saturation(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        state = bota.admin("overload", force=[0.0, 100.0, 0.0, 0.0, 5.0, 0.0])
        reader.port.reset_input_buffer()
        frames = reader.frames(300)[200:]
        off = frames[:, 1:7].mean(axis=0) - expected(state)
        np.testing.assert_allclose(off, [0, 100, 0, 0, 5, 0], atol=0.5)
        assert np.all(frames[:, 0] == 0)
        bota.admin("overload", force=[0.0, 0.0, -5000.0, 0.0, 0.0, 0.0])
        frames = reader.frames(300)[200:]
        assert np.all(frames[:, 0] == OVER_RANGE)
        assert np.all(frames[:, 3] == -1200.0)
        bota.admin("overload", force=[0.0] * 6)
        bota.admin("saturate", on=True)
        assert np.all(reader.frames(300)[200:, 0] == OVER_RANGE)
        bota.admin("saturate", on=False)
        assert np.all(reader.frames(300)[200:, 0] == 0)


@pytest.mark.parametrize("fault", ["flip", "cut"])
def test_no_spoilt_frame_passes_its_checksum(bota: Instrument, fault: str) -> None:
    with Reader(bota, "bota") as reader:
        bota.admin(fault, probability=0.1)
        reader.port.reset_input_buffer()
        reader.frames(50)
        frames = reader.frames(1000)
        state = bota.admin(fault, probability=0.0)
    gaps = np.diff(frames[:, 7]) / 1000 - 1
    assert np.all(gaps == np.rint(gaps))
    assert np.all(gaps >= 0)
    lost, made = gaps.sum(), 999 + gaps.sum()
    # binomial, five standard deviations; a cut may take the next frame with it
    spread = 5 * np.sqrt(made * 0.1 * 0.9)
    assert abs(lost - 0.1 * made) < spread
    assert np.all(np.abs(frames[:, 1:7] - expected(state)) < 8 * np.array(state["noise"]) + 0.05)


def test_who_does_not_read_loses_frames_that_are_counted(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        reader.frames(10)
        before = bota.admin("state")["dropped"]
        deadline = time.monotonic() + 20
        while bota.admin("state")["dropped"] < before + 300:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        frames = reader.frames(2500)
        lost = bota.admin("state")["dropped"] - before
    gaps = np.diff(frames[:, 7]) / 1000 - 1
    assert gaps.sum() == lost
    assert reader.skipped < 37  # only whole frames are dropped


def test_a_new_client_gets_fresh_frames_only(bota: Instrument) -> None:
    time.sleep(0.5)
    number = bota.admin("state")["frames"]
    with Reader(bota, "bota") as reader:
        first = reader.frames(200)[50]
    assert first[7] >= 1000 * number


def test_bota_unplugged_and_plugged_in(bota: Instrument) -> None:
    with Reader(bota, "bota") as reader:
        reader.frames(10)
        bota.admin("unplug")
        reader.port.timeout = 10
        with pytest.raises(serial.SerialException):
            reader.port.read(10_000_000)
    assert not bota.port.exists()
    bota.admin("replug")
    with Reader(bota, "bota") as reader:
        assert len(reader.frames(100)) == 100


def test_at_the_wrong_rate_no_frame_is_sound(bota: Instrument) -> None:
    with Reader(bota, "bota", baud=115200) as reader:
        assert len(reader.frames(10, patience=0.3)) == 0
        assert reader.skipped > 100
    with Reader(bota, "bota") as reader:
        assert len(reader.frames(10)) == 10


def test_ft300_says_who_it_is_over_modbus(ft300: Instrument) -> None:
    with modbus(ft300) as client:
        assert client.read_string(500, 5) == "SIM-1.0.10"
        assert client.read_string(510, 4) == "F3004242"
        state = ft300.admin("state")
        words = np.array([client.read_registers(180, 6) for _ in range(20)], dtype=np.uint16)
        wrench = words.astype(np.int16) / np.repeat((100, 1000), 3)
        np.testing.assert_allclose(
            wrench.mean(axis=0), expected(state), atol=0.15 + 5 * DRIFT_STD.max() * 0.5
        )
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.read_register(600)
        with pytest.raises(minimalmodbus.IllegalRequestError):
            client.write_register(180, 1)
        client.address = 8
        with pytest.raises(minimalmodbus.NoResponseError):
            client.read_register(180)


def test_ft300_streams_on_request_until_told_to_stop(ft300: Instrument) -> None:
    with Reader(ft300, "ft300") as quiet:
        assert len(quiet.frames(1, patience=0.2)) == 0
    with streaming(ft300) as reader:
        frames = reader.frames(200)
        assert len(frames) == 200
        state = ft300.admin("state")
        assert state["streaming"] is True
        # rounding to 0.01 N and 0.001 N·m adds the variance of a uniform step
        std = np.sqrt(np.repeat((0.1, 0.005), 3) ** 2 + np.repeat((0.01, 0.001), 3) ** 2 / 12)
        assert_normal(frames, expected(state), std, state["temperature"] - ROOM)
        reader.port.write(b"\xff" * 49)
        assert len(reader.frames(50)) == 50
    assert ft300.admin("state")["streaming"] is False
    with modbus(ft300) as client:
        assert client.read_string(510, 4) == "F3004242"


def test_ft300_in_a_stream_answers_no_modbus(ft300: Instrument) -> None:
    with streaming(ft300) as reader:
        reader.frames(5)
        reader.port.close()
        with modbus(ft300) as client, pytest.raises(minimalmodbus.ModbusException):
            client.read_register(180)
        reader.port.open()


def test_ft300_byte_by_byte(ft300: Instrument) -> None:
    """Every frame that it sent arrives, between the answer to the start and the stop."""
    start = bytes.fromhex("09 10 01 9A 00 01 02 02 00")
    start += crc16_modbus(start).to_bytes(2, "little")
    before = ft300.admin("state")
    with Reader(ft300, "ft300") as reader:
        reader.port.write(start)
        answer = b""
        while len(answer) < 8:
            answer += reader.port.read(8 - len(answer))
        assert answer[:6] == start[:6]
        assert crc16_modbus(answer) == 0
        count = len(reader.frames(150))
        reader.port.write(b"\xff" * 50)
        count += len(reader.frames(10_000, patience=1.0))
        assert reader.skipped == 0
        assert reader.buffer == b""
    after = ft300.admin("state")
    assert count >= 150
    assert after["sent"] - before["sent"] == count + 1
    assert after["dropped"] == before["dropped"]


def test_ft300_clips_at_its_range(ft300: Instrument) -> None:
    with streaming(ft300) as reader:
        ft300.admin("overload", force=[1e6, -1e6, 0.0, 0.0, 0.0, 1e6])
        frames = reader.frames(100)[50:]
        ft300.admin("overload", force=[0.0] * 6)
    assert np.all(frames[:, [0, 1, 5]] == [300.0, -300.0, 30.0])


def test_hex_counts_its_frames() -> None:
    with force_sensor("hex", WRENCH, "--rate", "333") as sensor:
        with Reader(sensor, "hex") as reader:
            frames = reader.frames(300)
        state = sensor.admin("state")
    assert state["rate"] == 333
    assert np.all(np.diff(frames[:, 0]) % 65536 == 1)
    wrench = frames[:, 2:] / np.repeat((50, 2000), 3)
    kelvin = state["temperature"] - ROOM
    step = np.repeat((1 / 50, 1 / 2000), 3)
    std = np.sqrt(np.repeat((0.05, 0.001), 3) ** 2 + step**2 / 12)
    assert_normal(wrench, expected(state), std, kelvin)


def test_each_sensor_has_a_zero_of_its_own() -> None:
    biases = []
    for seed in (1, 1, 2):
        with force_sensor("ft300", seed=seed) as sensor:
            biases.append(sensor.admin("state")["bias"])
    assert biases[0] == biases[1] != biases[2]


def test_the_zero_drifts_as_the_sensor_warms_up() -> None:
    with force_sensor("bota", WRENCH, scale=2000.0) as sensor, Reader(sensor, "bota") as reader:
        frames = reader.frames(1500)  # 3000 s of the world
        state = sensor.admin("state")
    assert state["temperature"] - ROOM > 6.0
    assert np.all(np.diff(frames[:, 8]) >= 0)
    drift = np.abs(frames[-200:, 1:7].mean(axis=0) - expected(state))
    assert np.all(drift < 5 * DRIFT_STD * 7.0 + 0.03)
    assert np.any(drift > 0.1 * DRIFT_STD * 7.0 + 5 * np.array(state["noise"]) / np.sqrt(200))
