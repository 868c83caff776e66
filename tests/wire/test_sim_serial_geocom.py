"""The simulated GeoCOM station, asked by geocompy and by hand."""

import contextlib
import time
from collections.abc import Iterator

import numpy as np
import pytest
import serial
from geocompy.communication import SerialConnection
from geocompy.geo import GeoCom
from geocompy.geo.gctypes import GeoComCode
from scipy import stats

from drivers.simulated.geocom.optics import Beam, PolarPoint
from drivers.simulated.geocom.protocol import crc16_arc
from tests.support.sim_serial_cases import Instrument, tracker

TARGET = (0.5, 2.8, 0.4)
DISTANCE = float(np.linalg.norm(TARGET))
FAR_FROM_NOISE = 1e-3  # m: some hundred standard deviations


@pytest.fixture(scope="module")
def shared() -> Iterator[Instrument]:
    with tracker(TARGET) as station:
        yield station


@pytest.fixture
def station(shared: Instrument) -> Instrument:
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

    def __init__(self, station: Instrument, baud: int = 115200, timeout: float = 5.0) -> None:
        self.port = serial.Serial(str(station.port), baud, timeout=timeout, exclusive=True)

    def __enter__(self) -> "Line":
        return self

    def __exit__(self, *_: object) -> None:
        self.port.close()

    def tell(self, text: str) -> str:
        self.port.write(text.encode() + b"\r\n")
        return self.port.read_until(b"\r\n").decode().removesuffix("\r\n")

    def ask(self, rpc: int, *parameters: str) -> list[str]:
        answer = self.tell(f"%R1Q,{rpc},7:{','.join(parameters)}")
        head, body = answer.split(":")
        assert head == "%R1P,0,7"
        return body.split(",")

    def point(self) -> tuple[int, np.ndarray]:
        code, *values = self.ask(17017, "2")
        return int(code), cartesian(*map(float, values[:3]))


def cartesian(hz: float, v: float, distance: float) -> np.ndarray:
    return distance * np.array([np.sin(v) * np.sin(hz), np.sin(v) * np.cos(hz), np.cos(v)])


@contextlib.contextmanager
def geocom(station: Instrument, timeout: float = 5.0) -> Iterator[GeoCom]:
    port = serial.Serial(str(station.port), 115200, timeout=timeout, exclusive=True)
    with SerialConnection(port) as connection:
        yield GeoCom(connection, checksum=True)


def test_checksum_has_the_catalogue_value() -> None:
    assert crc16_arc(b"123456789") == 0xBB3D  # CRC RevEng catalogue, CRC-16/ARC


def test_geocompy_reads_who_it_is(station: Instrument) -> None:
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


def test_geocompy_reads_where_the_target_is(station: Instrument) -> None:
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


def test_a_bare_request_gets_a_bare_answer(station: Instrument) -> None:
    with Line(station) as line:
        assert line.tell("%R1Q,0,42:") == "%R1P,0,42:0"
        assert line.tell("%R1Q,0:") == "%R1P,0,0:0"


def test_a_checked_request_gets_a_checked_answer(station: Instrument) -> None:
    with Line(station) as line:
        crc = crc16_arc(b"%R1Q,5003,9:")
        body = crc16_arc(b"%R1P,0,9:0,123456")
        assert line.tell(f"%R1Q,5003,9,{crc}:") == f"%R1P,0,9,{body}:0,123456"
        wrong = line.tell(f"%R1Q,5003,9,{crc ^ 1}:")
        assert wrong.startswith("%R1P,3101,9,")


def test_refuses_what_it_cannot_do(station: Instrument) -> None:
    with Line(station) as line:
        assert line.tell("%R1Q,4711,1:") == "%R1P,0,1:3081"
        assert line.tell("%R1Q,none:") == "%R1P,3080,0:0"
        assert line.tell("%R1Q,17017,1:two") == "%R1P,0,1:2"
        assert line.tell("%R1Q,9027,1:1.0") == "%R1P,0,1:2"
        assert line.tell("hello\r\n\r\n%R1Q,0,3:") == "%R1P,0,3:0"


