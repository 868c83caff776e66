"""The drivers of force sensors against simulated ones, over the bytes of a serial line."""

import binascii
import os
import struct
import threading
import time
import tty
from collections.abc import Callable
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest
from sim_serial_cases import force_sensor

from drivers import bota, ft300, onrobot_hex
from drivers.modbus_rtu import write_register
from drivers.serial_line import close_port, open_port
from hilcal.config import CellConfig
from hilcal.errors import DeviceError, InputError

OPEN: dict[str, Callable] = {
    "ft300": ft300.open_force_sensor,
    "bota": bota.open_force_sensor,
    "hex": onrobot_hex.open_force_sensor,
}
OPTIONS = {"hex": {"counts_per_N": 50.0, "counts_per_Nm": 2000.0}}
ALL = pytest.mark.parametrize("kind", OPEN)
BOTH = pytest.mark.parametrize("kind", ["ft300", "bota"])
WRENCH = np.array([1.0, -2.0, 30.0, 0.1, 0.2, -0.3])
DEADLINE_S = 2.0
OVERLOADED = r"loaded over its range|overloaded"
SLACK_S = 2.0  # a machine that does other work


def config(kind, port, **keys):
    section = {"driver": kind, "port": str(port), "options": OPTIONS.get(kind, {}), **keys}
    return CellConfig.model_validate({"robot": {"model": "ur10e"}, "force_sensor": section})


@contextmanager
def opened(kind, port, **keys):
    sensor = OPEN[kind](config(kind, port, **keys))
    try:
        yield sensor
    finally:
        sensor.close()


def truth_of(simulated):
    """(6,) what the sensor means, (6,) how one frame scatters, (6,) how far it may have drifted.

    The last also holds what is lost in the counts of FT 300 and HEX.
    """
    state = simulated.admin("state")
    drift = 4 * np.repeat((0.05, 0.002), 3) * (state["temperature"] - 22.0)
    return WRENCH + np.array(state["bias"]), np.array(state["noise"]), drift + 0.01


def fails(action, match, within=DEADLINE_S):
    """Do it again and again until it fails, with one line, in time."""
    start = time.monotonic()

    def again() -> None:
        while time.monotonic() < start + within + SLACK_S:
            action()
            time.sleep(0.01)

    with pytest.raises(DeviceError, match=match) as caught:
        again()
    assert time.monotonic() - start < within + SLACK_S
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("force sensor: ")


@pytest.fixture(scope="module")
def instruments():
    """Starts each simulated sensor once, for all tests of this file."""
    with ExitStack() as stack:
        running = {}

        def start(kind):
            if kind not in running:
                running[kind] = stack.enter_context(force_sensor(kind))
            return running[kind]

        yield start


@pytest.fixture
def simulated(kind, instruments):
    """A simulated sensor without faults; it has none after the test either."""
    instrument = instruments(kind)
    baud = instrument.admin("state")["baud"]
    yield instrument
    for op, arguments in (
        *(("mute", {"on": False}), ("stall", {"on": False}), ("overload", {"force": [0.0] * 6})),
        *(("flip", {"probability": 0.0}), ("cut", {"probability": 0.0}), ("baud", {"baud": baud})),
        ("replug", {}),
    ):
        instrument.admin(op, **arguments)


def readers():
    return [t for t in threading.enumerate() if t.name == "force sensor"]


