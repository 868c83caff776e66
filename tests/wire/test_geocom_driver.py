"""The GeoCOM driver against the simulated station: readings, the target, and the line."""

import contextlib
import time

import numpy as np
import pytest

from hilcal.drivers.geocom import ANSWER_S, DEADLINE_S, open_tracker
from hilcal.errors import DeviceError
from hilcal.measuring.devices import TargetLostError
from tests.support import sim_serial_cases as simulated
from tests.support.geocom_cases import cell

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


def test_instrument_that_states_larger_errors_of_its_angles_is_believed():
    with simulated.tracker(TARGET, "--transverse-std", "60e-6", "3e-6") as station:
        device = open_tracker(cell(station.port))
        covariance = device.measure().covariance
        device.close()
    distance = np.linalg.norm(TARGET)
    across = np.linalg.eigvalsh(covariance)[-1]
    assert across == pytest.approx((60e-6 + 3e-6 * distance) ** 2, rel=1e-2)


@pytest.mark.parametrize("code", [1283, 1284])
def test_reading_with_a_remark_is_used_and_says_so(device, station, code):
    station.admin("warn", code=code)
    sample = device.measure()
    assert str(code) in sample.warning
    assert sample.value == pytest.approx(TARGET, abs=1e-3)


# the target


def test_broken_beam_gives_no_reading_but_a_lost_target(device, station):
    station.admin("beam", on=True)
    for _ in range(3):
        seconds, text = seconds_of(TargetLostError, device.measure)
        assert "1285" in text
        assert seconds < MUTE_S
    station.admin("beam", on=False)
    assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


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


def test_report_names_every_problem_at_once(device, station):
    station.admin("beam", on=True)
    station.admin("lock_lost")
    problems = " / ".join(device.report().problems)
    assert "not locked" in problems
    assert "no distance" in problems


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


def test_flipped_bits_and_cuts_are_repaired_or_refused(device, station):
    station.admin("flip", probability=0.02)
    for _ in range(60):
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)
    station.admin("flip", probability=0.5)
    for _ in range(10):
        with contextlib.suppress(DeviceError):
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
