"""Parsers that face a wire, called on bytes: no socket, no port, no waiting.

The first byte of an input tells what was done to it: 0 damaged as a line damages, so that whatever
is accepted must be one of the sound readings; 1 with checksums mended, so that the inside is
reached and only what is physically possible may be accepted.
"""

import math
import socket
import struct
import time
from collections.abc import Callable, Sequence
from random import Random
from types import SimpleNamespace
from typing import Any
from unittest import mock

import minimalmodbus
import numpy as np
from geocompy import geo
from geocompy.geo import GeoCom

from hilcal.config.cell import Tracker
from hilcal.drivers import bota, emscon, ft300, geocom, netft, onrobot_hex
from hilcal.drivers import emscon_packets as es
from hilcal.drivers import natnet as nn
from hilcal.drivers.emscon import EmsconConnection, EmsconTracker
from hilcal.drivers.force_stream import RING, ForceStream
from hilcal.drivers.geocom import GeoComOptions, GeoComTracker, Link
from hilcal.drivers.natnet import NatNetTracker
from hilcal.drivers.simulated.natnet_server import BODY, Cameras
from hilcal.drivers.ur_link import probe, reading, supervision
from hilcal.drivers.ur_link.probe import LinkError
from hilcal.measuring.devices import Clock
from tests.fuzz.damage import NUMBERS, bytes_damaged
from tests.fuzz.harness import Accepted, Parser, passed
from tests.support.geocom_cases import crc16, line

# --- what stands in for clocks, ports and sockets: it gives some bytes and never waits ---


class Time:
    """A clock that advances when it is read: deadlines pass without waiting."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        self.now += 1e-3
        return self.now

    def monotonic_ns(self) -> int:
        return int(1e9 * self.monotonic())

    def sleep(self, seconds: float) -> None:
        self.now += max(0.0, seconds)


class Port:
    """A serial port that holds some bytes and then is silent."""

    is_open, baudrate, timeout, port, in_waiting = True, 115200, 0.1, "fuzz", 0

    def __init__(self) -> None:
        self.held = b""

    def read(self, count: int = 1) -> bytes:
        out, self.held = self.held[:count], self.held[count:]
        return out

    def read_until(self, end: bytes) -> bytes:
        out, sep, self.held = self.held.partition(end)
        return out + sep

    def write(self, data: bytes) -> int:
        return len(data)

    def open(self) -> None: ...
    def close(self) -> None: ...
    def flush(self) -> None: ...
    def reset_input_buffer(self) -> None: ...
    def reset_output_buffer(self) -> None: ...


class Socket:
    """A connection that gives some bytes in pieces and then closes."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def recv(self, count: int) -> bytes:
        out, self._data = self._data[:count], self._data[count:]
        return out

    def settimeout(self, seconds: float) -> None: ...
    def close(self) -> None: ...
    def sendall(self, data: bytes) -> None: ...
    def shutdown(self, how: int) -> None: ...
    def __enter__(self) -> "Socket":
        return self

    def __exit__(self, *_: object) -> None: ...


def network(data: bytes) -> Any:
    """In place of the sockets of `ur_link.probe`: every connection gives these bytes."""
    fake = SimpleNamespace(
        create_connection=lambda *_, **__: Socket(data),
        gaierror=socket.gaierror,
        SHUT_WR=socket.SHUT_WR,
    )
    return mock.patch.object(probe, "socket", fake)


def finite(rng: Random) -> float:
    value = rng.choice(NUMBERS)
    return float(value) if rng.random() < 0.5 else rng.uniform(-1e3, 1e3)


# --- UR controllers ---


def _rtde_frame(kind: str, body: bytes) -> bytes:
    return struct.pack(">HB", (3 + len(body)) % 65536, ord(kind)) + body


def rtde() -> Parser:
    names = reading.OUTPUTS
    kinds = ",".join(["VECTOR6D"] * len(names)).encode()
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
        with network(data[1:]):
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
        with network(data[1:]):
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
        with network(data):
            kinematics = reading.read_kinematics("fuzz", 1.0)
        if not np.isfinite(kinematics.links).all():
            raise Accepted("primary: transforms that are no numbers")
        return True

    return Parser("primary", make, parse, refusals=(LinkError,))


def packet() -> Parser:
    """What the receive worker passes on: a packet whose numbers the network may have changed."""
    whole = {"robot_mode", "runtime_state", "safety_status_bits"}
    single = whole | {"timestamp", "speed_scaling", "target_speed_fraction", "payload"}
    size = {name: 1 if name in single else 6 for name in reading.OUTPUTS} | {"payload_cog": 3}
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
            several, values = values[:count], values[count:]
            one: Any = several[0] if several else 0.0
            if name in whole:
                one = int(one) if math.isfinite(one) else 0
            fields[name] = one if name in single else several
        got = reading.read({"host_ns": 1, "fields": fields}).sample
        if np.abs(got.q).max() > 100.0 or np.abs(got.joint_temperature).max() > 200.0:
            raise Accepted("packet: joints or temperatures that cannot be")
        return True

    return Parser("packet", make, parse, refusals=(LinkError,))


