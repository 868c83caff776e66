"""Parts of the driver of UR arms: readings, torques, Robot API, primary port."""

import os
import signal
import socket
import struct
import time
from contextlib import closing
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilcal.drivers.simulated.cell_processes import free_host
from hilcal.drivers.simulated.ur_rtde import outputs_since
from hilcal.drivers.simulated.ur_server import API
from hilcal.drivers.ur import open_arm
from hilcal.drivers.ur_link import states
from hilcal.drivers.ur_link.control import (
    MARGIN_S,
    Brakes,
    MotionInProgress,
    deceleration,
    program_ended,
)
from hilcal.drivers.ur_link.probe import LinkError, controller
from hilcal.drivers.ur_link.reading import (
    OUTPUTS,
    PRIMARY_PORT,
    TORQUE,
    N,
    read,
    read_kinematics,
    settled_rate,
)
from hilcal.drivers.ur_link.supervision import RobotApi
from hilcal.drivers.ur_link.worker import Worker, WorkerError
from hilcal.robot.catalogue import load_arm
from hilcal.robot.factory import nominal_rows
from tests.support import ur_driver_cases as cases
from tests.support.factory_cases import write
from tests.support.ur_driver_cases import server

FIELDS = {
    **{name: [0.1 * k for k in range(6)] for name in OUTPUTS},
    **{"timestamp": 3.0, "robot_mode": 7, "runtime_state": 2, "safety_status_bits": 1},
    **{"speed_scaling": 0.5, "target_speed_fraction": 0.5, "payload": 1.0},
    "payload_cog": [0.0, 0.0, 0.1],
}


@given(speed=st.floats(0.01, 2.0))
def test_every_speed_is_braked_in_time(speed):
    assert speed / deceleration(speed) <= 0.2


def reading(**changes):
    return read({"host_ns": 1, "fields": {**FIELDS, **changes}})


def test_slider_and_scaling_multiply():
    assert reading().sample.speed_scaling == 0.25


@pytest.mark.parametrize(
    "changes",
    [
        {"actual_q": [0.0, 0.0, np.nan, 0.0, 0.0, 0.0]},
        {"actual_qd": [0.0] * 5},
        {"target_q": []},
        {"payload": np.inf},
        {"timestamp": np.nan},
    ],
)
def test_damaged_readings_are_refused(changes):
    reading()
    with pytest.raises(LinkError, match=next(iter(changes))):
        reading(**changes)


def test_gravest_safety_state_comes_first():
    assert states.safety_word(1) == states.NORMAL
    assert states.safety_word(1 << 2 | 1 << 10) == "protective stop"
    assert states.safety_word(1 << 6 | 1 << 7 | 1 << 10) == "emergency stop of the robot"
    assert states.safety_advice(1) == ""
    for bit in range(1, 11):
        assert states.safety_word(1 | 1 << bit) != states.NORMAL
        assert states.safety_advice(1 << bit)


def test_an_arm_that_its_brakes_hold_is_measured_as_little_as_one_that_was_stopped():
    """Its sample says so: switched off during a question, it gave one more reading."""
    off = reading(robot_mode=3)
    assert off.sample.safety == "not running (power off)"
    assert off.advice == "switch it on and release the brakes"
    assert reading(robot_mode=3, safety_status_bits=1 << 7).sample.safety == "emergency stop"


