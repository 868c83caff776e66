"""Frames of force sensors out of damaged streams, and the count of what was lost."""

import math
import struct
import threading
import time
from contextlib import closing

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.drivers import bota, ft300, onrobot_hex
from hilcal.drivers.force_stream import ByArrival, ByDeviceClock, Deframer, ForceStream
from hilcal.errors import DeviceError

FORMATS = {
    "ft300": ft300.SENSOR.frame,
    "bota": bota.SENSOR.frame,
    "hex": onrobot_hex._sensor(50.0, 2000.0, 1000.0).frame,
}
ALL = pytest.mark.parametrize("kind", FORMATS)


def frames_of(kind, number, rng):
    """Bodies that tell their number, and whole frames."""
    spec = FORMATS[kind]
    room = spec.size - len(spec.header) - 2
    bodies = [struct.pack("<I", k) + rng.bytes(room - 4) for k in range(number)]
    whole = [spec.header + body for body in bodies]
    return bodies, [frame + spec.checksum(frame) for frame in whole]


def damaged(frames, rng, most_bits):
    """Frames after flips (1 to `most_bits` bits) and truncations; which of them are whole."""
    out, whole = [], []
    for frame in frames:
        data = bytearray(frame)
        if rng.random() < 0.02:
            for _ in range(rng.integers(1, most_bits + 1)):
                data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
        if rng.random() < 0.02:
            del data[int(rng.integers(1, len(data))) :]
        out.append(bytes(data))
        whole.append(bytes(data) == frame)
    return out, np.array(whole)


@ALL
@given(data=st.data())
def test_frames_come_whole_however_the_stream_is_cut_into_pieces(kind, data):
    bodies, frames = frames_of(kind, 12, np.random.default_rng(3))
    stream = b"".join(frames)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    deframer = Deframer(FORMATS[kind])
    collected = []
    for start, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        collected += deframer.push(stream[start:end])
    kept = (
        bodies if not FORMATS[kind].weak_checksum else bodies[:-1]
    )  # a sum waits for the next header
    assert collected == kept
    assert (deframer.frames, deframer.corrupt, deframer.skipped) == (len(kept), 0, 0)


@ALL
def test_a_stream_entered_in_the_middle_of_a_frame_has_lost_nothing(kind):
    bodies, frames = frames_of(kind, 20, np.random.default_rng(4))
    deframer = Deframer(FORMATS[kind])
    frames_read = deframer.push(FORMATS[kind].header + b"".join(frames)[5:])
    assert frames_read[0] == bodies[1]
    assert (deframer.corrupt, deframer.skipped) == (0, 0)


@ALL
@pytest.mark.parametrize("seed", range(3))
def test_no_wrong_frame_is_accepted_from_a_damaged_stream(kind, seed):
    rng = np.random.default_rng(seed)
    bodies, frames = frames_of(kind, 5_000, rng)
    weak = FORMATS[kind].weak_checksum  # two flips may cancel in a mere sum
    stream, whole = damaged(frames, rng, most_bits=1 if weak else 3)
    deframer = Deframer(FORMATS[kind])
    collected = []
    for frame in stream:
        collected += deframer.push(frame)
    numbers = [struct.unpack_from("<I", body)[0] for body in collected]
    assert all(
        0 <= k < len(bodies) and body == bodies[k]
        for k, body in zip(numbers, collected, strict=True)
    )
    assert numbers == sorted(set(numbers))
    # a damaged frame costs itself, and a whole one only between two damaged ones or, for the
    # mere sum, before one
    bad = int(np.sum(~whole))
    assert len(collected) >= len(frames) - (2.2 if weak else 1.2) * bad
    assert 0.8 * bad <= deframer.corrupt <= 1.3 * bad


@ALL
def test_noise_alone_gives_no_frame(kind):
    deframer = Deframer(FORMATS[kind])
    rng = np.random.default_rng(8)
    spec = FORMATS[kind]
    for _ in range(2000):  # headers among noise
        assert deframer.push(spec.header + rng.bytes(int(rng.integers(0, 60)))) == []


def test_a_frame_inside_a_frame_is_not_taken():
    """Out of step, a right checksum alone is not enough: a body may hold a whole frame."""
    spec = FORMATS["ft300"]
    _, (inner,) = frames_of("ft300", 1, np.random.default_rng(1))
    bodies, outer = frames_of("ft300", 3, np.random.default_rng(2))
    deframer = Deframer(spec)
    assert deframer.push(b"noise" + inner + b"noise" + b"".join(outer)) == bodies


def ticks_at(numbers, start=0):
    return [(start + 1000 * int(k)) % 2**32 for k in numbers]


@pytest.mark.parametrize("start", [0, 2**32 - 50_000])
def test_the_device_s_clock_counts_exactly_what_is_missing(start):
    rng = np.random.default_rng(5)
    numbers = np.flatnonzero(rng.random(2000) > 0.05)
    counter = ByDeviceClock(1e-6, 32)
    ticks = ticks_at(numbers, start=start)
    kept = [counter.follow(1, [tick], 0.0)[0] for tick in ticks]
    assert all(kept)
    assert counter.lost == numbers[-1] - numbers[0] + 1 - len(numbers)
    assert counter.rate == pytest.approx(1000.0)


def test_a_long_gap_is_counted_by_the_device_s_clock():
    counter = ByDeviceClock(1e-6, 32)
    counter.follow(100, ticks_at(range(100)), 0.0)
    counter.follow(100, ticks_at(range(10_100, 10_200)), 10.0)
    assert counter.lost == 10_000


