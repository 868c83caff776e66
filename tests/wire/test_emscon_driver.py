"""The driver of Leica's laser trackers (emScon): against our simulated tracker, and CESAPI's."""

import socket
import struct
import threading
import time
from contextlib import closing, contextmanager
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

from hilcal.drivers import emscon_packets as es
from hilcal.drivers.emscon import EmsconConnection, EmsconOptions, EmsconTracker, open_tracker
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Clock, PointingTracker, TargetLostError
from tests.support.instruments import TARGET, TURNED, cell, emscon


@pytest.fixture(scope="module")
def there():
    with emscon() as running:
        yield running


@contextmanager
def opened(there, **options):
    """A driver on the tracker, which is healthy again afterwards."""
    tracker, address = there
    for op in ("beam", "mute", "transform", "freeze"):
        tracker.admin(op, on=False)
    tracker.admin("reflector", number=1)
    tracker.truth(target=np.array(TARGET), target_rotation=TURNED)
    device = open_tracker(cell(address, "emscon", **options))
    try:
        yield device
    finally:
        device.close()


def test_readings_scatter_as_the_tracker_states(there):
    with opened(there, measuring_s=0.1) as device:
        samples = [device.measure() for _ in range(40)]
    assert isinstance(device, PointingTracker)
    off = np.array([sample.value for sample in samples]) - TARGET
    squares = np.einsum("ki,ij,kj->k", off, np.linalg.inv(samples[0].covariance), off)
    low, high = stats.chi2.ppf((1e-6, 1.0 - 1e-6), 120)
    assert low < squares.sum() < high
    beam = np.array(TARGET) / np.linalg.norm(TARGET)
    std = np.sqrt(beam @ samples[0].covariance @ beam)
    assert std == pytest.approx(5e-6 + 0.15e-6 * np.linalg.norm(TARGET), rel=1e-3)


# readings


def test_poses_of_a_6d_target_scatter_as_the_tracker_states(there):
    with opened(there, measuring_s=0.1, target="pose") as device:
        samples = [device.measure() for _ in range(40)]
    back = Rotation.from_matrix(TURNED).inv()
    turns = [(Rotation.from_rotvec(s.value[3:]) * back).as_rotvec() for s in samples]
    off = np.hstack([[s.value[:3] - TARGET for s in samples], turns])
    each = np.array([s.covariance for s in samples])
    squares = np.einsum("ki,kij,kj->k", off, np.linalg.inv(each), off)
    low, high = stats.chi2.ppf((1e-6, 1.0 - 1e-6), 240)
    assert low < squares.sum() < high
    beam = np.array(TARGET) / np.linalg.norm(TARGET)
    std = np.sqrt(beam @ each[0, :3, :3] @ beam)
    assert std == pytest.approx(5e-6 + 0.15e-6 * np.linalg.norm(TARGET), rel=1e-3)
    # however the target is turned: the same scatter about each axis of the tracker
    assert each[:, 3:, 3:] == pytest.approx(8.7e-5**2 * np.broadcast_to(np.eye(3), (40, 3, 3)))


def test_what_another_program_has_set_is_set_right(there):
    """Units, transformation into an object's axes: at first, and when they change meanwhile."""
    tracker = there[0]
    with opened(there):
        pass  # it takes one client
    with closing(EmsconConnection(*there[1].split(":"))) as other:
        polar = struct.pack("<I", 3)
        assert other.ask(es.SET_COORDINATES, polar, deadline=time.monotonic() + 2.0)[0] == es.OK
    with opened(there) as device:
        tracker.admin("transform", on=True)
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)
        settings = tracker.admin("state")["settings"]
        assert settings[str(es.GET_UNITS)] == "00" * 20  # m, rad; it begins with mm and degrees
        assert settings[str(es.GET_COORDINATES)] == "00" * 4


# the target


def test_broken_beam_is_a_lost_target_that_is_found_again(there):
    tracker = there[0]
    with opened(there) as device:
        tracker.admin("beam", on=True)
        with pytest.raises(TargetLostError, match="beam broken"):
            device.measure()
        with pytest.raises(TargetLostError, match="not found"):
            device.find_target()
        assert any("no reflector" in problem for problem in device.report().problems)
        tracker.admin("beam", on=False)
        device.find_target()
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


def test_lost_zeros_are_found_again_and_named(there):
    tracker = there[0]
    with opened(there) as device:
        tracker.admin("uninitialize")
        assert any("initialise it" in problem for problem in device.report().problems)
        with pytest.raises(TargetLostError, match="no longer initialised"):
            device.measure()
        device.find_target()
        assert tracker.admin("state")["initialized"]
        assert "axes may have moved" in device.measure().warning
        assert device.measure().warning == ""


