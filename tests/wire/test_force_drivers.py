"""Drivers of force sensors against simulated ones: readings, and what goes wrong on the line."""

import os
import signal
import threading
import time

import numpy as np
import pytest
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusIOException

from hilcal.drivers import bota, ft300
from hilcal.drivers.ft300 import STREAM, start_stream
from hilcal.drivers.links import close_port, open_port
from hilcal.drivers.simulated.force_server import DRIFT_STD, ROOM
from hilcal.errors import DeviceError
from tests.support import force_cases as cases
from tests.support.force_cases import instruments, simulated
from tests.support.instruments import WRENCH, force_sensor
from tests.support.timing import wait_until

__all__ = ["instruments", "simulated"]  # fixtures


@cases.ALL
def test_readings_are_what_the_sensor_feels(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        mean, noise, off = cases.truth_of(simulated)
        before = time.monotonic_ns()
        sample = cases.steady(sensor, 1.0)
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


@cases.ALL
def test_no_frame_is_lost_at_full_rate(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        rate = simulated.admin("state")["rate"]
        first, dropped = sensor.losses().frames, simulated.admin("state")["dropped"]
        sample = cases.steady(sensor, 2.0)
        count = cases.settled(sensor, lambda count: count.lost == 0)
        assert count.lost == count.corrupt == count.skipped == 0
        assert simulated.admin("state")["dropped"] == dropped
        assert sample.frames <= count.frames - first
        assert sample.frames == pytest.approx(2.0 * rate, rel=0.05)


@cases.BOTH
def test_the_report_says_who_answered(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
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


@cases.BOTH
def test_close_leaves_nothing_behind_and_never_fails(kind, simulated):
    files = len(os.listdir("/proc/self/fd"))
    sensor = cases.OPEN[kind](cases.config(kind, simulated.port))
    assert len(cases.readers()) == 1
    sensor.close()
    sensor.close()
    assert cases.readers() == []
    cases.fails(sensor.latest, "closed")
    sensor = cases.OPEN[kind](cases.config(kind, simulated.port))
    simulated.admin("unplug")
    sensor.close()
    assert cases.readers() == []
    cases.fails(lambda: cases.OPEN[kind](cases.config(kind, simulated.port)), "there is no port")
    assert len(os.listdir("/proc/self/fd")) <= files + 1


def test_an_ft300_is_silent_after_close(instruments):
    simulated = instruments("ft300")
    with cases.opened("ft300", simulated.port):
        assert simulated.admin("state")["streaming"]
    wait_until(lambda: not simulated.admin("state")["streaming"], "silent")


def test_an_ft300_that_streams_for_a_dead_program_is_taken_over(instruments):
    simulated = instruments("ft300")
    port = open_port("force sensor", str(simulated.port), ft300.BAUD)
    start_stream(port)
    close_port(port)  # and nobody stopped it
    wait_until(lambda: simulated.admin("state")["streaming"], "streaming")
    with cases.opened("ft300", simulated.port) as sensor:
        assert "serial number F3004242" in sensor.report().name
        assert cases.steady(sensor, 0.3).frames > 20


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


OVERLOADED = r"loaded over its range|overloaded"


@cases.ALL
def test_unplugged_while_streaming_and_replugged(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        sensor.latest()
        simulated.admin("unplug")
        cases.fails(sensor.latest, "is gone; was its adapter unplugged")
        cases.fails(lambda: sensor.average(1.0), "is gone; was its adapter unplugged")
        assert "unplugged" in sensor.report().problems[0]
    cases.fails(lambda: cases.OPEN[kind](cases.config(kind, simulated.port)), "there is no port")
    simulated.admin("replug")
    with cases.opened(kind, simulated.port) as sensor:
        assert cases.steady(sensor, 0.2).frames > 10


@cases.BOTH
@pytest.mark.parametrize("fault", ["mute", "stall"])
def test_a_stream_that_stops_is_stale_and_comes_back(kind, simulated, fault):
    with cases.opened(kind, simulated.port) as sensor:
        time.sleep(0.2)
        simulated.admin(fault, on=True)
        cases.fails(sensor.latest, "nothing came for .* s; check the sensor's power and cable")
        cases.fails(lambda: sensor.average(0.1), "nothing came")
        stopped = time.monotonic()
        assert "nothing came" in sensor.report().problems[0]
        time.sleep(0.2)
        simulated.admin(fault, on=False)
        missing = (time.monotonic() - stopped) * simulated.admin("state")["rate"]
        assert cases.settled(sensor, lambda count: count.lost > 0.9 * missing).lost > 0.9 * missing


@cases.BOTH
def test_frames_that_come_late_are_waited_for(kind, simulated):
    """As on a busy computer: nothing comes during the whole window, all of it soon after."""
    with cases.opened(kind, simulated.port) as sensor:
        time.sleep(0.2)
        os.kill(simulated.process.pid, signal.SIGSTOP)
        timer = threading.Timer(0.25, os.kill, (simulated.process.pid, signal.SIGCONT))
        timer.start()
        began = time.monotonic()
        mean = sensor.average(0.1)
        timer.join()
        assert time.monotonic() - began > 0.2
        assert mean.frames >= 5  # half of what 100 Hz, the slowest, gives in the window


@cases.BOTH
def test_a_mute_sensor_and_a_wrong_rate_are_told_when_opening(kind, simulated):
    cases.fails(
        lambda: cases.OPEN[kind](cases.config(kind, simulated.port, baud=57600)),
        f"{simulated.port}.* at 57600 Bd.*rate",
    )
    simulated.admin("mute", on=True)
    cases.fails(
        lambda: cases.OPEN[kind](cases.config(kind, simulated.port)), "check the sensor's power"
    )
    simulated.admin("mute", on=False)
    assert cases.readers() == []
    with cases.opened(kind, simulated.port) as sensor:
        sensor.latest()


@cases.BOTH
def test_a_rate_that_changes_while_streaming_is_told(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        sensor.latest()
        simulated.admin("baud", baud=57600)
        cases.fails(sensor.latest, "bytes come at .* Bd, but no whole frame")


@cases.ALL
def test_damage_on_the_line_lets_no_wrong_reading_through(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        mean, noise, off = cases.truth_of(simulated)
        time.sleep(0.3)
        simulated.admin("flip", probability=0.02)
        simulated.admin("cut", probability=0.02)
        end = time.monotonic() + (3.0 if kind == "ft300" else 1.5)
        readings_compared = 0
        while time.monotonic() < end:
            try:
                sample = cases.steady(sensor, 0.3)
            except DeviceError:
                continue  # a machine that does other work; no reading is no wrong reading
            readings_compared += sample.frames
            spread = np.sqrt(np.diagonal(sample.covariance))
            assert np.all(np.abs(sample.wrench - mean) < 6 * noise / np.sqrt(sample.frames) + off)
            assert np.all(spread < 3 * noise)  # one wrong frame would be a gross outlier
        assert readings_compared > 100
        count = sensor.losses()
        assert count.corrupt > 0
        assert count.skipped > 0
        assert count.lost >= 0.8 * count.corrupt
        assert any("frames lost on port" in problem for problem in sensor.report().problems)


@cases.ALL
def test_overload_is_no_reading(kind, simulated):
    force = [0.0, 0.0, 5000.0, 0.0, 0.0, 0.0]
    with cases.opened(kind, simulated.port) as sensor:
        cases.steady(sensor, 0.1)
        simulated.admin("overload", force=force)
        cases.fails(lambda: sensor.average(0.2), OVERLOADED)
        cases.fails(sensor.latest, OVERLOADED)
        assert "load" in sensor.report().problems[0]
        simulated.admin("overload", force=[0.0] * 6)
        wait_until(
            lambda: np.linalg.norm(cases.steady(sensor, 0.1).wrench) < 100.0, "free of the overload"
        )


def test_the_wrong_sensor_is_told(instruments):
    port = instruments("bota").port
    cases.fails(
        lambda: ft300.open_force_sensor(cases.config("ft300", port, baud=460800)),
        "the bytes received are no answer; .* or it is no FT 300",
    )
    port = instruments("hex").port
    cases.fails(
        lambda: bota.open_force_sensor(cases.config("bota", port, baud=1_000_000)),
        "no whole frame .* or it is no Bota sensor",
    )


def test_ft300_serves_a_modbus_library_that_no_driver_uses():
    """The FT 300's driver uses minimalmodbus; this is pymodbus."""
    with force_sensor("ft300") as ft300:
        client = ModbusSerialClient(str(ft300.port), baudrate=19200, timeout=0.5, retries=0)
        assert client.connect()

        def held(address, count, kind):
            registers = client.read_holding_registers(address, count=count, device_id=9)
            return client.convert_from_registers(registers.registers, kind)

        try:
            assert held(500, 5, client.DATATYPE.STRING) == "SIM-1.0.10"
            assert held(510, 4, client.DATATYPE.STRING) == "F3004242"
            registers = client.read_input_registers(180, count=6, device_id=9)
            counts = client.convert_from_registers(registers.registers, client.DATATYPE.INT16)
            wrench = np.array(counts) / np.repeat((100, 1000), 3)
            slack = 6 * np.repeat((0.1, 0.005), 3) + 5 * DRIFT_STD.max() * 0.5
            now = WRENCH + np.array(ft300.admin("state")["bias"])
            np.testing.assert_array_less(np.abs(wrench - now), slack)
            for refused, code in (
                (client.read_holding_registers(600, device_id=9), 2),
                (client.write_registers(180, [1, 2], device_id=9), 2),
                (client.write_coil(1, True, device_id=9), 1),
            ):
                assert refused.isError()
                assert refused.exception_code == code
            with pytest.raises(ModbusIOException, match="No response"):
                client.read_holding_registers(500, device_id=8)
            assert not client.write_register(410, STREAM, device_id=9).isError()
            assert ft300.admin("state")["streaming"]
        finally:
            client.close()


def test_the_zero_drifts_as_the_sensor_warms_up():
    with (
        force_sensor("bota", "--on", "0", scale=2000.0) as sensor,
        cases.opened("bota", sensor.port) as device,
    ):
        cold = device.latest().temperature
        time.sleep(1.5)  # 3000 s of the world
        warm = cases.steady(device, 0.2)
        state = sensor.admin("state")
        assert device.latest().temperature > cold
    assert state["temperature"] - ROOM > 6.0
    drift = np.abs(warm.wrench - WRENCH - np.array(state["bias"]))
    assert np.all(drift < 5 * DRIFT_STD * 7.0 + 0.03)
    noise = np.array(state["noise"]) / np.sqrt(warm.frames)
    assert np.any(drift > 0.1 * DRIFT_STD * 7.0 + 5 * noise)


@pytest.mark.parametrize("kind", ["bota"])
def test_a_saturated_gauge_is_no_reading_and_a_clock_that_wraps_loses_nothing(kind, simulated):
    with cases.opened(kind, simulated.port) as sensor:
        cases.steady(sensor, 0.1)
        simulated.admin("saturate", on=True)
        cases.fails(sensor.latest, OVERLOADED)
        simulated.admin("saturate", on=False)
        cases.steady(sensor, 0.1)
        number = simulated.admin("state")["frames"]
        simulated.admin("clock", us=2**32 - 1000 * number - 500_000)
        time.sleep(0.2)
        lost = sensor.losses().lost
        wait_until(  # it wraps after half a second
            lambda: simulated.admin("state")["frames"] > number + 700, "wrapped"
        )
        cases.steady(sensor, 0.1)
        assert sensor.losses().lost == lost
        simulated.admin("clock", us=0)