TARGET = np.array([0.5, 2.8, 0.4])


def _emscon() -> Parser:
    sound = []
    for turn in (None, np.array([0.5, 0.5, 0.5, 0.5])):
        cov = 1e-10 * np.eye(3)
        m = es.Measurement(TARGET, cov, turn, np.array([0.0, 1.57, 1.57]), cov)
        mode = es.STATIONARY if turn is None else es.STATIONARY_6D
        kind, packed = es.pack_measurement(m, mode, (20.0, 1013.0, 40.0))
        body = es.OK.to_bytes(4, "little") + packed
        change = es.HEADER.pack(12, es.CHANGE) + (7).to_bytes(4, "little")
        sound.append(change + es.HEADER.pack(8 + len(body), kind) + body)

    def make(by: Random) -> bytes:
        k = by.randrange(2)
        return bytes([k]) + (sound[k] if by.random() < 0.1 else bytes_damaged(sound[k], by, sound))

    def parse(data: bytes) -> bool:
        line = EmsconConnection.__new__(EmsconConnection)
        line.where, line.changes, line.open = "fuzz", [], True
        line._buffer, line._socket = bytearray(), Socket(data[1:])  # type: ignore[assignment]
        tracker = EmsconTracker.__new__(EmsconTracker)
        target = "pose" if data[0] else "position"
        tracker._options = emscon.EmsconOptions(target=target)  # type: ignore[arg-type]
        tracker._config, tracker._remarks, tracker._line = Tracker(), [], line
        tracker._ready = lambda seconds=0.0: np.inf  # type: ignore[method-assign]
        tracker._clock = Clock()
        tracker._do = lambda *words, until: b""  # type: ignore[assignment]
        sample = tracker.measure()
        if not (np.isfinite(sample.value).all() and np.linalg.eigvalsh(sample.covariance)[0] > 0.0):
            raise Accepted("emscon: a reading that cannot be")
        return True

    return Parser("emscon", make, parse)


def _natnet() -> Parser:
    rng = np.random.default_rng(1)
    cameras = Cameras(None, rng, None, (4, 1), 0.0, np.zeros((6, 4)), 0.0)  # type: ignore[arg-type]
    cameras.paused, cameras.newest, cameras.extra = True, (TARGET, np.array([0, 0, 0, 1.0])), 2
    cameras.board = type("Board", (), {"time": 1.0})()  # type: ignore[assignment]
    versions: tuple[nn.Version, ...] = ((3, 0), (4, 0), (4, 1), (4, 2))
    sound = [nn.message(nn.FRAME, cameras.frame(v)) for v in versions]
    sound += [nn.message(nn.DESCRIPTIONS, cameras.descriptions(v)) for v in versions]

    def make(by: Random) -> bytes:
        k = by.randrange(8)
        return bytes([k]) + (sound[k] if by.random() < 0.1 else bytes_damaged(sound[k], by, sound))

    def parse(data: bytes) -> bool:
        tracker = NatNetTracker.__new__(NatNetTracker)
        tracker.where, tracker._newest = "fuzz", -1
        version = versions[data[0] % 4]
        tracker._server = nn.NatNetServer("fuzz", "1", version, 0, "")
        if data[0] < 4:
            bodies = tracker._next(Socket(data[1:]))  # type: ignore[arg-type]
            for body in bodies or ():
                if body.tracked and not np.isfinite([*body.position, *body.quaternion]).all():
                    raise Accepted("natnet: a pose that cannot be")
            return any(b.number == BODY for b in bodies or ())
        tracker._options = type("Options", (), {"rigid_body": "tool"})()  # type: ignore[assignment]
        tracker._ask = lambda request, answer: data[5:]  # type: ignore[method-assign]
        return tracker._rigid_body()[1] == "tool"

    return Parser("natnet", make, parse)


def _page() -> Parser:
    words = b"<netft><prodname>x</prodname><cfgcpf>1000000</cfgcpf><cfgcpt>1000</cfgcpt>"
    words += b"<scfgfu>N</scfgfu><scfgtu>Nmm</scfgtu><comrdtrate>7000</comrdtrate></netft>"

    def make(by: Random) -> bytes:
        return words if by.random() < 0.1 else bytes_damaged(words, by)

    def parse(data: bytes) -> bool:
        sensor = netft.sensor_format(data.decode("utf-8", "replace"), netft.NetFtOptions(), "fuzz")
        counter = sensor.losses()
        if not (np.isfinite(sensor.unit).all() and (sensor.unit > 0).all() and counter.rate >= 0):
            raise Accepted("netft: units that cannot be")
        return True

    return Parser("netft_page", make, parse)