def test_another_prism_is_refused_until_it_is_set_back(there):
    tracker = there[0]
    with opened(there) as device:
        tracker.admin("reflector", number=2)
        for _ in range(2):
            with pytest.raises(DeviceError, match=r'to "RRR 0\.5in", .* "RRR 1\.5in"'):
                device.measure()
        tracker.admin("reflector", number=1)
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


def test_reflector_by_name(there):
    with opened(there, reflector="RRR 0.5in") as device:
        assert ("reflector", "RRR 0.5in") in device.report().facts
    with pytest.raises(InputError, match=r'no reflector "ball"; valid: RRR 1\.5in, RRR 0'):
        open_tracker(cell(there[1], "emscon", reflector="ball"))


def test_one_of_several_targets_is_aimed_at(there):
    up = np.array([0.0, 0.0, 0.3])
    other = TARGET + up
    none = np.full((6, 3), np.nan)
    with opened(there) as device:
        assert isinstance(device, PointingTracker)
        there[0].truth(targets=np.vstack([TARGET, other, none]))
        for wanted in (other, np.array(TARGET)):
            device.aim(wanted, 0.05)
            assert device.measure().value == pytest.approx(wanted, abs=1e-3)
        with pytest.raises(TargetLostError):
            device.aim(other + up, 0.05)
        there[0].truth(targets=np.zeros((8, 3)))
        device.find_target()


# results that are none


class Altered(EmsconConnection):
    """A connection that alters each result: its status, or the measurement in it."""

    def __init__(self, address, status=es.OK, **change):
        host, port = address.split(":")
        super().__init__(host, int(port))
        self.status, self.change = status, change

    def result(self, *, deadline):
        kind, status, body = super().result(deadline=deadline)
        if self.change:
            changed = replace(es.measurement(kind, body), **self.change)
            kind, body = es.pack_measurement(changed, es.STATIONARY, (20.0, 1013.0, 40.0))
        return kind, self.status or status, body


@pytest.mark.parametrize(
    ("options", "change", "said"),
    [
        ({}, {"status": es.NO_RESULT}, "beam broken"),
        ({}, {"status": 10013}, "does not stand firmly"),
        ({}, {"quaternion": np.array([1.0, 0.0, 0.0, 0.0])}, "another mode than set"),
        ({}, {"position": np.zeros(3)}, "a target 0 m away"),
        ({}, {"position": np.full(3, 1e3)}, "a target 1732 m away"),
        ({"target": "pose"}, {"quaternion": np.array([2.0, 0, 0, 0])}, "quaternion of length 2"),
    ],
)
def test_a_result_that_is_none_is_no_reading(there, options, change, said):
    with opened(there):
        pass  # the tracker takes one client
    config = cell(there[1], "emscon").tracker
    options = EmsconOptions(measuring_s=0.1, **options)
    device = EmsconTracker(lambda: Altered(there[1], **change), config, options, Clock(20.0))
    with closing(device), pytest.raises(DeviceError, match=said):
        device.measure()


def test_zeros_that_another_program_has_found_again_are_named(there):
    with opened(there) as device:
        there[0].admin("change", number=es.INITIALIZATION_CHANGED)
        assert "axes may have moved" in device.measure().warning
        assert device.measure().warning == ""


def test_the_answer_to_another_command_is_not_taken():
    def packet(command, content):
        body = struct.pack("<II", command, es.OK) + content
        return es.HEADER.pack(es.HEADER.size + len(body), es.COMMAND) + body

    with socket.create_server(("127.0.0.1", 0)) as door:
        line = EmsconConnection(*door.getsockname())
        peer, _ = door.accept()
        with closing(line), peer:
            peer.sendall(packet(es.GET_UNITS, b"old") + packet(es.GET_MODE, b"new"))
            assert line.ask(es.GET_MODE, deadline=time.monotonic() + 1.0) == (es.OK, b"new")


# the connection


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (("drop", {}), "closed the connection"),
        (("rubbish", {"data": "GET / HTTP/1.1 and more of it"}), "not emScon packets"),
        (("change", {"number": 998}), "server is being shut down"),
    ],
)
def test_a_connection_that_fails_is_one_line_and_made_again(there, fault, said):
    with opened(there) as device:
        there[0].admin(fault[0], **fault[1])
        with pytest.raises(DeviceError, match=said) as caught:
            device.measure()
        assert "\n" not in str(caught.value)
        sample = device.measure()
        assert "was lost and restored" in sample.warning
        assert sample.value == pytest.approx(TARGET, abs=1e-3)


def test_a_mute_tracker_is_given_up(there):
    with opened(there) as device:
        there[0].admin("mute", on=True)
        with pytest.raises(DeviceError, match="no answer"):
            device.measure()
        there[0].admin("mute", on=False)
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)


