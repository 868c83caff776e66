"""The simulated UR controller byte by byte, through plain sockets."""

import os
import signal
import socket
import struct
import subprocess
import sys
import time

import numpy as np
import psutil
import pytest
from sim_ur_cases import (
    ROOT,
    Lines,
    Wire,
    command,
    environment,
    free_host,
    send_script,
    start,
)

from drivers.simulated.blackboard import Blackboard
from hilcal.errors import DeviceError

COMMANDS = ",".join(
    ["input_int_register_24", *(f"input_double_register_{k}" for k in range(24, 32))]
)
LOCAL = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode"


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    sim = start(tmp_path_factory.mktemp("u"))
    yield sim
    sim.close()


@pytest.fixture
def sim(shared):
    yield shared
    for op in ("rtde_stall", "rtde_mute", "dashboard_mute", "refuse"):
        shared.admin(op, on=False)
    shared.admin("remote_mode")
    shared.wait("rtde_clients", 0)


def test_version_and_negotiation(sim):
    with Wire(sim.host) as wire:
        assert wire.ask("V", struct.pack(">H", 1)) == b"\x00"
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"
        assert struct.unpack(">4I", wire.ask("v")) == (5, 11, 6, 1010327)
        answer = wire.ask("O", struct.pack(">d", 125.0) + b"timestamp,nonsense,robot_mode")
        assert answer == b"\x01DOUBLE,NOT_FOUND,INT32"
        assert wire.ask("I", b"input_int_register_24,nonsense") == b"\x00INT32,NOT_FOUND"
        assert wire.ask("I", b"input_int_register_24") == b"\x01INT32"
        assert wire.ask("I", b"speed_slider_mask,speed_slider_fraction") == b"\x02UINT32,DOUBLE"
        with Wire(sim.host) as other:
            assert other.ask("I", b"input_int_register_24") == b"\x00IN_USE"
            assert other.ask("I", b"input_int_register_25") == b"\x01INT32"
        wire.socket.close()
        sim.wait("rtde_clients", 0)
    with Wire(sim.host) as wire:
        assert wire.ask("I", b"input_int_register_24") == b"\x01INT32"


def test_data_frames_have_the_layout_that_was_agreed(sim):
    names = "timestamp,actual_q,runtime_state,safety_status_bits,payload_cog,joint_mode"
    with Wire(sim.host) as wire:
        kinds = wire.outputs(names, 500.0)
        assert kinds == "DOUBLE,VECTOR6D,UINT32,UINT32,VECTOR3D,VECTOR6INT32"
        assert wire.ask("S") == b"\x01"
        times = []
        for _ in range(100):
            kind, body = wire.receive()
            assert kind == "U"
            number, stamp, *rest = struct.unpack(">Bd6dII3d6i", body)
            assert number == 1
            times.append(stamp)
        np.testing.assert_allclose(rest[:6], sim.admin()["q"], atol=5e-5)
        assert rest[6:8] == [1, 1]
        assert rest[11:] == [253] * 6
        assert np.all(np.diff(times) > 0.0)
        assert wire.ask("P") == b"\x01"


def test_clients_get_the_rate_that_they_asked_for(sim):
    with Wire(sim.host) as fast, Wire(sim.host) as slow:
        for wire, hz in ((fast, 250.0), (slow, 25.0)):
            wire.outputs("timestamp", hz)
            wire.ask("S")
            times = [struct.unpack(">Bd", wire.receive()[1])[1] for _ in range(int(hz))]
            assert times[-1] - times[0] == pytest.approx((hz - 1) / hz, abs=0.1)


def test_older_controllers_do_not_know_everything(tmp_path):
    sim = start(tmp_path, 1.0, None, "--version", "5.5.0.0")
    try:
        with Wire(sim.host) as wire:
            kinds = wire.outputs("payload,payload_cog,ft_raw_wrench")
            assert kinds == "DOUBLE,NOT_FOUND,NOT_FOUND"
    finally:
        sim.close()


def test_nonsense_ends_the_connection_and_nothing_else(sim):
    for data in (b"\x00\x04U\x09", b"\x00\x03U", b"\x00\x04V\x01", b"\x00\x0bO" + b"\xff" * 8):
        with Wire(sim.host) as wire:
            wire.socket.sendall(data)
            with pytest.raises(ConnectionError):
                wire.exactly(1)
    with Wire(sim.host) as wire:
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"


def test_mute_answers_nothing(sim):
    sim.admin("rtde_mute", on=True)
    with Wire(sim.host) as wire:
        wire.send("V", struct.pack(">H", 2))
        wire.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            wire.receive()


def test_stall_stops_the_data_and_only_that(sim):
    sim.admin("rtde_stall", on=True)
    with Wire(sim.host) as wire:
        wire.outputs("timestamp")
        assert wire.ask("S") == b"\x01"
        wire.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            wire.receive()
        sim.admin("rtde_stall", on=False)
        wire.socket.settimeout(5.0)
        assert wire.receive()[0] == "U"