# --- frames of force sensors ---

SENSORS = {
    "ft300": ft300.SENSOR,
    "bota": bota.SENSOR,
    "hex": onrobot_hex._sensor(50.0, 2000.0, 1000.0),
}


def _force(name: str) -> Parser:
    sensor = SENSORS[name]
    form, unit = sensor.frame, sensor.unit
    rng = np.random.default_rng(1)

    def framed(body: bytes) -> bytes:
        return form.header + body + form.checksum(form.header + body)

    def frame(k: int, wrench: Sequence[float] | None = None, **more: Any) -> bytes:
        body = np.zeros(1, dtype=sensor.body)
        given = rng.uniform(-80, 80, 6) / np.repeat((1, 20), 3) if wrench is None else wrench
        with np.errstate(all="ignore"):
            body["wrench"] = np.asarray(given) / unit
            for field, value in ({"ticks": k, "temperature": 25.0} | more).items():
                if field in (sensor.body.names or ()):
                    body[field] = value
        return framed(body.tobytes())

    streams = [[frame(1000 * (k + 1)) for k in range(4)] for _ in range(32)]
    head = len(form.header)
    sound = {f[head:-2] for frames in streams for f in frames}

    def wrench_of(body: bytes) -> tuple[float, ...]:
        counts = np.frombuffer(body, dtype=sensor.body)[0]["wrench"]
        return tuple((counts * unit).tolist())

    measured = {wrench_of(body) for body in sound}
    port = Port()
    stream = ForceStream(port, sensor)  # type: ignore[arg-type]
    stream.close()
    fresh = type(stream._deframer)

    def make(by: Random) -> bytes:
        frames = list(by.choice(streams))
        if by.random() < 0.2:  # a value that no sensor gives, in a frame that is whole
            k = by.randrange(4)
            frames[k] = frame(
                1000 * (k + 1),
                [finite(by) for _ in range(6)],
                status=by.getrandbits(16),
                temperature=finite(by),
                ticks=by.getrandbits(16),
            )
            return b"\1" + b"".join(frames)
        return b"\0" + bytes_damaged(b"".join(frames), by, frames)

    def parse(data: bytes) -> bool:
        stream._deframer, stream._counter = fresh(form), sensor.losses()
        stream._count, stream._failure = 0, ""
        at, forces = 1, []
        push = stream._deframer.push

        def noting(piece: bytes) -> list[bytes]:
            bodies = push(piece)
            forces.extend(bodies)
            return bodies

        stream._deframer.push = noting  # type: ignore[method-assign]
        step = 1 + data[-1] % 64
        while at < len(data):
            stream._store(data[at : at + step], time.monotonic_ns())
            at += step
        if not data[0]:
            kept = {tuple(row) for row in stream._wrench[: min(stream._count, RING)].tolist()}
            for body in forces:
                if body not in sound and wrench_of(body) in kept - measured:
                    whole = [framed(one) for one in sound] if name != "hex" else []
                    raise passed(f"{name}: a frame", framed(body), whole)
        if not stream._count:
            return False
        kept = stream._wrench[: stream._count]
        if not np.all(np.isfinite(kept)):
            raise Accepted(f"{name}: a wrench that is not finite")
        stream._running = True
        sample = stream.latest()
        warm = sample.temperature
        if np.any(np.abs(sample.wrench) > 1e5) or (warm is not None and not -100 < warm < 200):
            raise Accepted(f"{name}: a wrench or a temperature that cannot be")
        return True

    return Parser(name, make, parse)


# --- GeoCOM ---


