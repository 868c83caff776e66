"""Parsers that face a wire, called on bytes: no socket, no port, no waiting.

The first byte of an input tells what was done to it: 0 damaged as a line damages, so that whatever
is accepted must be one of the sound readings; 1 with checksums mended, so that the inside is
reached and only what is physically possible may be accepted.
"""

import math
import struct
import time
from collections.abc import Sequence
from random import Random
from typing import Any

import minimalmodbus
import numpy as np
from geocompy import geo
from geocompy.geo import GeoCom

from hilcal.config.cell import Tracker
from hilcal.drivers import bota, ft300, geocom, onrobot_hex
from hilcal.drivers.force_stream import RING, ForceStream, SensorFormat
from hilcal.drivers.geocom import GeoComOptions, GeoComTracker, Link
from hilcal.measuring.devices import Clock
from tests.fuzz import controller, network
from tests.fuzz.damage import NUMBERS, bytes_damaged
from tests.fuzz.harness import Accepted, Parser, passed
from tests.fuzz.stand_ins import Port, Time, finite, instead
from tests.support.geocom_cases import crc16_arc, line

# --- frames of force sensors ---


def _sums(name: str) -> tuple[SensorFormat, int]:
    match name:
        case "ft300":
            return ft300.SENSOR, 0
        case "bota":
            return bota.SENSOR, 0
        case _:
            return onrobot_hex._sensor(50.0, 2000.0, 1000.0), 0


def _force(name: str) -> Parser:
    sensor, _ = _sums(name)
    form, unit = sensor.frame, sensor.unit
    rng = np.random.default_rng(1)

    def frame(k: int, wrench: Sequence[float] | None = None, **more: Any) -> bytes:
        body = np.zeros(1, dtype=sensor.body)
        given = rng.uniform(-80, 80, 6) / np.repeat((1, 20), 3) if wrench is None else wrench
        with np.errstate(all="ignore"):
            body["wrench"] = np.asarray(given) / unit
            for field, value in ({"ticks": k, "temperature": 25.0} | more).items():
                if field in (sensor.body.names or ()):
                    body[field] = value
        bare = form.header + body.tobytes()
        return bare + form.checksum(bare)

    def framed(body: bytes) -> bytes:
        return form.header + body + form.checksum(form.header + body)

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
        stream._kept, stream._failure = 0, ""
        at, seen = 1, []
        push = stream._deframer.push

        def noting(piece: bytes) -> list[bytes]:
            bodies = push(piece)
            seen.extend(bodies)
            return bodies

        stream._deframer.push = noting  # type: ignore[method-assign]
        step = 1 + data[-1] % 64
        while at < len(data):
            stream._take(data[at : at + step], time.monotonic_ns())
            at += step
        if not data[0]:
            kept = {tuple(row) for row in stream._wrench[: min(stream._kept, RING)].tolist()}
            for body in seen:
                if body not in sound and wrench_of(body) in kept - measured:
                    whole = [framed(one) for one in sound] if name != "hex" else []
                    raise passed(f"{name}: a frame", framed(body), whole)
        if not stream._kept:
            return False
        kept = stream._wrench[: stream._kept]
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
    virtual = Time()
    quiet: dict[str, Any] = {"drain": lambda *_: True, "time": virtual}
    port = Port()
    link = Link.__new__(Link)
    link._path, link._baud, link._port = "fuzz", 115200, port  # type: ignore[assignment]
    link._connection = geocom._Connection(port)  # type: ignore[arg-type]
    link._instrument = GeoCom.__new__(GeoCom)
    port.held = b"".join(line(f"%R1P,0,{k}", body) for k, body in enumerate(("0", "0,15", "0")))
    with instead(geocom, quiet), instead(geo, {"sleep": lambda _: None}):
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
            crc = crc16_arc(f"{bare}:{body}")
            mended = f"{bare},{crc}:{body}\r\n".encode("latin-1")
            return b"\1" + head + b"\r\n" + mended
        return b"\0" + damaged

    def parse(data: bytes) -> bool:
        port.held = data[1:]
        link._instrument.transaction_counter = 0
        tracker._full_known, tracker._last_ms = True, 0.0
        with instead(geocom, quiet):
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
    virtual = Time()
    port = Port()
    registers = [struct.pack(">4H", *range(k, k + 4)) for k in range(1, 3000, 97)]
    minimalmodbus_quiet = {"time": virtual}

    def answer(words: bytes, slave: int = 9, function: int = 3) -> bytes:
        bare = bytes([slave, function, len(words) % 256]) + words
        return bare + modbus_crc(bare)

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
            instead(ft300, {"drain": lambda *_: True}),
            instead(minimalmodbus, minimalmodbus_quiet),
        ):
            got = ft300.read_registers(port, 9, 500, 4)  # type: ignore[arg-type]
        if len(got) != 4 or not all(0 <= word < 65536 for word in got):
            raise Accepted("modbus: registers that cannot be")
        if not data[0] and got not in sound:
            raise passed("modbus", answer(struct.pack(">4H", *got)), corpus)
        return True

    return Parser("modbus", make, parse)


def modbus_crc(data: bytes) -> bytes:
    """Modbus over Serial Line V1.02, 6.2.2, bit by bit."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def parsers() -> list[Parser]:
    """All of them."""
    return [
        *(_force(name) for name in ("ft300", "bota", "hex")),
        _geocom(),
        _modbus(),
        controller.rtde(),
        controller.dashboard_server(),
        controller.primary_port(),
        controller.packet(),
        *network.parsers(),
    ]
