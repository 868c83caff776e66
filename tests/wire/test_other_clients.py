"""The simulated devices as programs of others meet them: clients written here from the protocols'
documents alone, libraries of others (ur_rtde, pymodbus), and byte transcripts of the makers'
manuals. UR's own library for Python is in no package registry; its recipes are asked for here.
"""

import csv
import struct

import numpy as np
import pytest

from hilcal.drivers.links import crc16 as crc16_of
from hilcal.drivers.links import crc_modbus, crc_x25
from hilcal.drivers.simulated.force_server import Ft300
from tests.support.geocom_cases import crc16
from tests.support.sim_ur_cases import ClientError, Wire, client, start
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


def test_an_unknown_protocol_is_not_spoken(arm):
    with Wire(arm.host) as wire:
        assert wire.ask("V", struct.pack(">H", 3)) == b"\x00"
        assert wire.ask("V", struct.pack(">H", 2)) == b"\x01"


# --- Modbus RTU: MODBUS over Serial Line V1.02, and Application Protocol V1.1b3 ------------------


def test_a_request_that_the_line_has_damaged_is_not_answered():
    request = b"\x09\x03" + struct.pack(">HH", 500, 1)
    whole = request + crc16(request, 0xFFFF).to_bytes(2, "little")
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        assert Ft300().receive(bytes(damaged), np.zeros(6)) == b""


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