def test_a_frame_with_an_impossible_time_is_left_out():
    counter = ByDeviceClock(1e-6, 32)
    ticks = ticks_at(range(100))
    ticks[50] = 3_123_456_789
    assert counter.follow(100, ticks, 0.0) == [k != 50 for k in range(100)]
    assert counter.lost == 1


def test_a_sensor_that_begins_to_count_anew_is_followed():
    counter = ByDeviceClock(1e-6, 32)
    counter.follow(100, ticks_at(range(100), start=3_000_000_000), 0.0)
    assert counter.follow(100, ticks_at(range(100)), 1.0) == [False] + [True] * 99


def arrivals(counter, times):
    """Give frames that arrived at times (s) as a reader that looks now and then finds them."""
    at = 0
    for now in np.arange(0.0, times[-1] + 0.005, 0.005):
        count = int(np.searchsorted(times, now, side="right")) - at
        if count:
            counter.follow(count, [], float(now))
            at += count


@pytest.mark.parametrize("rate", [99.5, 100.0, 100.5])
def test_by_arrival_a_whole_stream_loses_nothing_whatever_its_clock(rate):
    rng = np.random.default_rng(6)
    counter = ByArrival(100.0)
    times = np.arange(10_000) / rate + rng.uniform(0.0, 0.002, 10_000)
    arrivals(counter, times)
    assert counter.lost == 0


@pytest.mark.parametrize("rate", [99.5, 99.9, 100.0, 100.1, 100.5])
def test_by_arrival_missing_frames_are_counted(rate):
    rng = np.random.default_rng(7)
    times = np.arange(20_000) / rate + rng.uniform(0.0, 0.002, 20_000)
    missing = np.zeros(len(times), dtype=bool)
    missing[rng.choice(np.arange(1000, 19_000), 100)] = True
    missing[5000:5100] = True
    counter = ByArrival(100.0)
    arrivals(counter, times[~missing])
    assert counter.lost == pytest.approx(missing.sum(), abs=6)


def test_by_arrival_a_held_up_line_that_catches_up_slowly_has_lost_nothing():
    """100 ms of garbage at 19200 Bd; then each frame takes 8.3 ms on the wire."""
    rng = np.random.default_rng(9)
    born = np.arange(3000) / 100.0
    times, free = np.empty(3000), 0.0
    for k, start in enumerate(born):
        free = max(free, start + 0.104 * (k % 500 == 400)) + 16 * 10 / 19200
        times[k] = free
    counter = ByArrival(100.0)
    arrivals(counter, np.maximum.accumulate(times + rng.uniform(0.0, 0.002, 3000)))
    assert counter.lost == 0


def test_by_arrival_frames_that_were_held_up_are_not_lost():
    times = np.arange(3000) / 100.0
    times[1000:1030] = times[1030]  # the reader or the adapter slept for 0.3 s
    trickle = times.copy()
    trickle[2000:2030] = times[2030] + np.arange(30) * 0.006  # and then came one by one
    counter = ByArrival(100.0)
    arrivals(counter, np.maximum.accumulate(trickle))
    assert counter.lost == 0


class Held:
    """A port that holds some bytes."""

    port, baudrate = "nowhere", 460800

    def __init__(self, data):
        self.hold(data)

    def hold(self, data):
        self._data, self.in_waiting = data, len(data)

    def read(self, size):
        self.in_waiting = 0
        return self._data

    def close(self):
        pass


def test_frames_of_another_time_or_without_possible_values_are_not_stored():
    def sent(ms, force):
        body = struct.pack("<H6fIf", 0, force, 0, 0, 0, 0, 0, 1000 * ms, 25.0)
        return b"\xaa" + body + bota.SENSOR.frame.checksum(b"\xaa" + body)

    frames = [sent(k, 10.0) for k in range(100, 160)]
    strays = {20: sent(50, 500.0), 30: sent(99_000, 500.0), 40: sent(139, math.nan)}
    for k, frame in strays.items():
        frames[k] = frame
    with closing(ForceStream(Held(b"".join(frames)), bota.SENSOR)) as stream:
        count = stream.started().losses()
        assert (count.frames, count.corrupt) == (57, 3)
        assert stream.latest().wrench[0] == 10.0


def test_a_mean_of_too_few_frames_is_none():
    """Of a sensor of 1 kHz that has become slow: what is missing was perhaps not alike."""

    def sent(first, count):
        bodies = (
            struct.pack("<H6fIf", 0, *[0.1 * k] * 6, 1000 * k, 25.0)
            for k in range(first, first + count)
        )
        return b"".join(b"\xaa" + b + bota.SENSOR.frame.checksum(b"\xaa" + b) for b in bodies)

    port = Held(sent(0, 60))

    def trickle():
        for k in range(10):
            time.sleep(0.1)
            port.hold(sent(60 + 5 * k, 5))

    with closing(ForceStream(port, bota.SENSOR)) as stream:
        stream.started()
        feeder = threading.Thread(target=trickle)
        feeder.start()
        with pytest.raises(DeviceError, match=r"of 100 frames in 0\.1 s"):
            stream.average(0.1)
        feeder.join()


def test_a_hex_at_the_end_of_its_counts_is_over_its_range():
    sensor = onrobot_hex._sensor(50.0, 2000.0, 1000.0)
    full = 32767 * sensor.unit
    assert not sensor.overload(0.9 * full, 0)
    for k in range(6):
        assert "over its range" in sensor.overload(-full * np.eye(6)[k], 0)
