"""The GeoCOM driver against a simulated station: readings, reports, and what goes wrong."""

import time

import numpy as np
import pytest

from hilcal.drivers.geocom import (
    ANSWER_S,
    DEADLINE_S,
    GeoComOptions,
    GeoComTracker,
    Link,
    open_tracker,
)
from hilcal.errors import DeviceError
from hilcal.measuring.devices import Clock, TargetLostError
from tests.support import instruments as simulated
from tests.support.geocom_cases import GREETING, cell, line, table_instrument

TARGET = (0.5, 2.8, 0.4)
MUTE_S = DEADLINE_S + ANSWER_S + 1.0


@pytest.fixture(scope="module")
def station_and_tracker():
    with simulated.tracker(TARGET) as station:
        device = open_tracker(cell(station.port))
        yield station, device
        device.close()


@pytest.fixture
def station(station_and_tracker):
    """The station, healthy again after the test."""
    station, _ = station_and_tracker
    yield station
    for op in ("beam", "dist_error", "busy", "mute"):
        station.admin(op, on=False)
    station.admin("warn", code=0)
    station.admin("flip", probability=0.0)
    station.admin("cut", probability=0.0)
    station_and_tracker[1].find_target()


@pytest.fixture
def device(station_and_tracker, station):
    return station_and_tracker[1]


def seconds_of(error, call):
    begin = time.monotonic()
    with pytest.raises(error) as caught:
        call()
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("tracker")
    return time.monotonic() - begin, text


# readings


def test_reading_is_the_target_with_the_covariance_it_has(device):
    samples = [device.measure() for _ in range(40)]
    covariance = samples[0].covariance
    off = np.array([sample.value for sample in samples]) - TARGET
    squares = np.einsum("ki,ij,kj->k", off, np.linalg.inv(covariance), off)
    # chi² with 120 degrees of freedom: within 1e-6 on either side
    assert 60 < squares.sum() < 205
    beam = np.array(TARGET) / np.linalg.norm(TARGET)
    distance = np.linalg.norm(TARGET)
    assert beam @ covariance @ beam == pytest.approx((5e-6 + 0.15e-6 * distance) ** 2, rel=1e-3)
    across = np.trace(covariance) - beam @ covariance @ beam
    assert across == pytest.approx(2 * (7.5e-6 + 3e-6 * distance) ** 2, rel=1e-3)


@pytest.mark.parametrize("code", [1283, 1284])
def test_reading_with_a_remark_is_used_and_says_so(device, station, code):
    station.admin("warn", code=code)
    sample = device.measure()
    assert str(code) in sample.warning
    assert sample.value == pytest.approx(TARGET, abs=1e-3)


# the target


def test_lost_lock_is_found_again(device, station):
    station.admin("lock_lost")
    with pytest.raises(TargetLostError):
        device.measure()
    device.find_target()
    assert station.admin("state")["locked"]
    assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


def test_target_that_is_not_there_is_not_found(device, station):
    station.admin("beam", on=True)
    station.admin("lock_lost")
    assert "no target" in seconds_of(TargetLostError, device.find_target)[1]


def test_implausible_distance_is_no_reading(device, station):
    station.truth(target=np.array([150.0, 0.0, 0.0]))
    text = seconds_of(TargetLostError, device.measure)[1]
    station.truth(target=np.array(TARGET))
    assert "150 m" in text


# what it says of itself


def test_report_of_a_healthy_station(device):
    report = device.report()
    facts = dict(report.facts)
    assert report.device == "tracker"
    assert "SIM LASER STATION" in report.name
    assert "123456" in report.name
    assert report.problems == ()
    assert facts["firmware"] == "6.20.0"
    assert facts["lock"] == "on the target"
    assert facts["face"] == "first"
    assert facts["battery"] == "100 %"
    assert "2.872" in facts["target"]
    assert facts["atmosphere set"].startswith("1013.2")
    assert "mrad" in facts["inclination"]


def test_report_turns_nothing(device, station):
    before = len(station.admin("log"))
    device.report()
    asked = {int(request[0]) for request in station.admin("log")[before:]}
    assert not asked & {9013, 9027, 9037, 17020}


# the line


def test_late_answer_is_never_taken_for_the_next_one(device, station):
    for rpc in (2008, 2167):
        station.admin("delay", rpc=rpc, seconds=1.3)
        begin = time.monotonic()
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)
        assert time.monotonic() - begin > ANSWER_S
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