def test_busy_server_is_asked_again_and_a_refusal_is_named(there):
    tracker = there[0]
    with opened(there) as device:
        tracker.admin("fail", command=es.START_MEASUREMENT, status=es.BUSY, count=3)
        assert device.measure().value == pytest.approx(TARGET, abs=1e-3)
        tracker.admin("fail", command=es.START_MEASUREMENT, status=10013)
        with pytest.raises(DeviceError, match="does not stand firmly"):
            device.measure()


def test_nobody_there():
    with pytest.raises(DeviceError, match="refuses the connection"):
        open_tracker(cell("127.77.66.55:7000", "emscon"))


# CESAPI, of others: its client on our tracker, our driver on its simulated tracker


def test_the_client_of_others_measures_the_same(there):
    packet = pytest.importorskip("CESAPI.packet")
    from CESAPI.command import CommandSync
    from CESAPI.connection import Connection

    with opened(there) as device:
        device.measure()  # leaves m and rad
    connection = Connection()
    host, port = there[1].split(":")
    connection.connect(host, int(port))
    try:
        command = CommandSync(connection)
        assert command.GetUnits().unitsSettings.lenUnitType == packet.ES_LU_Meter
        assert command.GetEnvironmentParams().environmentData.dPressure == 1013.25
        assert command.GetSystemStatus().trackerProcessorStatus == packet.ES_TPS_Initialized
        assert (
            command.GetMeasurementStatusInfo().lMeasurementStatusInfo & packet.ES_MSI_ReflectorFound
        )
        assert command.GetReflector().iInternalReflectorId == 1
        listed = command.GetReflectors()
        assert (listed.iTotalReflectors, listed.iInternalReflectorId) == (2, 1)
        assert listed.cReflectorName.decode("utf-16-le").rstrip("\0") == "RRR 1.5in"
        measurement = command.StartMeasurement()
        assert packet.packetType(measurement) == packet.ES_DT_SingleMeasResult2
        assert (measurement.dVal1, measurement.dVal2, measurement.dVal3) == pytest.approx(
            TARGET, abs=1e-3
        )
        total = np.sqrt(
            measurement.dAprioriStd1**2 + measurement.dAprioriStd2**2 + measurement.dAprioriStd3**2
        )
        assert measurement.dAprioriStdTotal == pytest.approx(total)
        assert measurement.dTemperature == 20.0
        there[0].admin("beam", on=True)
        with pytest.raises(Exception, match="49 failed with status 10009"):
            command.StartMeasurement()
    finally:
        connection.disconnect()


@contextmanager
def simulator_of_others():
    """CESAPI's simulated tracker; it has no results of its own, so it packs one of ours."""
    packet = pytest.importorskip("CESAPI.packet")
    from CESAPI.test import LTSimulator

    simulator = LTSimulator()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        simulator.host, simulator.port = free.getsockname()
    usual = simulator.populateReturnPacket

    def populate(answer):
        usual(answer)
        asked = getattr(answer, "packetInfo", None)  # it is called for parts of packets, too
        if asked is not None and asked.command == packet.ES_C_StartMeasurement:
            result, head = packet.SingleMeasResult2T(), answer.pack()
            result.dVal1, result.dVal2, result.dVal3 = TARGET
            result.dAprioriStd1, result.dAprioriStd2, result.dAprioriStd3 = 1e-5, 2e-5, 3e-5
            result.dAprioriCovar13 = 1e-10
            answer.pack = lambda: head + result.pack()

    simulator.populateReturnPacket = populate
    simulator.start()
    try:
        yield simulator
    finally:
        simulator.stop()
        simulator.join()


def test_the_driver_measures_on_the_simulator_of_others():
    before = threading.active_count()
    with simulator_of_others() as simulator:
        address, end = f"{simulator.host}:{simulator.port}", time.monotonic() + 10.0
        while True:
            try:
                device = open_tracker(cell(address, "emscon"))
                break
            except DeviceError:
                assert time.monotonic() < end
                time.sleep(0.1)
        try:
            assert any("initialise it" in problem for problem in device.report().problems)
            device.find_target()  # it has to be initialised first, and tells that it was
            assert "initialised again" in device.measure().warning
            report = device.report()
            assert ("emScon", "3.8.900") in report.facts
            assert ("environment", "22.0 °C, 1013.2 mbar, 0 %") in report.facts
            assert report.problems == ()
            sample = device.measure()
        finally:
            device.close()
    assert sample.value == pytest.approx(TARGET, abs=0.0)
    stated = np.diag([1e-10, 4e-10, 9e-10])
    stated[0, 2] = stated[2, 0] = 1e-10
    assert sample.covariance == pytest.approx(stated, rel=1e-12)
    assert threading.active_count() == before
