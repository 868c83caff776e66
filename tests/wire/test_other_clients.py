"""The simulated devices as programs of others meet them: clients written here from the protocols'
documents alone, libraries of others (ur_rtde, geocompy), and byte transcripts of the makers'
manuals. UR's own library for Python is in no package registry; its recipes are asked for here.
"""

import csv
import struct
from contextlib import contextmanager

import numpy as np
import pytest
import serial
from geocompy.communication import SerialConnection
from geocompy.geo import GeoCom
from geocompy.geo.gctypes import GeoComCode

from hilcal.calibration.urscript import movej_program, waypoints, with_joints
from hilcal.drivers.links import crc16 as crc16_of
from hilcal.drivers.links import crc_modbus, crc_x25
from hilcal.drivers.simulated.force_server import Ft300
from tests.support.instruments import TARGET, tracker
from tests.support.sim_ur_cases import (
    ClientError,
    Lines,
    Wire,
    client,
    send_script,
    start,
)
from tests.support.timing import wait_until


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    running = start(tmp_path_factory.mktemp("ur"))
    yield running
    running.close()


# --- RTDE: recipes of the record and control-loop examples of UR's client library ---------------

RECORD = {
    "timestamp": "DOUBLE", "target_q": "VECTOR6D", "target_qd": "VECTOR6D",
    "target_qdd": "VECTOR6D", "target_current": "VECTOR6D", "target_moment": "VECTOR6D",
    "actual_q": "VECTOR6D", "actual_qd": "VECTOR6D", "actual_current": "VECTOR6D",
    "joint_control_output": "VECTOR6D", "actual_TCP_pose": "VECTOR6D",
    "actual_TCP_speed": "VECTOR6D", "actual_TCP_force": "VECTOR6D", "target_TCP_pose": "VECTOR6D",
    "target_TCP_speed": "VECTOR6D", "actual_digital_input_bits": "UINT64",
    "joint_temperatures": "VECTOR6D", "actual_execution_time": "DOUBLE", "robot_mode": "INT32",
    "joint_mode": "VECTOR6INT32", "safety_mode": "INT32", "actual_tool_accelerometer": "VECTOR3D",
    "speed_scaling": "DOUBLE", "target_speed_fraction": "DOUBLE", "actual_momentum": "DOUBLE",
    "actual_main_voltage": "DOUBLE", "actual_robot_voltage": "DOUBLE",
    "actual_robot_current": "DOUBLE", "actual_joint_voltage": "VECTOR6D",
    "actual_digital_output_bits": "UINT64", "runtime_state": "UINT32",
    "joint_position_deviation_ratio": "DOUBLE",
}  # fmt: skip
FORMAT = {"DOUBLE": "d", "VECTOR6D": "6d", "VECTOR3D": "3d", "UINT64": "Q", "UINT32": "I",
          "INT32": "i", "VECTOR6INT32": "6i"}  # fmt: skip


def test_a_recorder_gets_every_output_that_it_asks_for(arm):
    layout = struct.Struct(">B" + "".join(FORMAT[kind] for kind in RECORD.values()))
    with Wire(arm.host) as wire:
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"
        assert len(struct.unpack(">4I", wire.ask("v"))) == 4
        asked = struct.pack(">d", 125.0) + ",".join(RECORD).encode()
        assert wire.ask("O", asked)[1:].decode().split(",") == list(RECORD.values())
        assert wire.ask("S") == b"\x01"
        stamps = []
        for _ in range(10):
            kind, body = wire.receive()
            assert kind == "U"
            values = layout.unpack(body)
            stamps.append(values[1])
            assert 0.0 <= values[-1] < 1.0  # joint_position_deviation_ratio; 1 stops the arm
        assert np.all(np.diff(stamps) > 0.0)
        wire.send("P")
        while (came := wire.receive())[0] == "U":
            pass
        assert came == ("P", b"\x01")


