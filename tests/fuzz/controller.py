"""What a robot's controller says, called on bytes: RTDE, dashboard, and packets of a worker."""

import math
import struct
from collections.abc import Callable
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np

from hilcal.drivers.ur_link import lines, probe, reading, supervision
from hilcal.drivers.ur_link.lines import LinkError
from tests.fuzz.damage import bytes_damaged
from tests.fuzz.harness import Accepted, Parser
from tests.fuzz.stand_ins import Socket, finite, instead


def _rtde_frame(kind: str, body: bytes) -> bytes:
    return struct.pack(">HB", (3 + len(body)) % 65536, ord(kind)) + body


def rtde() -> Parser:
    names = reading.OUTPUTS
    kinds = ",".join("VECTOR6D" for _ in names).encode()
    version = _rtde_frame("V", b"\1")
    asked: list[tuple[bytes, Callable[[], object]]] = [
        (
            version
            + _rtde_frame("v", struct.pack(">4I", 5, 11, 6, 0))
            + _rtde_frame("O", b"\1" + kinds),
            lambda: probe.controller("fuzz", names, 1.0),
        ),
        (
            version
            + _rtde_frame("M", b"\5hello\3foo\1")
            + _rtde_frame("O", b"\1DOUBLE")
            + _rtde_frame("S", b"\1")
            + _rtde_frame("U", b"\1" + struct.pack(">d", 1.0)),
            lambda: probe.check_stream("fuzz", 1.0),
        ),
        (
            version + _rtde_frame("I", b"\1IN_USE,DOUBLE"),
            lambda: probe.in_use("fuzz", ("a", "b"), 1.0),
        ),
    ]
    corpus = [data for data, _ in asked]

    def make(by: Random) -> bytes:
        k = by.randrange(len(asked))
        if by.random() < 0.2:
            frames = [
                _rtde_frame(by.choice("VvOSUIPM?"), by.randbytes(by.choice((0, 1, 2, 16, 17, 300))))
                for _ in range(by.randint(1, 5))
            ]
            return bytes([k]) + by.choice((version, b"")) + b"".join(frames)
        return bytes([k]) + bytes_damaged(corpus[k], by, corpus)

    def parse(data: bytes) -> bool:
        with instead(lines, _network(data[1:])):
            asked[data[0] % len(asked)][1]()
        return True

    return Parser("rtde", make, parse, refusals=(LinkError,))


def dashboard_server() -> Parser:
    said = (
        b"Connected: Universal Robots Dashboard Server\n", b"UR10\n", b"20235500001\n",
        b"URSoftware 5.11.6.1010327 (Jan 01 2023)\n", b"Robotmode: RUNNING\n",
        b"Safetystatus: NORMAL\n", b"true\n", b"STOPPED <unnamed>\n",
    )  # fmt: skip
    corpus = [b"".join(said), said[0] + b"Stopped\n", said[0] + b"true\n",
              said[0] + b"could not understand: 'is in remote control'\n"]  # fmt: skip
    asked: list[Callable[[], object]] = [
        lambda: supervision.Dashboard("fuzz").describe(1.0),
        lambda: supervision.Dashboard("fuzz").stop(1.0),
        lambda: supervision.Dashboard("fuzz").in_remote_control(1.0),
    ]

    def make(by: Random) -> bytes:
        data = bytes_damaged(by.choice(corpus), by, corpus)
        if by.random() < 0.001:
            data *= 1 + 200_000 // max(1, len(data))
        return bytes([by.randrange(len(asked))]) + data

    def parse(data: bytes) -> bool:
        with instead(lines, _network(data[1:])):
            asked[data[0] % len(asked)]()
        return True

    return Parser("dashboard", make, parse, refusals=(LinkError,))


def primary_port() -> Parser:
    def package(kind: int, body: bytes) -> bytes:
        return struct.pack(">iB", 5 + len(body), kind) + body

    part = package(5, struct.pack(">6I24dI", *range(6), *(0.1 * k for k in range(24)), 2))
    state = package(16, package(0, bytes(47)) + part)
    corpus = [package(20, b"version") + state, state, package(16, package(0, bytes(47))) + state]

    def make(by: Random) -> bytes:
        return bytes_damaged(by.choice(corpus), by, corpus)

    def parse(data: bytes) -> bool:
        with instead(lines, _network(data)):
            found = reading.read_kinematics("fuzz", 1.0)
        if not np.isfinite(found.links).all():
            raise Accepted("primary: transforms that are no numbers")
        return True

    return Parser("primary", make, parse, refusals=(LinkError,))


def packet() -> Parser:
    """What the receive worker passes on: a packet whose numbers the network may have changed."""
    width = {"payload_cog": 3}
    single = {"timestamp", "robot_mode", "runtime_state", "safety_status_bits", "speed_scaling",
              "target_speed_fraction", "payload"}  # fmt: skip
    size = {name: 1 if name in single else width.get(name, 6) for name in reading.OUTPUTS}
    layout = struct.Struct(f">{sum(size.values())}d")
    usual = [0.5] * sum(size.values())

    def make(by: Random) -> bytes:
        values = list(usual)
        for _ in range(by.randint(1, 4)):
            values[by.randrange(len(values))] = finite(by)
        data = layout.pack(*values)
        return bytes_damaged(data, by) if by.random() < 0.5 else data

    def parse(data: bytes) -> bool:
        values = list(struct.unpack(f">{len(data) // 8}d", data[: len(data) // 8 * 8]))
        fields: dict[str, Any] = {}
        for name, count in size.items():
            taken, values = values[:count], values[count:]
            whole = name in ("robot_mode", "runtime_state", "safety_status_bits")
            one: Any = taken[0] if taken else 0.0
            if whole:
                one = int(one) if math.isfinite(one) else 0
            fields[name] = one if name in single else taken
        got = reading.read({"host_ns": 1, "fields": fields}).sample
        if np.abs(got.q).max() > 100.0 or np.abs(got.joint_temperature).max() > 200.0:
            raise Accepted("packet: joints or temperatures that cannot be")
        return True

    return Parser("packet", make, parse, refusals=(reading.ReadingError,))


def _network(data: bytes) -> dict[str, Any]:
    import socket

    fake = SimpleNamespace(
        create_connection=lambda *_, **__: Socket(data),
        gaierror=socket.gaierror,
        SHUT_WR=socket.SHUT_WR,
    )
    return {"socket": fake}
