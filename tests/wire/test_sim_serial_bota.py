"""The simulated Bota sensor, read by pyserial."""

import os
import signal
import time
from collections.abc import Iterator

import numpy as np
import pytest
import serial

from drivers.simulated.force.bota import OVER_RANGE, crc16_x25
from drivers.simulated.force.gauge import DRIFT_STD, ROOM
from tests.support.sim_force_cases import WRENCH, Reader, assert_normal, expected
from tests.support.sim_serial_cases import Instrument, force_sensor


@pytest.fixture(scope="module")
def bota() -> Iterator[Instrument]:
    with force_sensor("bota", WRENCH) as sensor:
        yield sensor


def test_checksum_has_the_catalogue_value() -> None:
    assert crc16_x25(b"123456789") == 0x906E  # CRC RevEng catalogue, CRC-16/IBM-SDLC


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
def test_spoilt_frames_fail_their_checksum(bota: Instrument, fault: str) -> None:
    with Reader(bota, "bota") as reader:
        bota.admin(fault, probability=0.1)
        reader.port.reset_input_buffer()
        reader.frames(50)
        frames = reader.frames(1000)
        state = bota.admin(fault, probability=0.0)
    # what is left of a frame passes by chance once in 2^16: two of a hundred once in 10^6
    sound = (frames[:, 7] % 1000 == 0) & (np.abs(frames[:, 7] - np.median(frames[:, 7])) < 1e7)
    assert np.sum(~sound) < 2
    frames = frames[sound]
    gaps = np.diff(frames[:, 7]) / 1000 - 1
    assert np.all(gaps >= 0)
    lost, made = gaps.sum(), len(frames) - 1 + gaps.sum()
    assert abs(lost - 0.1 * made) < 5 * np.sqrt(made * 0.1 * 0.9)  # binomial
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
        reader.port.timeout = 10  # pyserial asks the terminal: while it is there
        bota.admin("unplug")
        with pytest.raises(serial.SerialException):
            reader.port.read(10_000_000)
    assert not bota.port.exists()
    bota.admin("replug")
    with Reader(bota, "bota") as reader:
        assert len(reader.frames(100)) == 100


def test_at_the_wrong_rate_no_frame_is_sound(bota: Instrument) -> None:
    with Reader(bota, "bota", baud=115200) as reader:
        assert len(reader.frames(10, patience=0.3)) < 2  # garbage passes once in 2^16
        assert reader.skipped > 100
    with Reader(bota, "bota") as reader:
        assert len(reader.frames(10)) == 10


def test_the_zero_drifts_as_the_sensor_warms_up() -> None:
    with (
        force_sensor("bota", WRENCH, "--on", "0", scale=2000.0) as sensor,
        Reader(sensor, "bota") as reader,
    ):
        frames = reader.frames(1500)  # 3000 s of the world
        state = sensor.admin("state")
    assert state["temperature"] - ROOM > 6.0
    assert np.all(np.diff(frames[:, 8]) >= 0)
    drift = np.abs(frames[-200:, 1:7].mean(axis=0) - expected(state))
    assert np.all(drift < 5 * DRIFT_STD * 7.0 + 0.03)
    assert np.any(drift > 0.1 * DRIFT_STD * 7.0 + 5 * np.array(state["noise"]) / np.sqrt(200))