def test_a_control_loop_writes_and_two_cannot_hold_one_register(arm):
    setp = ",".join(f"input_double_register_{k}" for k in range(6)).encode()
    with Wire(arm.host) as wire, Wire(arm.host) as other:
        wire.outputs("target_q,target_qd,output_int_register_0")
        answer = wire.ask("I", setp)
        assert answer == bytes([answer[0]]) + b",".join([b"DOUBLE"] * 6)
        watchdog = wire.ask("I", b"input_int_register_0")
        assert watchdog[1:] == b"INT32"
        assert watchdog[0] != answer[0]
        wire.send("U", struct.pack(">B6d", answer[0], *range(6)))
        wire.send("U", struct.pack(">Bi", watchdog[0], -7))
        assert wire.ask("S") == b"\x01"
        assert wire.receive()[0] == "U"
        assert other.ask("V", struct.pack(">H", 2)) == b"\x01"
        assert other.ask("I", setp) == b"\0" + b",".join([b"IN_USE"] * 6)
        assert other.ask("I", b"no_such_register") == b"\0NOT_FOUND"
    with Wire(arm.host) as third:  # the registers are free when their holder has gone
        assert third.ask("V", struct.pack(">H", 2)) == b"\x01"
        wait_until(lambda: third.ask("I", setp)[0], "free: the registers")


def test_ur_rtde_records_and_writes_inputs(arm, tmp_path):
    """Its own record and control of inputs, by a library of the University of Southern Denmark."""
    path = tmp_path / "record.csv"
    with client(arm.host, "receive", "io") as run, client(arm.host) as other:
        assert run("receive", "startFileRecording", str(path))
        assert run("io", "setInputIntRegister", 19, -7)
        assert run("io", "setInputDoubleRegister", 19, 1.5)
        assert run("io", "setStandardDigitalOut", 1, True)
        with pytest.raises(ClientError, match="already in use"):
            other("io", "open", arm.host)
        wait_until(lambda: run("receive", "getActualDigitalOutputBits") & 1 << 1, "set: the output")
        assert run("receive", "stopFileRecording")
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    stamps = np.array([float(row["timestamp"]) for row in rows])
    assert len(np.unique(stamps)) > 2
    assert np.all(np.diff(stamps) >= 0.0)  # the library may write a package twice
    joints = [[float(row[f"actual_q_{j}"]) for j in range(6)] for row in rows]
    np.testing.assert_allclose(joints[-1], arm.admin()["q"], atol=1e-3)


# --- payload, dashboard and script port, as ur_rtde and the makers' pages use them ---------------


def test_payload_keeps_its_centre_when_told_zeros(arm):
    with client(arm.host, "control", "receive") as run:
        assert run("control", "setPayload", 2.5, [0.01, 0.02, 0.03])
        assert run("control", "setPayload", 3.5, [0.0, 0.0, 0.0])
        wait_until(lambda: run("receive", "getPayload") == 3.5, "told")
        assert run("receive", "getPayloadCog") == [0.01, 0.02, 0.03]


LOCAL = "Command is not allowed due to safety reasons, please switch robot to Remote Control mode"


def test_dashboard_answers(arm):
    with Lines(arm.host) as dashboard:
        assert dashboard.read() == "Connected: Universal Robots Dashboard Server"
        assert dashboard.ask("stop") == "Stopped"  # the program of the client before
        arm.wait("script_running", False)
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