def test_drop_and_half_frame(sim):
    with Wire(sim.host) as wire:
        wire.outputs("actual_q", 1.0)
        wire.ask("S")
        assert len(wire.receive()[1]) == 49
        sim.admin("rtde_half_frame")
        half = wire.exactly(26)
        assert half[:3] == b"\x00\x34U"
        wire.socket.settimeout(0.2)
        with pytest.raises(TimeoutError):
            wire.exactly(1)
        sim.admin("rtde_drop")
        wire.socket.settimeout(5.0)
        with pytest.raises(ConnectionError):
            wire.exactly(1)


def test_refused_connections_leave_the_others_alone(sim):
    with Wire(sim.host) as wire:
        sim.admin("refuse", on=True)
        with pytest.raises(ConnectionRefusedError):
            Wire(sim.host)
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"
        sim.admin("refuse", on=False)
        with Wire(sim.host) as again:
            assert again.ask("V", struct.pack(">H", 2)) == b"\x01"


def test_dashboard_answers(sim):
    with Lines(sim.host) as dashboard:
        assert dashboard.read() == "Connected: Universal Robots Dashboard Server"
        assert dashboard.ask("PolyscopeVersion").startswith("URSoftware 5.11.6.1010327 ")
        assert dashboard.ask("get robot model") == "UR10e"
        assert dashboard.ask("get serial number").isdigit()
        assert dashboard.ask("robotmode") == "Robotmode: RUNNING"
        assert dashboard.ask("safetystatus") == "Safetystatus: NORMAL"
        assert dashboard.ask("running") == "Program running: false"
        assert dashboard.ask("programState").split()[0] == "STOPPED"
        assert dashboard.ask("play") == "Failed to execute: play"
        assert dashboard.ask("close safety popup") == "closing safety popup"
        assert dashboard.ask("dance") == "could not understand: 'dance'"
        assert dashboard.ask("quit") == "Disconnected"
        assert dashboard.read() == ""