@pytest.mark.parametrize(
    ("target", "scale"), [((0.4, 0.6, 1.3), 200.0), ((-8.0, 9.0, -6.0), 200.0)]
)
def test_noise_is_as_specified_and_fresh(target: tuple[float, float, float], scale: float) -> None:
    """The whitened errors of 250 measurements have unit variance in each direction."""
    count = 250
    d = float(np.linalg.norm(target))
    along, across = 20e-6 + 10e-6 * d, 50e-6 + 30e-6 * d
    options = ("--range-std", "20e-6", "10e-6", "--transverse-std", "50e-6", "30e-6")
    options += ("--baud", "1000000")
    with tracker(target, *options, scale=scale) as station, Line(station, 1_000_000) as line:
        seen = np.array([line.point()[1] for _ in range(count)])
    sight = np.array(target) / d
    left = np.array([-sight[1], sight[0], 0.0]) / np.hypot(sight[0], sight[1])
    axes = np.array([sight, left, np.cross(sight, left)])
    error = (seen - np.array(target)) @ axes.T / np.array([along, across, across])
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], count)
    assert np.all((low < (error**2).sum(axis=0)) & ((error**2).sum(axis=0) < high))
    assert np.all(np.abs(error.mean(axis=0)) < 5 / np.sqrt(count))
    together = [
        *np.mean(error[1:] * error[:-1], axis=0),  # one after the other
        *(np.mean(error[:, i] * error[:, j]) for i, j in ((0, 1), (0, 2), (1, 2))),
    ]
    assert np.all(np.abs(together) < 5 / np.sqrt(count))


def test_angles_alone_are_as_noisy(station: Instrument) -> None:
    count = 150
    with Line(station) as line:
        angles = np.array([[float(x) for x in line.ask(2107, "1")[1:]] for _ in range(count)])
    true = PolarPoint.of(np.array(TARGET))
    std = (7.5e-6 + 3e-6 * DISTANCE) / DISTANCE
    error = (angles - [true.hz, true.v]) / [std / np.sin(true.v), std]
    low, high = stats.chi2.ppf([1e-6, 1 - 1e-6], count)
    assert np.all((low < (error**2).sum(axis=0)) & ((error**2).sum(axis=0) < high))


@pytest.mark.parametrize("point", [(0.0, 0.0, 2.0), (0.0, 0.0, -2.0), (1e-9, 0.0, 2.0)])
def test_straight_above_and_below(point: tuple[float, float, float]) -> None:
    beam, rng = Beam((0.0, 0.0), (1e-4, 0.0)), np.random.default_rng(1)
    for _ in range(100):
        seen = beam.observe(PolarPoint.of(np.array(point)), rng)
        assert 0.0 <= seen.hz < 2 * np.pi
        assert 0.0 <= seen.v <= np.pi
        np.testing.assert_allclose(cartesian(seen.hz, seen.v, seen.distance), point, atol=2e-3)


def test_same_seed_same_reading() -> None:
    points = []
    for seed in (5, 5, 6):
        with tracker(TARGET, scale=100.0, seed=seed) as station, Line(station) as line:
            points.append(line.ask(17017, "2"))
    assert points[0] == points[1] != points[2]


def test_keeps_its_lock_when_the_target_jumps(station: Instrument) -> None:
    with Line(station) as line:
        for target in ((1.0, -2.0, 0.5), (-3.0, 0.1, -1.0), TARGET):
            station.truth(target=np.array(target))
            assert line.ask(6021) == ["0", "1"]
            code, point = line.point()
            assert code == 0
            np.testing.assert_allclose(point, target, atol=FAR_FROM_NOISE)


def test_reads_the_target_of_the_moment_when_it_has_measured(station: Instrument) -> None:
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


def test_does_not_wait_longer_than_asked(station: Instrument) -> None:
    station.admin("meas_s", seconds=1e6)
    with Line(station) as line:
        line.ask(2008, "1", "1")
        code, *_, distance = line.ask(2108, "100", "1")
        assert (code, float(distance)) == ("1285", 0.0)


def test_a_broken_beam_gives_angles_and_a_distance_of_zero(station: Instrument) -> None:
    with Line(station) as line:
        station.admin("beam", on=True)
        code, hz, _, distance, mode = line.ask(17017, "2")
        assert (code, float(distance), mode) == ("1285", 0.0, "2")
        assert 0 <= float(hz) < 2 * np.pi
        line.ask(2008, "1", "1")
        code, *values = line.ask(2167, "5000", "1")
        assert (code, len(values), float(values[6])) == ("1285", 8, 0.0)
        assert line.ask(6021) == ["0", "2"]
        station.admin("beam", on=False)
        assert line.point()[0] == 0  # it waited for the target
        station.admin("beam", on=True)
        assert line.ask(17020, "0") == ["8710"]
        assert line.ask(9021) == ["0", "0"]
        station.admin("beam", on=False)
        assert line.ask(17017, "2") == ["8710"]
        assert line.ask(9013) == ["0"]
        assert line.point()[0] == 0