@ALL
def test_readings_are_what_the_sensor_feels(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        mean, noise, off = truth_of(simulated)
        before = time.monotonic_ns()
        sample = sensor.average(1.0)
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
            assert newest.temperature == pytest.approx(22.0, abs=1.0)
        else:
            assert newest.temperature is None


@ALL
def test_no_frame_is_lost_at_full_rate(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        rate = simulated.admin("state")["rate"]
        first, dropped = sensor.losses().frames, simulated.admin("state")["dropped"]
        sample = sensor.average(2.0)
        count = sensor.losses()
        assert count.lost == count.corrupt == count.skipped == 0
        assert simulated.admin("state")["dropped"] == dropped
        assert sample.frames <= count.frames - first
        assert sample.frames == pytest.approx(2.0 * rate, rel=0.05)


@BOTH
def test_the_report_says_who_answered(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        sensor.average(0.3)
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
            assert facts["temperature"].startswith("22.")


@BOTH
def test_a_second_program_on_the_port_is_refused_and_disturbs_nothing(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        with pytest.raises(DeviceError, match="in use by another program") as caught:
            OPEN[kind](config(kind, simulated.port))
        assert str(simulated.port) in str(caught.value)
        sensor.average(0.3)
        assert sensor.losses().corrupt == 0


@ALL
def test_unplugged_while_streaming_and_replugged(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        sensor.latest()
        simulated.admin("unplug")
        fails(sensor.latest, "is gone; was its adapter unplugged")
        fails(lambda: sensor.average(1.0), "is gone; was its adapter unplugged")
        assert "unplugged" in sensor.report().problems[0]
    fails(lambda: OPEN[kind](config(kind, simulated.port)), "there is no port")
    simulated.admin("replug")
    with opened(kind, simulated.port) as sensor:
        assert sensor.average(0.2).frames > 10


@BOTH
def test_unplugged_in_the_middle_of_a_mean(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        timer = threading.Timer(0.3, lambda: simulated.admin("unplug"))
        timer.start()
        fails(lambda: sensor.average(30.0), "unplugged")
        timer.join()


@BOTH
@pytest.mark.parametrize("fault", ["mute", "stall"])
def test_a_stream_that_stops_is_stale_and_comes_back(kind, simulated, fault):
    with opened(kind, simulated.port) as sensor:
        sensor.average(0.2)
        simulated.admin(fault, on=True)
        fails(sensor.latest, "nothing came for .* s; check the sensor's power and cable")
        fails(lambda: sensor.average(0.1), "nothing came")
        stopped = time.monotonic()
        assert "nothing came" in sensor.report().problems[0]
        time.sleep(0.2)
        simulated.admin(fault, on=False)
        missing = (time.monotonic() - stopped) * simulated.admin("state")["rate"]
        time.sleep(0.1)
        sensor.average(0.2)
        assert sensor.losses().lost > 0.9 * missing


@BOTH
def test_a_mute_sensor_and_a_wrong_rate_are_told_when_opening(kind, simulated):
    fails(
        lambda: OPEN[kind](config(kind, simulated.port, baud=57600)),
        f"{simulated.port}.* at 57600 Bd.*rate",
    )
    simulated.admin("mute", on=True)
    fails(lambda: OPEN[kind](config(kind, simulated.port)), "check the sensor's power")
    simulated.admin("mute", on=False)
    assert readers() == []
    with opened(kind, simulated.port) as sensor:
        sensor.latest()


@BOTH
def test_a_rate_that_changes_while_streaming_is_told(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        sensor.latest()
        simulated.admin("baud", baud=57600)
        fails(sensor.latest, "bytes come at .* Bd, but no whole frame")


@ALL
def test_damage_on_the_line_lets_no_wrong_reading_through(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        mean, noise, off = truth_of(simulated)
        sensor.average(0.3)
        simulated.admin("flip", probability=0.02)
        simulated.admin("cut", probability=0.02)
        end = time.monotonic() + (3.0 if kind == "ft300" else 1.5)
        seen = 0
        while time.monotonic() < end:
            sample = sensor.average(0.3)
            seen += sample.frames
            spread = np.sqrt(np.diagonal(sample.covariance))
            assert np.all(np.abs(sample.wrench - mean) < 6 * noise / np.sqrt(sample.frames) + off)
            assert np.all(spread < 3 * noise)  # one wrong frame would be a gross outlier
        count = sensor.losses()
        assert count.corrupt > 0
        assert count.skipped > 0
        assert count.lost >= 0.8 * count.corrupt
        assert seen > 0.8 * count.frames - 1000
        assert any("frames lost on port" in problem for problem in sensor.report().problems)


@BOTH
def test_half_a_frame_and_garbage_cost_a_frame_or_two(kind, simulated):
    with opened(kind, simulated.port) as sensor:
        sensor.average(0.2)
        simulated.admin("half_frame")
        sensor.average(0.2)
        simulated.admin("garbage", count=200)
        sensor.average(1.5)  # at 19200 Bd it holds up the frames behind it for 0.1 s
        count = sensor.losses()
        assert 1 <= count.lost <= 4
        assert count.skipped >= 200


@ALL
def test_overload_is_no_reading(kind, simulated):
    force = [0.0, 0.0, 5000.0, 0.0, 0.0, 0.0]
    with opened(kind, simulated.port) as sensor:
        timer = threading.Timer(0.2, lambda: simulated.admin("overload", force=force))
        timer.start()
        with pytest.raises(DeviceError, match=OVERLOADED):
            sensor.average(1.0)  # though the first frames were good
        timer.join()
        fails(sensor.latest, OVERLOADED)
        assert "load" in sensor.report().problems[0]
        simulated.admin("overload", force=[0.0] * 6)
        time.sleep(0.1)
        assert np.linalg.norm(sensor.average(0.1).wrench) < 100.0


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
        assert sensor.average(0.3).frames > 20


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


def test_the_wrong_sensor_is_told(instruments):
    port = instruments("bota").port
    fails(
        lambda: ft300.open_force_sensor(config("ft300", port, baud=460800)),
        "what comes is no answer; .* or it is no FT 300",
    )
    port = instruments("hex").port
    fails(
        lambda: bota.open_force_sensor(config("bota", port, baud=1_000_000)),
        "no whole frame .* or it is no Bota sensor",
    )


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


def bota_frame(number, wrench, status=0):
    """A frame with the standard library's CRC, which is the mirror image of X-25's."""
    body = struct.pack("<H6fIf", status, *wrench, number * 1000 % 2**32, 30.0)
    mirror = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))
    crc = binascii.crc_hqx(body.translate(mirror), 0xFFFF)
    return b"\xaa" + body + struct.pack("<H", int(f"{crc:016b}"[::-1], 2) ^ 0xFFFF)


@contextmanager
def talker(tmp_path, frames):
    """A line on which frames come every millisecond or so, for ever."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    path = tmp_path / "line"
    path.symlink_to(os.ttyname(slave))
    stop = threading.Event()

    def talk() -> None:
        for frame in frames:
            if stop.wait(0.001):
                return
            try:
                os.write(master, frame)
            except BlockingIOError:
                continue

    thread = threading.Thread(target=talk)
    thread.start()
    try:
        yield path
    finally:
        stop.set()
        thread.join()
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e30])
def test_values_that_cannot_be_never_pass(tmp_path, bad):
    good = (1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
    wrong = (1.0, 2.0, bad, 0.1, 0.2, 0.3)
    mixed = (bota_frame(k, good if k % 10 else wrong) for k in range(100_000))
    with talker(tmp_path, mixed) as path, opened("bota", path) as sensor:
        sample = sensor.average(0.3)
        assert sample.wrench == pytest.approx(good)
        assert sensor.losses().corrupt > 0
    (tmp_path / "line").unlink()
    only = (bota_frame(k, wrong) for k in range(100_000))
    with talker(tmp_path, only) as path:
        fails(lambda: OPEN["bota"](config("bota", path)), "their values were impossible")