def _geocom() -> Parser:
    rng = np.random.default_rng(2)

    def quiet() -> Any:
        return mock.patch.multiple(geocom, drain=lambda *_: True, time=clock)

    clock = Time()
    port = Port()
    link = Link.__new__(Link)
    link._path, link._baud, link._port = "fuzz", 115200, port  # type: ignore[assignment]
    link._connection = geocom._Connection(port)  # type: ignore[arg-type]
    link._instrument = GeoCom.__new__(GeoCom)
    port.held = b"".join(line(f"%R1P,0,{k}", body) for k, body in enumerate(("0", "0,15", "0")))
    with quiet(), mock.patch.multiple(geo, sleep=lambda _: None):
        GeoCom.__init__(link._instrument, link._connection, attempts=1, checksum=True)
    config = Tracker(driver="geocom", port="fuzz")
    tracker = GeoComTracker(link, config, GeoComOptions(), Clock(1.0))

    def answers(values: Sequence[object], code: int = 0) -> bytes:
        text = ",".join(str(v) for v in values)
        return line("%R1P,0,0", "0") + line("%R1P,0,1", f"{code},{text}")

    readings = []
    for k in range(32):
        hz, v, d = rng.uniform(0, 6.2), rng.uniform(0.7, 2.2), rng.uniform(1.0, 9.0)
        readings.append((hz, v, 1.5e-6, 1e-5, -2e-5, 1e-6, d, 1000 + k))
    corpus = [answers(r) for r in readings]
    sound = {
        tuple(np.float64(r[6]) * np.array([math.sin(r[1]) * math.sin(r[0]),
              math.sin(r[1]) * math.cos(r[0]), math.cos(r[1])])) for r in readings
    }  # fmt: skip

    def make(by: Random) -> bytes:
        if by.random() < 0.3:
            values: list[object] = list(by.choice(readings))
            for _ in range(by.randint(1, 3)):
                match by.randrange(4):
                    case 0 if values:
                        del values[by.randrange(len(values))]
                    case 1:
                        values.append(by.choice(NUMBERS))
                    case _ if values:
                        values[by.randrange(len(values))] = by.choice(
                            (*NUMBERS, "", "'ff'", '"x"', "1e5", "--1", "0x1", "１")
                        )
            code = by.choice((0, 0, 0, 1283, 1284, 1285, 1293, 3, 3077, 99999, -1))
            return b"\1" + answers(values, code)
        damaged = bytes_damaged(by.choice(corpus), by, corpus)
        if by.random() < 0.2:  # a sound checksum over a damaged line
            head, _, rest = damaged.partition(b"\r\n")
            words = rest.rstrip(b"\r\n").split(b":", 1)
            bare = words[0].rsplit(b",", 1)[0].decode("latin-1")
            body = words[-1].decode("latin-1")
            crc = crc16(f"{bare}:{body}".encode())
            mended = f"{bare},{crc}:{body}\r\n".encode("latin-1")
            return b"\1" + head + b"\r\n" + mended
        return b"\0" + damaged

    def parse(data: bytes) -> bool:
        port.held = data[1:]
        link._instrument.transaction_counter = 0
        tracker._has_full, tracker._last_ms = True, 0.0
        with quiet():
            sample = tracker.measure()
        distance = float(np.linalg.norm(sample.value))
        if not np.all(np.isfinite(sample.covariance)) or not 0.1 < distance < 101.0:
            raise Accepted("geocom: a reading that cannot be")
        if not data[0]:
            near = min(np.abs(np.array(s) - sample.value).max() for s in sound)
            if near > 1e-12:
                raise passed("geocom", data[1:], corpus)
        return True

    return Parser("geocom", make, parse)


# --- Modbus ---


def _modbus() -> Parser:
    port, clock = Port(), Time()
    registers = [struct.pack(">4H", *range(k, k + 4)) for k in range(1, 3000, 97)]

    def answer(words: bytes, slave: int = 9, function: int = 3) -> bytes:
        bare = bytes([slave, function, len(words) % 256]) + words
        return bare + crc16(bare, 0xFFFF).to_bytes(2, "little")

    corpus = [answer(words) for words in registers]
    sound = {struct.unpack(">4H", words) for words in registers}

    def make(by: Random) -> bytes:
        if by.random() < 0.3:
            words = by.randbytes(by.choice((0, 1, 2, 6, 8, 8, 9, 250)))
            function = by.choice((3, 3, 4, 0x83, 0x84, by.randrange(256)))
            return b"\1" + answer(words, by.choice((9, 9, by.randrange(256))), function)
        return b"\0" + bytes_damaged(by.choice(corpus), by, corpus)

    def parse(data: bytes) -> bool:
        port.held = data[1:]
        with (
            mock.patch.multiple(ft300, drain=lambda *_: True),
            mock.patch.object(minimalmodbus, "time", clock),
        ):
            got = ft300.read_registers(port, 500, 4)  # type: ignore[arg-type]
        if len(got) != 4 or not all(0 <= word < 65536 for word in got):
            raise Accepted("modbus: registers that cannot be")
        if not data[0] and got not in sound:
            raise passed("modbus", answer(struct.pack(">4H", *got)), corpus)
        return True

    return Parser("modbus", make, parse)


def parsers() -> list[Parser]:
    """All of them."""
    return [
        *(_force(name) for name in SENSORS),
        _geocom(),
        _modbus(),
        rtde(),
        dashboard_server(),
        primary_port(),
        packet(),
        _emscon(),
        _natnet(),
        _page(),
    ]