@pytest.mark.parametrize(
    "find", [("9013",), ("17020", "0"), ("9037", "0.05", "0.05", "0"), ("9027", "1", "1", "0", "1")]
)
def test_a_lost_lock_stays_lost_until_found(station: Instrument, find: tuple[str, ...]) -> None:
    with Line(station) as line:
        station.admin("lock_lost")
        assert line.ask(17017, "2") == ["8710"]
        assert line.ask(9021) == ["0", "0"]
        assert line.ask(6021) == ["0", "0"]
        line.ask(2008, "1", "1")
        code, *_, distance = line.ask(2108, "5000", "1")
        assert (code, float(distance)) == ("1285", 0.0)
        assert line.ask(int(find[0]), *find[1:]) == ["0"]
        assert line.ask(9021) == ["0", "1"]
        assert line.point()[0] == 0


def test_turning_away_loses_the_target(station: Instrument) -> None:
    with Line(station) as line:
        assert line.ask(9027, "3.0", "1.5", "0", "0", "0") == ["0"]
        assert line.ask(9021) == ["0", "0"]
        assert [float(x) for x in line.ask(2107, "1")[1:]] == [3.0, 1.5]
        assert line.ask(9020, "0") == ["0"]
        assert line.ask(9013) == ["8714"]


def test_an_unwritten_world_has_no_target() -> None:
    with tracker(None) as station, Line(station) as line:
        assert line.ask(17017, "2")[0] == "1285"
        assert line.ask(17020, "0") == ["8710"]
        assert line.ask(17017, "2") == ["8710"]
        station.truth(target=np.array(TARGET))
        assert line.ask(9013) == ["0"]
        assert line.point()[0] == 0


def test_what_it_says_when_measuring_fails(station: Instrument) -> None:
    with Line(station) as line:
        station.admin("dist_error", on=True)
        assert line.ask(17017, "2") == ["1292"]
        line.ask(2008, "1", "1")
        assert line.ask(2167, "5000", "1") == ["1292"]
        station.admin("dist_error", on=False)
        station.admin("busy", on=True)
        assert line.ask(17017, "2") == ["1293"]
        assert line.ask(2107, "1") == ["1293"]
        station.admin("busy", on=False)
        for code in (1283, 1284):
            station.admin("warn", code=code)
            got, point = line.point()
            assert got == code
            np.testing.assert_allclose(point, TARGET, atol=FAR_FROM_NOISE)


def test_answers_are_off_by_one_after_a_late_one(station: Instrument) -> None:
    with geocom(station, timeout=0.3) as device:
        station.admin("delay", rpc=5003, seconds=0.8)
        assert device.csv.get_serial_number().error == GeoComCode.COM_TIMEDOUT
        time.sleep(0.8)
        assert device.csv.get_serial_number().error == GeoComCode.COM_TR_ID_MISMATCH
        time.sleep(0.2)
        device._conn.reset()
        assert device.csv.get_serial_number().params == 123456


def test_a_wrong_transaction_number(station: Instrument) -> None:
    with geocom(station) as device:
        station.admin("wrong_trid")
        assert device.com.nullprocess().error == GeoComCode.COM_TR_ID_MISMATCH
        assert device.com.nullprocess().error == GeoComCode.OK


def test_a_spoilt_answer_never_passes_its_checksum(station: Instrument) -> None:
    crc = crc16_arc(b"%R1Q,5003,1:")
    station.admin("flip", probability=1.0)
    with Line(station, timeout=0.03) as line:
        for _ in range(40):
            line.port.write(f"%R1Q,5003,1,{crc}:\r\n".encode())
            data = b""
            while part := line.port.read(200):
                data += part
            head, _, body = data.partition(b":")
            com = head.split(b",")
            if data.endswith(b"\r\n") and len(com) == 4 and com[3].isdigit() and body:
                bare = b",".join(com[:3]) + b":" + body[:-2]
                assert int(com[3]) != crc16_arc(bare)


def test_remembers_what_it_was_asked(station: Instrument) -> None:
    with Line(station) as line:
        line.ask(2107, "1")
        line.ask(17020, "0")
    assert station.admin("log")[-2:] == [[2107, "1"], [17020, "0"]]
    assert station.admin("state")["locked"] is True


def test_plugged_in_again_it_goes_on(station: Instrument) -> None:
    with Line(station) as line:
        station.admin("unplug")
        assert not station.port.exists()
        with pytest.raises(serial.SerialException):
            line.port.read(1)
    station.admin("replug")
    with Line(station) as line:
        assert line.point()[0] == 0


def test_at_the_wrong_rate_nobody_understands(station: Instrument) -> None:
    with Line(station, 9600, timeout=0.3) as line:
        line.port.write(b"%R1Q,5003,1:\r\n")
        assert b"123456" not in line.port.read(200)
    with Line(station) as line:
        line.port.write(b"\n")  # ends the garbage that the station has heard
        assert line.ask(5003) == ["0", "123456"]
    station.admin("baud", baud=9600)
    with Line(station, 9600) as line:
        line.port.write(b"\n")
        assert line.ask(5003) == ["0", "123456"]