def test_dashboard_connections_of_local_mode_stay_without_rights(sim):
    sim.admin("local_mode")
    with Lines(sim.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("is in remote control") == "false"
        assert dashboard.ask("stop").startswith(LOCAL)
        sim.admin("remote_mode")
        assert dashboard.ask("is in remote control") == "true"
        assert dashboard.ask("stop").startswith(LOCAL)
    with Lines(sim.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("stop") == "Stopped"


def test_mute_and_dropped_dashboard(sim):
    with Lines(sim.host) as dashboard:
        dashboard.read()
        sim.admin("dashboard_mute", on=True)
        dashboard.socket.settimeout(0.3)
        with pytest.raises(TimeoutError):
            dashboard.ask("running")
    with Lines(sim.host) as dashboard:
        sim.wait("dashboard_clients", 1)
        sim.admin("dashboard_drop")
        assert dashboard.stream.read() == b""


def handshake(wire, number, *arguments):
    """One command as the client library gives it: until done, and back to ready."""
    values = [*arguments, *[0.0] * (8 - len(arguments))]
    for word, state in ((number, 2), (0, 1)):
        wire.send("U", struct.pack(">Bi8d", 1, word, *values))
        for _ in range(2000):
            _, *answer = struct.unpack(">Bi6d", wire.receive()[1])
            if answer[0] == state:
                break
        else:
            raise AssertionError(f"state {state} never came")
        if word:
            result = answer[1:]
    return result


def play_control_script(sim, wire):
    """Upload something that the simulator takes for the client library's control script."""
    assert wire.ask("I", COMMANDS.encode())[0] == 1
    wire.send("U", struct.pack(">Bi8d", 1, 0, *[0.0] * 8))  # registers keep what was written last
    send_script(sim.host, "def rtde_control():\n    global reg_offset_int = #\n    24\nend\n")
    sim.wait("runtime", 2)


def test_register_handshake_of_the_control_script(sim):
    names = ",".join(
        ["output_int_register_24", *(f"output_double_register_{k}" for k in range(24, 30))]
    )
    with Wire(sim.host) as wire:
        wire.outputs(names, 250.0)
        play_control_script(sim, wire)
        wire.ask("S")
        handshake(wire, 17, 4.25, 0.1, 0.2, 0.3)
        assert sim.admin()["payload"] == 4.25
        assert sim.admin()["payload_com"] == [0.1, 0.2, 0.3]
        pose = handshake(wire, 43)
        assert np.linalg.norm(pose[:3]) > 0.5
        goal = sim.admin()["q"]
        goal[4] += 0.05
        handshake(wire, 1, *goal, 1.0, 4.0)
        assert sim.admin()["q"] == pytest.approx(goal, abs=1e-12)
        wire.send("U", struct.pack(">Bi8d", 1, 255, *[0.0] * 8))
        sim.wait("script_running", False)


@pytest.mark.parametrize(("number", "speed"), [(3, 0.5), (1, 0.0), (1, float("nan"))])
def test_what_is_not_emulated_or_impossible_ends_the_program(sim, number, speed):
    with Wire(sim.host) as wire:
        play_control_script(sim, wire)
        q = sim.admin()["q"]
        wire.send("U", struct.pack(">Bi8d", 1, number, *q[:5], q[5] + 0.1, speed, 1.0))
        sim.wait("script_running", False)
        assert sim.admin()["q"] == q


def test_the_truth_is_what_the_sensors_tell(tmp_path):
    rng = np.random.default_rng(4)
    truth = {
        "encoder": rng.normal(size=6),
        "joint_temperature": 30.0 + rng.normal(size=6),
        "drive_torque": 20.0 * rng.normal(size=6),
        "sensor_wrench": np.array([1.0, 2.0, -60.0, 0.5, 0.25, 0.0]),
    }
    sim = start(tmp_path, 1.0, {**truth, "arrivals": 0})
    names = (
        "actual_q,joint_temperatures,target_moment,ft_raw_wrench,actual_TCP_force,target_current"
    )

    def values():
        with Wire(sim.host) as wire:
            wire.outputs(names)
            wire.ask("S")
            return np.array(struct.unpack(">B36d", wire.receive()[1])[1:]).reshape(6, 6)

    try:
        q, temperature, moment, wrench, force, current = values()
        np.testing.assert_array_equal(q, truth["encoder"])
        np.testing.assert_array_equal(temperature, truth["joint_temperature"])
        np.testing.assert_array_equal(moment, truth["drive_torque"])
        assert np.all(np.sign(current) == np.sign(moment))
        offset = wrench - truth["sensor_wrench"]
        assert 2.0 < np.linalg.norm(offset[:3]) < 10.0
        # no payload was told: what the controller calls contact is all of the load
        assert np.linalg.norm(force[:3]) == pytest.approx(np.linalg.norm(wrench[:3]), rel=1e-9)
        sim.board.write("truth", arrivals=7)  # not that of this arm's rest
        np.testing.assert_allclose(values()[0], sim.admin()["q"], atol=5e-5)
    finally:
        sim.close()


def test_polyscope_x_has_no_dashboard(tmp_path):
    sim = start(tmp_path, 1.0, None, "--version", "10.7.0.0")
    try:
        with pytest.raises(ConnectionRefusedError):
            Lines(sim.host)
        with Wire(sim.host) as wire:
            assert struct.unpack(">4I", wire.ask("v"))[0] == 10
    finally:
        sim.close()


def test_unknown_operations_and_settings_are_refused(sim):
    with pytest.raises(DeviceError, match=r"'explode'; valid: state, protective_stop"):
        sim.admin("explode")
    with pytest.raises(DeviceError, match=r"speed_scaling = 2; valid: 0 to 1"):
        sim.admin("set", speed_scaling=2)
    with pytest.raises(DeviceError, match="four numbers"):
        sim.admin("set", version="5.11")


@pytest.mark.parametrize("port", [29999, 30003, 30004])
def test_an_address_in_use_is_refused(tmp_path, port):
    Blackboard.create(tmp_path / "world.bin", 1.0)
    host = free_host()
    with socket.socket() as taken:
        taken.bind((host, port))
        taken.listen()
        keep = subprocess.Popen(
            command(tmp_path, host),
            stdin=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env=environment(),
        )
        try:
            assert keep.wait(20) == 3
            text = keep.stderr.read().decode()
        finally:
            keep.kill()
            keep.stdin.close()
            keep.stderr.close()
            keep.wait()
    assert text.count("\n") == 1
    assert f"{host}:{port} is in use" in text
    assert not (tmp_path / "arm.sock").exists()


def test_a_restarted_controller_finds_its_arm_where_it_was(tmp_path):
    sim = start(tmp_path)
    q = sim.admin()["q"]
    sim.close()
    (tmp_path / "arm.sock").unlink()
    board = Blackboard.attach(tmp_path / "world.bin")
    q[2] += 0.5
    board.write("arm", q=q, moving=1.0, arrivals=41)
    process = subprocess.Popen(
        command(tmp_path, sim.host), stdin=subprocess.PIPE, env=environment()
    )
    try:
        deadline = time.monotonic() + 20.0
        while not (tmp_path / "arm.sock").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        state = sim.admin()
        assert state["q"] == q
        assert state["arrivals"] == 42
        assert board.read("arm")["arrivals"] == 42
    finally:
        process.stdin.close()
        process.wait(10)


def test_dies_on_request_and_with_its_parent(tmp_path):
    sim = start(tmp_path)
    with pytest.raises(DeviceError):
        sim.admin("die")
    assert sim.process.wait(5) == 1
    sim.close()
    (tmp_path / "arm.sock").unlink()
    code = (
        "import subprocess, sys, time\n"
        f"p = subprocess.Popen({command(tmp_path, sim.host)!r}, stdin=subprocess.PIPE)\n"
        "print(p.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment(), cwd=ROOT
    )
    child = psutil.Process(int(parent.stdout.readline()))
    try:
        deadline = time.monotonic() + 20.0
        while not (tmp_path / "arm.sock").exists():
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
        psutil.wait_procs([child], timeout=5.0)
        assert not child.is_running() or child.status() == psutil.STATUS_ZOMBIE
    finally:
        parent.kill()
        parent.stdout.close()
        parent.wait()