def test_answer_to_another_transaction_is_refused_and_asked_for_again(device, station):
    station.admin("wrong_trid", count=2)
    assert device.measure().value == pytest.approx(TARGET, abs=1e-3)
    station.admin("wrong_trid", count=30)
    assert "out of step" in seconds_of(DeviceError, device.measure)[1]
    station.admin("wrong_trid", count=0)


def test_busy_instrument_is_asked_again_and_given_up_in_time(device, station):
    station.admin("busy", on=True)
    seconds, text = seconds_of(DeviceError, device.measure)
    assert "still busy measuring (code 1293)" in text
    assert seconds < MUTE_S
    station.admin("busy", on=False)
    device.measure()


def test_half_a_reply_is_not_a_reading(device, station):
    station.admin("half_frame")
    assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


@pytest.mark.long
def test_mute_instrument_is_given_up_in_time_and_heard_again(device, station):
    station.admin("mute", on=True)
    seconds, text = seconds_of(DeviceError, device.measure)
    assert seconds < MUTE_S
    assert "switched on" in text
    seconds, _ = seconds_of(DeviceError, device.find_target)
    assert seconds < MUTE_S
    station.admin("mute", on=False)
    assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


OPEN_S = 6.0  # 5 s are promised; the machine may be busy
HZ, V, D = 0.3, 1.4, 3.0
POINT = D * np.array([np.sin(V) * np.sin(HZ), np.sin(V) * np.cos(HZ), np.cos(V)])
FULL = f"0,{HZ},{V},1e-6,1e-5,2e-5,1e-6,{D},"


@pytest.fixture(scope="module")
def instrument():
    """An instrument of a table that tests change, and a link to it (opening takes a second)."""
    table = {}
    with table_instrument(table) as (port, asked):
        link = Link(port, 115200)
        yield table, asked, link
        link.close()


@pytest.fixture
def opened(instrument):
    """Return a driver on an instrument of a table, and the list of what it is asked."""
    table, asked, link = instrument

    def start(answers, **tracker):
        table.clear()
        table.update(answers)
        asked.clear()
        config = cell("unused", **tracker)
        return GeoComTracker(link, config.tracker, GeoComOptions(), Clock(20.0)), asked

    return start


def refused(error, config):
    """One line, in time."""
    begin = time.monotonic()
    with pytest.raises(error) as caught:
        open_tracker(config)
    assert time.monotonic() - begin < OPEN_S
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_port_that_is_not_there(tmp_path):
    assert "no port" in refused(DeviceError, cell(tmp_path / "absent"))


# opening


@pytest.mark.long
def test_mute_instrument_and_wrong_rate_say_what_to_check():
    with simulated.tracker() as station:
        text = refused(DeviceError, cell(station.port, baud=57600))
        assert "57600 Bd" in text
        station.admin("mute", on=True)
        text = refused(DeviceError, cell(station.port))
        assert "115200 Bd" in text
        assert "switched on" in text
        station.admin("mute", on=False)
        open_tracker(cell(station.port)).close()


def test_force_sensor_at_the_port_is_no_instrument():
    with simulated.force_sensor("bota") as sensor:
        text = refused(DeviceError, cell(sensor.port, baud=460800))
    assert "without a request" in text


def test_other_instrument_that_answers_something_else():
    with table_instrument({0: lambda *_: b"*11....+00000000\r\n"}) as (port, _):
        assert "are not GeoCOM" in refused(DeviceError, cell(port))


def test_replies_without_checksum_are_refused():
    table = {
        n: lambda t, _, body=body: f"%R1P,0,{t}:{body}\r\n".encode() for n, body in GREETING.items()
    }
    table[2167] = lambda t, _: f"%R1P,0,{t}:{FULL}4000\r\n".encode()
    with table_instrument(table) as (port, _):
        device = open_tracker(cell(port))
        with pytest.raises(DeviceError, match="without checksum"):
            device.measure()
        device.close()


# the line breaks


def test_unplugged_adapter_is_named_and_a_new_opening_works():
    with simulated.tracker() as station:
        device = open_tracker(cell(station.port))
        device.measure()
        station.admin("unplug")
        for call in (device.measure, device.find_target, device.report, device.measure):
            begin = time.monotonic()
            with pytest.raises(DeviceError, match="unplugged") as caught:
                call()
            assert not isinstance(caught.value, TargetLostError)
            assert time.monotonic() - begin < 1.0
        station.admin("replug")
        with pytest.raises(DeviceError):
            device.measure()
        device.close()
        device.close()
        again = open_tracker(cell(station.port))
        again.measure()
        again.close()


# odd instruments


