"""The simulated serial line, and the GeoCOM station on it, asked by geocompy and by hand."""

import contextlib
import itertools
import time

import numpy as np
import pytest
import serial
from geocompy.communication import SerialConnection
from geocompy.geo import GeoCom
from geocompy.geo.gctypes import GeoComCode
from scipy import stats

from hilcal.drivers.simulated.geocom_server import PolarPoint
from hilcal.drivers.simulated.pty_port import PtyPort
from tests.support.instruments import tracker
from tests.support.rows import first

BAUD = 115200


@pytest.fixture
def port(tmp_path):
    port = PtyPort(tmp_path / "line", BAUD, np.random.default_rng(3))
    yield port
    port.unplug()


@contextlib.contextmanager
def client(port, baud=BAUD, timeout=1.0):
    with serial.Serial(str(port.link), baud, timeout=timeout, exclusive=True) as line:
        port.pump()  # sees that the client has opened
        yield line


def received(port, line, count):
    data, end = b"", time.monotonic() + 20.0
    while len(data) < count and time.monotonic() < end:
        port.pump()
        data += line.read(min(count - len(data), 64))
    return data


def test_bytes_take_ten_bits_each(port):
    frames = 60
    with client(port) as line:
        start = time.monotonic()
        for _ in range(frames):
            port.send(b"x" * 100)
        port.pump()
        assert port.state()["waiting"] > 0  # the wire is slower than the sender
        port.drain()
        data = line.read(frames * 100)
        took = time.monotonic() - start
    assert data == b"x" * frames * 100
    assert took >= frames * 100 * 10 / BAUD