def test_motion_is_overdue_only_after_its_time_and_margin(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    goal = np.full(N, 1.0)
    at_rest = reading(actual_qd=[0.0] * 6, speed_scaling=1.0, target_speed_fraction=1.0)
    motion = MotionInProgress(np.zeros(N), goal, 0.5, 0.5, 5e-4, clock=1.0)  # takes 3 s
    now[0] += 1.5 * 3.0 + MARGIN_S - 0.01
    assert motion.overdue(at_rest) is None
    now[0] += 0.02
    assert "joint 1 stands 1 rad off" in motion.overdue(at_rest)
    assert not motion.arrived(at_rest)
    there = reading(actual_qd=[0.0] * 6, actual_q=goal + 4e-4, target_q=goal)
    assert motion.arrived(there)
    assert not motion.arrived(reading(actual_qd=[0.0] * 6, actual_q=goal + 6e-4, target_q=goal))
    assert not motion.arrived(reading(actual_qd=[0.02] * 6, actual_q=goal, target_q=goal))
    assert not motion.arrived(reading(actual_qd=[0.0] * 6, actual_q=goal, target_q=goal + 1e-4))


def test_a_motion_scaled_to_nothing_is_overdue_after_the_margin_and_not_before(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    motion = MotionInProgress(np.zeros(N), np.full(N, 1.0), 0.5, 0.5, 5e-4, clock=1.0)
    paused, slow = (reading(speed_scaling=x, target_speed_fraction=1.0) for x in (0.0, 0.1))
    assert motion.overdue(paused) is None
    for said, share in ((None, paused), (None, slow), (None, paused), ("scaled to 0", paused)):
        now[0] += MARGIN_S + 0.01 * (said is not None) - 0.005
        why = motion.overdue(share)
        assert why is None if said is None else said in why


def test_an_arm_stands_when_two_readings_in_a_row_say_so():
    """One alone may be of an arm that has not yet begun to move, or turns back."""
    still, moving = (reading(actual_qd=[x] * 6, runtime_state=states.PLAYING) for x in (0.0, 0.2))
    readings = [still, moving, still, still, moving]
    receiver = SimpleNamespace(read=lambda stale: readings.pop(0))
    control = SimpleNamespace(stop=lambda brake, seconds: None, end_lease=lambda: None)
    assert Brakes(None, receiver).stop_in_control(control, 2.0)
    assert readings == [moving]


def test_a_pause_that_the_watchdog_bears_does_not_hide_another_program():
    stopped = reading(runtime_state=states.STOPPED)
    for late in (0.0, 0.09):
        assert "another program" in program_ended(stopped, late)
    assert "too busy to send a sign of life for 0.09 s" in program_ended(stopped, 0.09)
    assert "another program" not in program_ended(stopped, 0.2)


def test_worker_that_cannot_start_says_so():
    with pytest.raises(WorkerError, match="exit code 1"):
        Worker("no such kind", (), 10.0)


def test_a_moment_without_packets_is_no_slow_line():
    """A busy computer loses some tenths of a second; a slow network stays slow."""
    counted = []

    def count(seconds, *rates):
        counted.append(seconds)
        return rates[len(counted) - 1]

    assert settled_rate(lambda s: count(s, 124.0), 125.0) == 124.0
    assert len(counted) == 1
    counted.clear()
    assert settled_rate(lambda s: count(s, 44.0, 125.0), 125.0) == 125.0
    assert counted[1] > counted[0]
    counted.clear()
    assert settled_rate(lambda s: count(s, 44.0, 45.0), 125.0) == 45.0


NEW = "5.23.0.0"
FRICTION = np.array([6.0, 6.0, 4.0, 1.2, 1.2, 1.2])
NOISE = 5 * 0.02 * np.array([13.0, 13.0, 11.0, 9.0, 9.0, 9.0])
"""N·m; five standard deviations of one packet."""


@pytest.mark.parametrize(
    ("version", "told"),
    [((5, 22, 9, 0), False), ((5, 23, 0, 0), True), ((10, 7, 0, 0), False), ((10, 11, 0, 0), True)],
)
def test_versions_that_tell_torques(version, told):
    assert (TORQUE in outputs_since(version)) == told


def test_an_older_controller_is_read_without(tmp_path):
    with closing(cases.start(tmp_path)) as sim:
        assert controller(sim.host, ("timestamp", TORQUE), 2.0)[1] == ("timestamp",)
        arm = open_arm(cases.config(sim.host))
        assert arm.sample().torque is None
        assert len(arm.workers) == 1
        arm.close()


def test_torques_hold_the_arm_and_the_friction_of_the_arrival(tmp_path):
    with closing(cases.start(tmp_path, "--version", NEW)) as sim:
        with closing(cases.controlled(sim)) as arm:
            for sign in (1.0, -1.0):
                q = arm.sample().q + 0.05 * sign
                arm.start_move(q, 0.5, 4.0)
                assert arm.sample().torque is None  # while it moves nothing is asked
                cases.finish(arm)
                arm.sample()
                sample = arm.sample()
                held = -sample.target_moment  # the simulated one is the load's
                assert np.all(np.abs(sample.torque - held - sign * FRICTION) < NOISE)
            receive, command, torques = arm.workers
            os.kill(torques, signal.SIGKILL)
            for _ in range(3):
                assert arm.sample().torque is None
            assert arm.workers == (receive, command)
            arm.take_control(cases.MASS, cases.COM)
            assert arm.sample().torque is not None
        assert cases.children() == []


def test_a_stalled_link_ends_the_torques_not_the_arm(tmp_path):
    with (
        closing(cases.start(tmp_path, "--version", NEW)) as sim,
        closing(open_arm(cases.config(sim.host))) as arm,
    ):
        (_, torques) = arm.workers
        os.kill(torques, signal.SIGSTOP)
        begun = time.monotonic()
        assert arm.sample().torque is None
        assert time.monotonic() - begun < 5.0
        assert arm.sample().torque is None
        assert len(arm.workers) == 1


JSON = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n%s"


def answer(body):
    return JSON % (len(body), body)


def test_what_is_asked_goes_over_the_wire_as_the_maker_says():
    with server(API, lambda asked: answer(b'{"state": "STOPPED"}')) as (host, asked):
        RobotApi(host, API).stop(2.0)
        RobotApi(host, API).order("/robotstate/v1/state", "POWER_ON", 2.0)
    assert asked[0].startswith(b"PUT /universal-robots/robot-api/program/v1/state HTTP/1.1\r\n")
    assert asked[0].endswith(b'{"action": "stop"}')
    assert b"Content-Type: application/json" in asked[0]
    assert asked[1].startswith(b"PUT /universal-robots/robot-api/robotstate/v1/state ")
    assert asked[1].endswith(b'{"action": "POWER_ON"}')


def test_a_path_that_has_moved_is_followed():
    def says(asked):
        if b"/moved" in asked:
            return answer(b'{"mode": "LOCAL"}')
        return b"HTTP/1.1 308 Permanent Redirect\r\nLocation: /moved\r\nContent-Length: 0\r\n\r\n"

    with server(API, says) as (host, _):
        assert RobotApi(host, API).in_remote_control(2.0) is False


def test_a_mute_one_costs_its_deadline_and_no_more():
    with socket.socket() as door:
        host = free_host()
        door.bind((host, API))
        door.listen()
        begun = time.monotonic()
        with pytest.raises(LinkError, match="in time"):
            RobotApi(host, API).describe(0.3)
        assert time.monotonic() - begun < 5.0
    with pytest.raises(LinkError, match="refuses"):
        RobotApi(host, API).check(0.3)


def package(kind, body):
    return struct.pack(">iB", 5 + len(body), kind) + body


def test_kinematics_are_found_among_other_packages():
    rows = np.arange(24.0)
    part = package(5, struct.pack(">6I24dI", *range(6), *rows, 2) + b"later fields")
    state = package(16, package(0, b"modes") + part + package(6, b"configuration"))
    said = package(20, b"a message") + package(16, package(0, b"modes")) + state
    with server(PRIMARY_PORT, lambda asked: said) as (host, _):
        kinematics = read_kinematics(host, 2.0)
    np.testing.assert_array_equal(kinematics.rows.ravel(), rows)
    assert (kinematics.status, kinematics.checksum) == (2, (0, 1, 2, 3, 4, 5))


ASK = {
    API: lambda host: RobotApi(host, API).stop(2.0),
    PRIMARY_PORT: lambda host: read_kinematics(host, 1.0),
}
NAN = package(16, package(5, struct.pack(">6I24dI", *range(6), *[float("nan")] * 24, 2)))


@pytest.mark.parametrize(
    ("port", "says", "words"),
    [
        (API, b"HTTP/1.1 403 Forbidden\r\nContent-Length: 0\r\n\r\n", "403"),
        (API, b'HTTP/1.1 500 Oh\r\nContent-Length: 17\r\n\r\n{"message": "no"}', '500 "no"'),
        (API, answer(b"<html>"), "JSON"),
        (API, b"HTTP/1.1 307 Go\r\nLocation: /again\r\nContent-Length: 0\r\n\r\n", "307"),
        *((API, says, "Robot API") for says in (b"", b"SSH-2.0-OpenSSH_9\r\n")),
        *((PRIMARY_PORT, says, "primary port") for says in (
            b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", struct.pack(">iB", 2, 16),
            package(16, struct.pack(">iB", 0, 5) + b"x"), NAN, package(20, b"") * 60,
        )),
    ],
)  # fmt: skip
def test_something_else_on_a_port_is_one_line(port, says, words):
    with (
        server(port, lambda asked: says) as (host, _),
        pytest.raises(LinkError, match=words) as refused,
    ):
        ASK[port](host)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("version", cases.GENERATIONS)
def test_a_controller_tells_the_kinematics_of_its_factory(tmp_path, version):
    made = write(tmp_path / "cal.toml", "ur10e")
    options = ("--version", version, "--calibration", str(tmp_path / "cal.toml"))
    with (
        closing(cases.start(tmp_path, *options)) as running,
        closing(open_arm(cases.config(running.host))) as arm,
    ):
        report = arm.report()
        np.testing.assert_allclose(report.kinematics.rows, made.rows, rtol=1e-9, atol=1e-9)
        assert report.kinematics.status == 2
        assert dict(report.fields)["kinematics"] == report.kinematics.to_dict()


def test_a_controller_without_a_calibration_tells_the_nominal_ones(tmp_path):
    with closing(cases.start(tmp_path)) as running:
        kinematics = read_kinematics(running.host, 2.0)
    np.testing.assert_allclose(kinematics.rows, nominal_rows(load_arm("ur10e")), rtol=0, atol=1e-12)
    assert kinematics.status == 0