def test_second_face_gives_the_same_point(opened):
    turned = f"0,{HZ + np.pi},{2 * np.pi - V},1e-6,0,0,0,{D},77"
    device, _ = opened({2167: turned})
    assert device.measure().value == pytest.approx(POINT, abs=1e-14)


def test_covariance_is_that_of_the_angles_and_the_distance(opened):
    """Against numerical derivatives of the point and the law of the angles' errors."""
    std = 40e-6
    device, _ = opened({2167: f"0,{HZ},{V},{std},0,0,0,{D},77"}, range_std_m=3e-5)
    covariance = device.measure().covariance

    def point(x):
        return x[2] * np.array(
            [np.sin(x[1]) * np.sin(x[0]), np.sin(x[1]) * np.cos(x[0]), np.cos(x[1])]
        )

    at, step = np.array([HZ, V, D]), 1e-6
    jac = np.array([(point(at + d) - point(at - d)) / (2 * step) for d in step * np.eye(3)]).T
    spread = np.diag([(std / np.sin(V)) ** 2, std**2, (3e-5 + 0.15e-6 * D) ** 2])
    assert covariance == pytest.approx(jac @ spread @ jac.T, rel=1e-6, abs=1e-18)


def test_older_instrument_without_full_measurement(opened):
    device, asked = opened({17017: f"0,{HZ},{V},{D},2"})
    for _ in range(2):
        sample = device.measure()
        assert sample.value == pytest.approx(POINT, abs=1e-15)
    assert asked.count(2167) == 1
    assert asked.count(17017) == 2


def test_report_without_what_the_instrument_does_not_know(opened):
    device, _ = opened({17017: f"0,{HZ},{V},{D},2", 9021: "5"})
    report = device.report()
    assert report.name == "TABLE, serial 77"
    assert report.problems == ()
    assert "battery" not in dict(report.facts)


def test_report_names_every_problem_at_once(opened):
    device, _ = opened({2167: f"1285,{NO_DISTANCE}", 5039: "0,4,2,2", 9021: "0,0"})
    problems = " / ".join(device.report().problems)
    assert "4 %" in problems
    assert "not locked" in problems
    assert "no distance" in problems


NO_DISTANCE = f"{HZ},{V},1e-6,0,0,0,0.0,0"
NO_TARGET = (1285, 1288, 1289, 1292, 1294, 8710, 8711, 8725)
BROKEN = ((1291, "atmospheric"), (1290, "level"), (99999, "99999"))
ODD = (
    f"0,{HZ},{V},1e-6,0,0,0,nan,77",
    f"0,inf,{V},1e-6,0,0,0,{D},77",
    f"0,{HZ},{V},1e-6,0,0,0,{D}",
    f"0,{HZ},{V},1e-6,0,0,0,{D},77,1",
    f"0,{HZ},{V},1e-6,0,0,0,three,77",
    "0",
)


@pytest.mark.parametrize(
    ("body", "lost", "words"),
    [
        *((f"{code},{NO_DISTANCE}", True, str(code)) for code in NO_TARGET),
        *((f"{code},{NO_DISTANCE}", True, r"0\.0 m") for code in (0, 1283, 1284)),
        *((f"{code},{NO_DISTANCE}", False, words) for code, words in BROKEN),
        *((body, False, "measuring: the instrument gives") for body in ODD),
    ],
)
def test_what_is_no_reading_is_a_lost_target_or_a_failure(opened, body, lost, words):
    device, _ = opened({2167: body})
    with pytest.raises(DeviceError, match=words) as caught:
        device.measure()
    assert isinstance(caught.value, TargetLostError) is lost


def test_distance_of_the_measurement_before_is_no_new_reading(opened):
    device, _ = opened({2167: f"{FULL}77"})
    device.measure()
    with pytest.raises(DeviceError, match="instead of a new one"):
        device.measure()


def test_no_damaged_reply_gives_a_reading(opened):
    """One to three flipped bits: what is read is the reading of a repeat, to the last bit."""
    rng = np.random.default_rng(5)
    damaged = 0

    def spoilt(transaction, _):
        nonlocal damaged
        text = bytearray(line(f"%R1P,0,{transaction}", f"{FULL}0"))
        if rng.random() < 0.5:
            damaged += 1
            for bit in rng.choice(8 * (len(text) - 2), rng.integers(1, 4), replace=False):
                text[bit // 8] ^= 1 << int(bit % 8)
        return bytes(text)

    device, asked = opened({2167: spoilt})
    for _ in range(100):
        assert device.measure().value == pytest.approx(POINT, abs=1e-15)
    assert damaged > 60
    assert asked.count(2167) == 100 + damaged
