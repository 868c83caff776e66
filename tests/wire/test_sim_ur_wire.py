"""The simulated UR controller byte by byte, through plain sockets."""

import struct

import numpy as np
import pytest

from hilcal.errors import DeviceError
from tests.support.sim_ur_cases import (
    Lines,
    Wire,
    send_script,
    start,
)

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
        wire.send("P")
        while (came := wire.receive())[0] == "U":  # under way before it was told
            pass
        assert came == ("P", b"\x01")


def test_clients_get_the_rate_that_they_asked_for(sim):
    with Wire(sim.host) as fast, Wire(sim.host) as slow:
        for wire, hz in ((fast, 250.0), (slow, 25.0)):
            wire.outputs("timestamp", hz)
            wire.ask("S")
            times = [struct.unpack(">Bd", wire.receive()[1])[1] for _ in range(int(hz))]
            assert times[-1] - times[0] == pytest.approx((hz - 1) / hz, abs=0.1)


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
        sim.wait("rtde_clients", 1)  # connected is who has been accepted, not who waits for it
        sim.admin("refuse", on=True)
        with pytest.raises(ConnectionRefusedError):
            Wire(sim.host)
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"
        sim.admin("refuse", on=False)
        with Wire(sim.host) as again:
            assert again.ask("V", struct.pack(">H", 2)) == b"\x01"


def test_who_comes_in_the_moment_of_a_refusal_is_served_or_sent_away(sim):
    ends = set()
    for _ in range(60):
        with Wire(sim.host) as wire:
            wire.socket.settimeout(2.0)
            sim.admin("refuse", on=True)
            try:
                wire.send("V", struct.pack(">H", 2))
                ends.add(wire.receive()[1])
            except ConnectionError:
                ends.add("reset")
            finally:
                sim.admin("refuse", on=False)
    assert ends <= {b"\x01", "reset"}


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


def test_unknown_operations_and_settings_are_refused(sim):
    with pytest.raises(DeviceError, match=r"'explode'; valid: state, protective_stop"):
        sim.admin("explode")
    with pytest.raises(DeviceError, match=r"speed_scaling = 2; valid: 0 to 1"):
        sim.admin("set", speed_scaling=2)
    with pytest.raises(DeviceError, match="four numbers"):
        sim.admin("set", version="5.11")
