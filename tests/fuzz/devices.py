"""The other side of each wire: what the simulated devices read."""

import atexit
import shutil
import struct
import tempfile
from pathlib import Path
from random import Random
from types import SimpleNamespace

import numpy as np

from drivers.simulated.blackboard import Blackboard
from drivers.simulated.force.ft300 import Ft300
from drivers.simulated.geocom.optics import Beam
from drivers.simulated.geocom.station import Station
from drivers.simulated.geocom_server import respond
from drivers.simulated.ur.rtde_link import RtdeLink
from drivers.simulated.ur.script import ScriptStream
from drivers.simulated.ur.server import Server, switched_on
from hilcal.robot.catalogue import load_arm
from tests.fuzz.damage import bytes_damaged, words_damaged
from tests.fuzz.harness import MEMORY_DISK, Parser
from tests.fuzz.wire import modbus_rtu_crc


class _Writer:
    """Takes what a link sends."""

    transport = SimpleNamespace(get_write_buffer_size=lambda: 0, abort=lambda: None)

    def is_closing(self) -> bool:
        return False

    def write(self, data: bytes) -> None: ...


def parsers() -> list[Parser]:
    """One for each that speaks."""
    folder = Path(tempfile.mkdtemp(prefix="hilcal-fuzz-", dir=MEMORY_DISK))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    board = Blackboard.create(folder / "world.bin", 1e9)
    rng = np.random.default_rng(0)
    state = switched_on(load_arm("ur10e"), board, (5, 11, 6, 0), rng)
    server = Server(state, board, "127.0.0.1", rng)
    return [_rtde(server), _lines(server), _geocom(board, rng), _ft300()]


def _rtde(server: Server) -> Parser:
    hello = [
        ("V", b"\0\2"),
        ("v", b""),
        ("O", struct.pack(">d", 125.0) + b"timestamp,actual_q,robot_mode,output_int_register_3"),
        ("I", b"input_int_register_20,input_double_register_21,speed_slider_mask"),
        ("S", b""),
        ("U", b"\1" + struct.pack(">idI", 3, 0.5, 0)),
        ("P", b""),
    ]

    def make(by: Random) -> bytes:
        out = b""
        for kind, body in hello:
            if by.random() < 0.4:
                body = bytes_damaged(body, by)
            out += struct.pack(">HB", len(body), ord(kind)) + body
        return out

    def parse(data: bytes) -> bool:
        link = RtdeLink(server.rtde, None, _Writer())  # type: ignore[arg-type]
        server.rtde.owners.clear()
        while len(data) >= 3:
            size, kind = struct.unpack_from(">HB", data)
            link._take(chr(kind), data[3 : 3 + size])
            data = data[3 + size :]
        if link._out is not None:
            link._data()
        return True

    return Parser("sim_rtde", make, parse, refusals=(struct.error, ValueError, IndexError))


def _lines(server: Server) -> Parser:
    programs = [
        "def a():\n  movej([0.1,-1.5,1,0,0,0], a=1.4, v=1.0, t=0, r=0)\nend\n",
        "stopj(2.0)\n",
        "def exec_move_path():\n  movej([0,0,0,0,0,0],a=1,v=1,r=0.0)\n end\nend\n",
        "global reg_offset_int = 0\n",
    ]
    asked = ["robotmode", "power on", "stop", "play", "unlock protective stop", "PolyscopeVersion"]

    def make(by: Random) -> bytes:
        text = by.choice(programs) if by.random() < 0.5 else by.choice(asked)
        return words_damaged(text, by).encode("utf-8", "replace")

    def parse(data: bytes) -> bool:
        server.dashboard.answer(data.decode("utf-8", "replace"), by_local(data))
        for text in ScriptStream().feed(data + b"\n"):
            server.controller.run(text)
        server.controller.step()
        server.controller.stop_program("the next input")
        return True

    def by_local(data: bytes) -> bool:
        return bool(data) and data[0] % 2 == 0

    return Parser("sim_script", make, parse)


def _geocom(board: Blackboard, rng: np.random.Generator) -> Parser:
    station = Station(board, Beam((1e-5, 0.0), (1e-5, 0.0)), rng, meas_s=0.0)
    lines = ["%R1Q,2008,1:1,1", "%R1Q,2167,2:3000,1", "%R1Q,9027,3:1.0,1.5,0,0,0", "%R1Q,107,0:15",
             "%R1Q,9037,4:0.1,0.1,0", "%R1Q,2028,5:6e-7,1013,20,20", "%R1Q,17017,6:2"]  # fmt: skip

    def make(by: Random) -> bytes:
        text = words_damaged(by.choice(lines), by)
        return bytes_damaged(text.encode("utf-8", "replace"), by) if by.random() < 0.3 else (
            text.encode("utf-8", "replace")
        )  # fmt: skip

    def parse(data: bytes) -> bool:
        return bool(respond(station, data.decode("ascii", "replace").strip()))

    return Parser("sim_geocom", make, parse)


def _ft300() -> Parser:
    sensor = Ft300()
    wrench = np.zeros(6)

    def request(body: bytes) -> bytes:
        return body + modbus_rtu_crc(body)

    asked = [
        request(b"\x09\x03\x01\xf4\x00\x02"),
        request(b"\x09\x10\x01\x9a\x00\x01\x02\x02\x00"),
        request(b"\x09\x04\x00\xb4\x00\x06"),
    ]

    def make(by: Random) -> bytes:
        data = bytes_damaged(by.choice(asked), by, asked)
        return request(data[:-2]) if by.random() < 0.6 else data

    def parse(data: bytes) -> bool:
        sensor._inbox.clear()
        sensor.streaming = False
        return bool(sensor.receive(data, wrench))

    return Parser("sim_ft300", make, parse)