def test_a_full_line_drops_whole_frames_and_counts_them(port):
    frames, size = 2000, 50
    past = time.monotonic() - 100.0
    with client(port, timeout=0.1) as line:
        for k in range(frames):
            port.send(k.to_bytes(2, "big") * (size // 2), past)
        sent, dropped = port.state()["sent"], port.state()["dropped"]
        data = received(port, line, sent * size)
        port.send(b"last")
        assert received(port, line, 4) == b"last"
    assert 0 < dropped < frames
    assert sent + dropped == frames
    # The kernel takes bytes on when it likes, so that one may fit after others were dropped.
    whole = [data[at : at + size] for at in range(0, len(data), size)]
    numbers = [int.from_bytes(frame[:2], "big") for frame in whole]
    assert len(numbers) == sent
    assert all(a < b for a, b in itertools.pairwise(numbers))
    assert whole == [k.to_bytes(2, "big") * (size // 2) for k in numbers]


TARGET = (0.5, 2.8, 0.4)
DISTANCE = float(np.linalg.norm(TARGET))
FAR_FROM_NOISE = 1e-3  # m: some hundred standard deviations


@pytest.fixture(scope="module")
def shared():
    with tracker(TARGET) as station:
        yield station


@pytest.fixture
def station(shared):
    """The module's station with every fault switched off."""
    shared.truth(target=np.array(TARGET))
    for op in ("beam", "dist_error", "busy", "mute"):
        shared.admin(op, on=False)
    shared.admin("warn", code=0)
    shared.admin("meas_s", seconds=0.3)
    for op in ("flip", "cut"):
        shared.admin(op, probability=0.0)
    shared.admin("baud", baud=115200)
    shared.admin("replug")
    with Line(shared) as line:
        line.ask(9020, "1")
        line.ask(9013)
    return shared


class Line:
    """A client of its own, byte by byte."""

    def __init__(self, station, baud=115200, timeout=5.0):
        self.port = serial.Serial(str(station.port), baud, timeout=timeout, exclusive=True)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.port.close()

    def tell(self, text):
        self.port.write(text.encode() + b"\r\n")
        return self.port.read_until(b"\r\n").decode().removesuffix("\r\n")

    def ask(self, rpc, *parameters):
        answer = self.tell(f"%R1Q,{rpc},7:{','.join(parameters)}")
        head, body = answer.split(":")
        assert head == "%R1P,0,7"
        return body.split(",")

    def point(self):
        code, *values = self.ask(17017, "2")
        return int(code), cartesian(*map(float, values[:3]))


def cartesian(hz, v, distance):
    return distance * np.array([np.sin(v) * np.sin(hz), np.sin(v) * np.cos(hz), np.cos(v)])


@contextlib.contextmanager
def geocom(station):
    port = serial.Serial(str(station.port), 115200, timeout=5.0, exclusive=True)
    with SerialConnection(port) as connection:
        yield GeoCom(connection, checksum=True)


def test_geocompy_reads_who_it_is(station):
    with geocom(station) as device:
        assert device.csv.get_instrument_name().params == "SIM LASER STATION"
        assert device.csv.get_serial_number().params == 123456
        assert device.csv.get_firmware_version().params == (6, 20, 0)
        assert device.com.get_geocom_version().params == (1, 50, 0)
        assert device.csv.get_datetime().params is not None
        assert 0 < device.csv.get_internal_temperature().params < 60
        assert device.aut.get_lock_status().params is True
        assert device.aut.switch_atr(True).error == GeoComCode.OK
        assert device.tmc.get_atmospheric_corrections().params == pytest.approx(
            (658e-9, 1013.25, 20.0, 20.0), abs=1e-12
        )
        assert device.tmc.set_atmospheric_corrections(1e-6, 950.0, 31.0, 21.0).error == 0
        assert device.tmc.get_atmospheric_corrections().params == (1e-6, 950.0, 31.0, 21.0)
        assert device.com.set_double_precision(4).error == 0
        assert device.com.get_double_precision().params == 4
        assert device.com.set_double_precision(15).error == 0
        assert device.abort().error == 0


def test_geocompy_reads_where_the_target_is(station):
    with geocom(station) as device:
        answer = device.bap.measure_distance_angle()
        assert answer.error == GeoComCode.OK
        hz, v, distance, _ = answer.params
        np.testing.assert_allclose(cartesian(float(hz), float(v), distance), TARGET, atol=1e-3)
        assert device.tmc.do_measurement().error == GeoComCode.OK
        full = device.tmc.get_complete_measurement()
        assert full.error == GeoComCode.OK
        hz, v, accuracy, cross, length, _, distance, at_ms = full.params
        np.testing.assert_allclose(cartesian(float(hz), float(v), distance), TARGET, atol=1e-3)
        assert float(accuracy) == pytest.approx((7.5e-6 + 3e-6 * DISTANCE) / DISTANCE, rel=1e-3)
        assert abs(float(cross)) + abs(float(length)) < 1e-4
        assert 0 < at_ms <= station.board.time * 1e3
        simple = device.tmc.get_simple_measurement()
        assert simple.params[2] == distance  # of the same distance measurement
        angles = device.tmc.get_angle().params
        assert float(angles[0]) == pytest.approx(float(hz), abs=1e-4)


@pytest.mark.parametrize(
    ("target", "scale"), first(1, [((-8.0, 9.0, -6.0), 200.0), ((0.4, 0.6, 1.3), 200.0)])
)
def test_noise_is_as_specified_and_fresh(target, scale):
    """The whitened errors of 250 measurements have unit variance in each direction."""
    count = 250
    d = float(np.linalg.norm(target))
    along, across = 20e-6 + 10e-6 * d, 50e-6 + 30e-6 * d
    options = ("--range-std", "20e-6", "10e-6", "--transverse-std", "50e-6", "30e-6")
    options += ("--baud", "1000000")
    with tracker(target, *options, scale=scale) as station, Line(station, 1_000_000) as line:
        points = np.array([line.point()[1] for _ in range(count)])
    sight = np.array(target) / d
    left = np.array([-sight[1], sight[0], 0.0]) / np.hypot(sight[0], sight[1])
    axes = np.array([sight, left, np.cross(sight, left)])
    error = (points - np.array(target)) @ axes.T / np.array([along, across, across])
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], count)
    assert np.all((low < (error**2).sum(axis=0)) & ((error**2).sum(axis=0) < high))
    assert np.all(np.abs(error.mean(axis=0)) < 5 / np.sqrt(count))
    together = [
        *np.mean(error[1:] * error[:-1], axis=0),  # one after the other
        *(np.mean(error[:, i] * error[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))),
    ]
    assert np.all(np.abs(together) < 5 / np.sqrt(count))


def test_reads_the_target_of_the_moment_when_it_has_measured(station):
    station.admin("meas_s", seconds=20.0)  # a second of real time
    with Line(station) as line:
        start = time.monotonic()
        assert line.ask(2008, "1", "1") == ["0"]
        station.truth(target=2 * np.array(TARGET))
        code, *values = line.ask(2108, "60000", "1")
        assert time.monotonic() - start >= 1.0
        assert code == "0"
        assert float(values[2]) == pytest.approx(2 * DISTANCE, abs=FAR_FROM_NOISE)
        # the distance stays the old one until the next measurement, the angles do not
        station.truth(target=np.array([-0.1, -0.1, 0.9]))
        code, _, v, distance = line.ask(2108, "60000", "1")
        assert (code, float(distance)) == ("0", float(values[2]))
        assert float(v) == pytest.approx(PolarPoint.of(np.array([-0.1, -0.1, 0.9])).v, abs=1e-3)
