"""The drivers of force sensors against simulated ones, over the bytes of a serial line."""

import os
import time

import numpy as np
import pytest

from drivers import bota, ft300, onrobot_hex
from drivers.modbus_rtu import write_register
from drivers.serial_line import close_port, open_port
from hilcal.config import CellConfig
from hilcal.errors import DeviceError, InputError
from tests.support.force_cases import (
    ALL,
    BOTH,
    OPEN,
    OPTIONS,
    config,
    fails,
    instruments,
    opened,
    readers,
    settled,
    simulated,
    steady,
    truth_of,
)

__all__ = ["instruments", "simulated"]  # fixtures


@ALL
def test_readings_are_what_the_sensor_feels(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        mean, noise, off = truth_of(simulated)
        before = time.monotonic_ns()
        sample = steady(sensor, 1.0)
        after = time.monotonic_ns()
        std = np.sqrt(np.diagonal(sample.covariance))
        K = sample.frames
        assert before < sample.host_ns < after
        assert np.all(np.abs(sample.wrench - mean) < 5 * noise / np.sqrt(K) + off)
        assert std == pytest.approx(noise, rel=5 / np.sqrt(2 * K) + 0.05)
        newest = sensor.latest()
        assert newest.frames == 1
        assert not np.any(newest.covariance)
        assert np.all(np.abs(newest.wrench - mean) < 6 * noise + off)
        assert 0 <= time.monotonic_ns() - newest.host_ns < 0.3e9
        if kind == "bota":
            assert newest.temperature == pytest.approx(29.0, abs=0.1)
        else:
            assert newest.temperature is None


@ALL
def test_no_frame_is_lost_at_full_rate(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        rate = simulated.admin("state")["rate"]
        first, dropped = sensor.losses().frames, simulated.admin("state")["dropped"]
        sample = steady(sensor, 2.0)
        count = settled(sensor, lambda count: count.lost == 0)
        assert count.lost == count.corrupt == count.skipped == 0
        assert simulated.admin("state")["dropped"] == dropped
        assert sample.frames <= count.frames - first
        assert sample.frames == pytest.approx(2.0 * rate, rel=0.05)


@BOTH
def test_the_report_says_who_answered(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        time.sleep(0.3)
        report = sensor.report()
        facts = dict(report.facts)
        assert report.device == "force sensor"
        assert report.problems == ()
        assert facts["port"] == str(simulated.port)
        assert facts["rate"] == ("100 Hz" if kind == "ft300" else "1000 Hz")
        if kind == "ft300":
            assert report.name == "Robotiq FT 300, serial number F3004242"
            assert facts["firmware"] == "SIM-1.0.10"
        if kind == "bota":
            assert facts["temperature"] == "29.0 °C"


@BOTH
def test_a_second_program_on_the_port_is_refused_and_disturbs_nothing(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        with pytest.raises(DeviceError, match="in use by another program") as caught:
            OPEN[kind](config(kind, simulated.port))
        assert str(simulated.port) in str(caught.value)
        time.sleep(0.3)
        assert sensor.losses().corrupt == 0


@BOTH
def test_close_leaves_nothing_behind_and_never_fails(kind, simulated):
    files = len(os.listdir("/proc/self/fd"))
    sensor = OPEN[kind](config(kind, simulated.port))
    assert len(readers()) == 1
    sensor.close()
    sensor.close()
    assert readers() == []
    fails(sensor.latest, "closed")
    sensor = OPEN[kind](config(kind, simulated.port))
    simulated.admin("unplug")
    sensor.close()
    assert readers() == []
    fails(lambda: OPEN[kind](config(kind, simulated.port)), "there is no port")
    assert len(os.listdir("/proc/self/fd")) <= files + 1


def test_an_ft300_is_silent_after_close(instruments):
    simulated = instruments("ft300")
    with opened("ft300", simulated.port):
        assert simulated.admin("state")["streaming"]
    time.sleep(0.1)
    assert not simulated.admin("state")["streaming"]


def test_an_ft300_that_streams_for_a_dead_program_is_taken_over(instruments):
    simulated = instruments("ft300")
    port = open_port("force sensor", str(simulated.port), ft300.BAUD)
    write_register(port, ft300.SLAVE, ft300.STREAM_REGISTER, ft300.STREAM)
    close_port(port)  # and nobody stopped it
    time.sleep(0.2)
    assert simulated.admin("state")["streaming"]
    with opened("ft300", simulated.port) as sensor:
        assert "serial number F3004242" in sensor.report().name
        assert steady(sensor, 0.3).frames > 20


@pytest.mark.parametrize(
    "start", [ft300.open_force_sensor, bota.open_force_sensor], ids=["ft300", "bota"]
)
def test_a_cell_without_force_sensor_or_with_a_strange_option(start):
    with pytest.raises(InputError, match=r"\[force_sensor\] is missing"):
        start(CellConfig.model_validate({"robot": {"model": "ur10e"}}))
    with pytest.raises(InputError, match='driver "x" has no option "colour"'):
        start(config("x", "/dev/null", options={"colour": "red"}))


@pytest.mark.parametrize("options", [{}, {"counts_per_N": 50.0}, {**OPTIONS["hex"], "rate_hz": 0}])
def test_a_hex_needs_its_scale(options):
    with pytest.raises(InputError, match=r"needs .* a number over 0"):
        onrobot_hex.open_force_sensor(config("hex", "/dev/null", options=options))


@pytest.mark.parametrize("bit", [1, 2, 3, 9])
def test_the_status_of_a_bota_that_is_no_reading(bit):
    assert bota.SENSOR.overload(np.zeros(6), 1 << bit)
    assert not bota.SENSOR.overload(np.zeros(6), 1)
    assert not bota.SENSOR.overload(np.zeros(6), 0)


@pytest.mark.parametrize(("index", "value"), [(2, 300.0), (2, -300.0), (5, 30.0), (0, 327.67)])
def test_an_ft300_at_the_end_of_its_range(index, value):
    wrench = np.array([0.0, 0.0, 299.9, 0.0, 29.9, 0.0])
    assert not ft300.SENSOR.overload(wrench, 0)
    wrench[index] = value
    assert "over its range" in ft300.SENSOR.overload(wrench, 0)