def test_dashboard_connections_of_local_mode_stay_without_rights(arm):
    arm.admin("local_mode")
    with Lines(arm.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("is in remote control") == "false"
        assert dashboard.ask("stop").startswith(LOCAL)
        arm.admin("remote_mode")
        assert dashboard.ask("is in remote control") == "true"
        assert dashboard.ask("stop").startswith(LOCAL)
    with Lines(arm.host) as dashboard:
        dashboard.read()
        assert dashboard.ask("stop") == "Stopped"


Q = np.array([[0.1, -1.2, 1.5, -1.0, -1.4, 0.3], [0.3, -1.1, 1.4, -0.9, -1.5, 0.4]])
PROGRAM = """def prog():
  set_tcp(p[0,0,0.1,0,0,0])
  movej([0,-1.57,1.57,0,1.57,0], a=20, v=30) # first
  sleep(0.01)
  movel([0.1,-1.5,1.5,0,1.5,0], a=20, v=30, r=0.01)
end
"""


def reached(arm, text, goals):
    send_script(arm.host, text)
    moves = [f"move to {np.round(goal, 6).tolist()}" for goal in goals]
    wait_until(
        lambda: [line for _, line in arm.admin("log") if line in moves] == moves, f"moved {moves}"
    )
    arm.wait("script_running", False)
    state = arm.admin()
    np.testing.assert_allclose(state["q"], goals[-1], atol=1e-8)
    assert not state["moving"]


def test_a_program_of_compensated_points_is_carried_out(arm):
    reached(arm, movej_program(["a", "b"], Q).replace("])", "], a=20, v=30)"), Q)


def test_a_rewritten_program_goes_to_its_new_waypoints(arm):
    reached(arm, with_joints(PROGRAM, waypoints(PROGRAM), Q), Q)


def test_programs_with_other_statements_are_foreign_and_move_nothing(arm):
    before = arm.admin()["q"]
    send_script(arm.host, "def p():\n  movej([0,0,0,0,0,0])\n  while (True):\n  end\nend\n")
    wait_until(
        lambda: any("foreign program" in line for _, line in arm.admin("log")), "a foreign program"
    )
    assert arm.admin()["q"] == before


# --- Modbus RTU: MODBUS over Serial Line V1.02, and Application Protocol V1.1b3 ------------------


# --- GeoCOM: geocompy -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def station():
    with tracker(TARGET) as running:
        yield running


def cartesian(hz, v, distance):
    return distance * np.array([np.sin(v) * np.sin(hz), np.sin(v) * np.cos(hz), np.cos(v)])


@contextmanager
def geocom(station):
    port = serial.Serial(str(station.port), 115200, timeout=5.0, exclusive=True)
    with SerialConnection(port) as connection:
        yield GeoCom(connection, checksum=True)


def test_geocompy_reads_who_it_is(station):
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


def test_geocompy_reads_where_the_target_is(station):
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
        assert float(accuracy) == pytest.approx(
            (7.5e-6 + 3e-6 * float(np.linalg.norm(TARGET))) / float(np.linalg.norm(TARGET)),
            rel=1e-3,
        )
        assert abs(float(cross)) + abs(float(length)) < 1e-4
        assert 0 < at_ms <= station.board.time * 1e3
        simple = device.tmc.get_simple_measurement()
        assert simple.params[2] == distance  # of the same distance measurement
        angles = device.tmc.get_angle().params
        assert float(angles[0]) == pytest.approx(float(hz), abs=1e-4)


# --- transcripts ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "frame",
    [
        "09 10 01 9A 00 01 02 02 00 CD CA",  # Robotiq FT 300 manual: start of the data stream
        "09 10 03 E8 00 03 01 30",  # Robotiq Hand-E manual: response to function 16
        "09 04 07 D0 00 03 B1 CE",  # ... request of function 4
        "09 03 07 D0 00 03 04 0E",  # Robotiq 2-Finger gripper manual: request of function 3
        "09 03 06 39 00 00 FF 0E 0A F7 8B",  # ... its response
    ],
)
def test_checksums_of_the_makers_transcripts(frame):
    data = bytes.fromhex(frame)
    assert crc_modbus(data[:-2]) == data[-2:]


def test_the_makers_start_of_the_stream_starts_it():
    sensor = Ft300()
    answer = sensor.receive(bytes.fromhex("0910019A0001020200CDCA"), np.zeros(6))
    assert sensor.streaming
    assert answer[:6] == bytes.fromhex("0910019A0001")
    assert sensor.receive(b"\xff" * 50, np.zeros(6)) == b""
    assert not sensor.streaming


def test_check_values_of_the_checksums():
    """Of "123456789", as the catalogue of parametrised CRC algorithms (reveng) gives them."""
    assert crc_modbus(b"123456789") == bytes.fromhex("374B")
    assert crc_x25(b"123456789") == bytes.fromhex("6E90")
    assert crc16_of(b"123456789") == 0xBB3D
