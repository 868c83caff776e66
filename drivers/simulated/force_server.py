"""A simulated force sensor: on a pseudo-terminal `DIR/force`, or in a network; admin `force.sock`.

    python -m hilcal.drivers.simulated.force_server --directory DIR --kind ft300|bota|hex|netft
        --seed N [--on S] [--host 127.A.B.C --port 49152 --web-port 8081]

Admin operations: `overload {force}` adds a wrench (6 numbers, N and N·m), `freeze {on}` repeats one
reading, `stall {on}` stops sending while its clock goes on, `state`; Bota: `saturate {on}` and
`clock {us}`; on a serial line those of `PtyPort.faults`.

An ATI Net F/T sends records by RDT on UDP and has a page on HTTP. Its additional operations:
`restart` as after a power cut (resets the counters and waits for a request), `lose {share}` of the
datagrams, `twice {share}` repeats some, `cut {share}` truncates some, `status {word}` sends this
status, `page {words}` changes elements of the page. Source: as `hilcal.drivers.netft`. pynetft, an
independent client, is tested against it.
"""

import contextlib
import select
import socket
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import numpy as np

from hilcal.drivers.links import crc_modbus, crc_x25
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.pty_port import PtyPort
from hilcal.types import Floats

TICK_S = 0.004  # least time between batches of frames, as from a USB adapter
LATE_S = 2.0  # frames later than this are lost: the process was suspended

BIAS_STD = np.repeat((4.0, 0.2), 3)  # zero of a new, mounted sensor, N and N·m
DRIFT_STD = np.repeat((0.05, 0.002), 3)
"""Drift of the zero with the sensor's temperature, N/K and N·m/K."""
WARM_K, WARM_S = 7.0, 600.0  # final temperature above the air, and its time constant (world time)
ROOM = 22.0  # air temperature if the world has none, °C


class StrainGauge:
    """The measuring bridge: wrench = true + bias + drift (T - T_start) + overload + noise."""

    def __init__(
        self, board: Blackboard, noise: tuple[float, float], rng: np.random.Generator, on: float
    ) -> None:
        """Draw a zero; `noise`: of a frame's force (N) and moment (N·m); `on`: for so many s."""
        self._board, self._rng, self._on = board, rng, on
        self._bias, self._drift = (std * rng.standard_normal(6) for std in (BIAS_STD, DRIFT_STD))
        self._noise = np.repeat(noise, 3)
        self._overload = np.zeros(6)
        self._frozen: Floats | None = None  # (6,) reading that is repeated

    def temperature(self) -> float:
        """Return the sensor's temperature, °C, which rises above that of the air."""
        air = float(self._board.read("truth")["air_temperature"])
        return float((air if air != 0.0 else ROOM) + self._self_heating(self._board.time))

    def read(self, count: int) -> Floats:
        """Return (count, 6) wrenches of the frames now due, N and N·m."""
        if self._frozen is not None:
            return np.tile(self._frozen, (count, 1))
        truth = self._board.read("truth")["sensor_wrench"]
        warming = self._self_heating(self._board.time) - self._self_heating(0.0)
        mean = truth + self._bias + self._drift * warming + self._overload
        return np.asarray(mean + self._noise * self._rng.standard_normal((count, 6)))

    def add(self, force: Sequence[float]) -> None:
        """Set the added wrench (6,), N and N·m."""
        wrench = np.asarray(force, dtype=np.float64)
        if wrench.shape != (6,):
            raise ValueError(f"force has the shape {wrench.shape}; valid: 6 numbers")
        self._overload = wrench

    def freeze(self, on: bool) -> None:
        """Repeat the present reading, or stop repeating."""
        self._frozen = self.read(1)[0] if on else None

    def faults(self, stream: object) -> dict[str, Callable[..., object]]:
        """Return the faults of the sensor and of its stream, by name."""
        stall = admin.setter(stream, "stalled")
        return {"overload": self.add, "freeze": self.freeze, "stall": stall}

    def state(self) -> dict[str, Any]:
        """Return zero and noise."""
        return {"bias": list(self._bias), "noise": list(self._noise)}

    def _self_heating(self, time: float) -> float:
        """Return the temperature above the air at a world time (s), K."""
        return float(WARM_K * (1.0 - np.exp(-(time + self._on) / WARM_S)))


class SensorProtocol:
    """A sensor's wire protocol; the base class streams from power-on and takes no commands."""

    baud = 0
    noise = (0.0, 0.0)
    rate = 1000.0  # frames per second
    streaming = True

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return frame `number` since power-on, with a wrench (6,) and a temperature, °C."""
        raise NotImplementedError

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Return the answer to bytes of the client, empty if none."""
        return b""

    def faults(self) -> dict[str, Callable[..., object]]:
        """Return the faults of this kind of sensor, by name."""
        return {}


class Bota(SensorProtocol):
    """Bota Systems Rokubi and SensONE; the frame is described in `hilcal.drivers.bota`."""

    baud = 460800
    noise = (0.05, 0.002)
    over_range = 1 << 1
    full = np.array([500.0, 500.0, 1200.0, 15.0, 15.0, 10.0])  # full scale of a SensONE, N and N·m
    _body = struct.Struct("<H6fIf")

    def __init__(self) -> None:
        self.saturated, self.start_us = False, 0

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `SensorProtocol.frame`."""
        clipped = np.clip(wrench, -self.full, self.full)
        status = self.over_range if self.saturated or np.any(clipped != wrench) else 0
        time_us = (self.start_us + round(number * 1e6 / self.rate)) & 0xFFFFFFFF
        body = self._body.pack(status, *clipped, time_us, temperature)
        return b"\xaa" + body + crc_x25(body)

    def faults(self) -> dict[str, Callable[..., object]]:
        """`saturate {on}` sets the status; `clock {us}` sets the time of frame 0."""
        clock = admin.setter(self, "start_us", int)
        return {"saturate": admin.setter(self, "saturated"), "clock": clock}


class Hex(SensorProtocol):
    """OptoForce (OnRobot) HEX, 10 to 1000 Hz, described in `hilcal.drivers.onrobot_hex`."""

    baud = 1_000_000
    noise = (0.05, 0.001)
    scale = np.repeat((50.0, 2000.0), 3)
    most, overload = 32767, 1 << 8

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `SensorProtocol.frame`."""
        counts = np.rint(wrench * self.scale)
        clipped = np.clip(counts, -self.most, self.most)
        status = self.overload if np.any(clipped != counts) else 0
        values = struct.pack(">HH6h", number & 0xFFFF, status, *map(int, clipped))
        body = b"\xaa\x07\x08\x10" + values
        return body + struct.pack(">H", sum(body) & 0xFFFF)


_SLAVE = 9
_READ, _WRITE_ONE, _WRITE_MANY = (3, 4), 6, 16
_BAD_FUNCTION, _BAD_ADDRESS, _BAD_VALUE = 1, 2, 3
_WRENCH_REGISTER, _STREAM_REGISTER, _STREAM = 180, 410, 0x0200
_STOP_BYTES = 50


class Ft300(SensorProtocol):
    """Robotiq FT 300, described in `hilcal.drivers.ft300`; its frames have no time."""

    baud = 19200
    noise = (0.1, 0.005)
    rate = 100.0
    full = np.repeat((300.0, 30.0), 3)  # full scale, N and N·m
    scale = np.repeat((100.0, 1000.0), 3)

    def __init__(self) -> None:
        self.streaming = False
        self._stop_bytes = 0
        self._inbox = bytearray()
        texts = {
            500: _text("SIM-1.0.10\0\0"),  # firmware
            510: [*_text("F3004242"), 2024],  # serial number and year
            _STREAM_REGISTER: [0],
        }
        self._registers = {
            start + i: value for start, values in texts.items() for i, value in enumerate(values)
        }

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `SensorProtocol.frame`."""
        return _checked(b"\x20\x4e" + struct.pack("<6h", *self._counts(wrench)))

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Answer Modbus requests; while streaming only the stop bytes count."""
        if self.streaming:
            for byte in data:
                self._stop_bytes = self._stop_bytes + 1 if byte == 0xFF else 0
                if self._stop_bytes >= _STOP_BYTES:
                    self.streaming = False
            return b""
        self._inbox += data
        answer = b""
        while not self.streaming and (request := self._request()):
            answer += self._answer(request, wrench)
        return answer

    def _counts(self, wrench: Floats) -> list[int]:
        clipped = np.clip(wrench, -self.full, self.full)
        return [int(value) for value in np.rint(clipped * self.scale)]

    def _request(self) -> bytes:
        """Remove a valid request to this slave from the inbox and return it; empty if none yet."""
        box = self._inbox
        while len(box) >= 8:
            length = 9 + box[6] if box[1] == _WRITE_MANY else 8
            if box[0] == _SLAVE and len(box) < length:
                break
            request = bytes(box[:length])
            if box[0] == _SLAVE and request == _checked(request[:-2]):
                del box[:length]
                return request
            del box[0]
        return b""

    def _answer(self, request: bytes, wrench: Floats) -> bytes:
        function = request[1]
        address, word = struct.unpack_from(">HH", request, 2)
        if function in _READ:
            live = {
                _WRENCH_REGISTER + i: count & 0xFFFF for i, count in enumerate(self._counts(wrench))
            }
            registers = self._registers | live
            numbers = range(address, address + word)
            if not 1 <= word <= 125:
                return _refusal(function, _BAD_VALUE)
            if not all(register in registers for register in numbers):
                return _refusal(function, _BAD_ADDRESS)
            content = struct.pack(f">{word}H", *(registers[register] for register in numbers))
            return _checked(bytes([_SLAVE, function, len(content)]) + content)
        if function == _WRITE_ONE:
            values = [word]
        elif function == _WRITE_MANY:
            if len(request) != 9 + 2 * word:
                return _refusal(function, _BAD_VALUE)
            values = list(struct.unpack_from(f">{word}H", request, 7))
        else:
            return _refusal(function, _BAD_FUNCTION)
        if address != _STREAM_REGISTER or len(values) != 1:
            return _refusal(function, _BAD_ADDRESS)
        self._stop_bytes = 0
        self.streaming = values[0] == _STREAM
        return _checked(request[:6])


def _text(text: str) -> list[int]:
    return [ord(a) << 8 | ord(b) for a, b in zip(text[::2], text[1::2], strict=True)]


def _checked(data: bytes) -> bytes:
    """Return data with its CRC-16/MODBUS."""
    return data + crc_modbus(data)


def _refusal(function: int, code: int) -> bytes:
    return _checked(bytes([_SLAVE, function | 0x80, code]))


KINDS: dict[str, type[SensorProtocol]] = {"bota": Bota, "ft300": Ft300, "hex": Hex}


@dataclass(slots=True, eq=False)
class Stream:
    """The sensor's clock: frame k is due at start + k / rate."""

    sensor: SensorProtocol
    gauge: StrainGauge
    port: PtyPort
    stalled: bool = False  # whether frames are due but not sent
    number: int = 0  # of the next frame, since power-on
    due: float = 0.0  # when the next frame is due, `time.monotonic`
    lost: int = 0  # frames too late to be sent

    def step(self) -> None:
        """Wait for the next batch or a request, and serve it."""
        until = min(self.due, self.port.next_arrival)
        data = self.port.read(max(TICK_S, until - time.monotonic()))
        if data:
            answer = self.sensor.receive(data, self.gauge.read(1)[0])
            if answer:
                self.port.send(answer)
        self.emit(time.monotonic())
        self.port.pump()

    def emit(self, now: float) -> None:
        """Send every frame due; after a delay also those missed, up to `LATE_S`."""
        period = 1.0 / self.sensor.rate
        if now < self.due:
            return
        count = int((now - self.due) / period) + 1
        if not self.sensor.streaming or self.stalled:
            self._skip(count, period)
            return
        late = count - int(LATE_S / period)
        if late > 0:
            self.lost += late
            self._skip(late, period)
            count -= late
        temperature = self.gauge.temperature()
        for wrench in self.gauge.read(count):
            self.port.send(self.sensor.frame(self.number, wrench, temperature), self.due)
            self._skip(1, period)

    def _skip(self, count: int, period: float) -> None:
        self.number += count
        self.due += count * period

    def operations(self) -> admin.Operations:
        """Return the admin operations."""
        faults = self.gauge.faults(self) | self.sensor.faults() | self.port.faults()
        return admin.Operations(faults, self.state)

    def state(self) -> dict[str, Any]:
        """Return sensor, line and faults."""
        return (
            self.port.state()
            | self.gauge.state()
            | {
                "temperature": self.gauge.temperature(),
                "rate": self.sensor.rate,
                "streaming": self.sensor.streaming,
                "stalled": self.stalled,
                "frames": self.number,
                "lost": self.lost,
            }
        )


COUNTS = np.repeat((1_000_000.0, 1_000_000.0), 3)
RDT_NOISE = (0.02, 0.0005)
FULL = np.array([660.0, 660.0, 1980.0, 60.0, 60.0, 60.0])  # full scale, N and N·m; a Delta's
RDT_HZ, MEASURING_HZ = 1000, 7000
SATURATED = 0x80020000
_FACTORS = {"N": 1.0, "lbf": 1.0 / 4.4482216152605}


@dataclass(slots=True, eq=False)
class NetFt:
    """An ATI Net F/T: its client and its counters."""

    gauge: StrainGauge
    rng: np.random.Generator
    line: socket.socket
    client: tuple[str, int] | None = None  # address to which records are sent; None: none
    remaining: int = 0  # number of records still to send; 0: endless
    number: int = 0
    due: float = 0.0  # when the next record is due, `time.monotonic`
    power_on: float = field(default_factory=time.monotonic)
    stalled: bool = False
    lose: float = 0.0
    twice: float = 0.0  # share of datagrams that are sent twice
    cut: float = 0.0  # share of datagrams that are truncated
    status: int | None = None  # sent in place of the true status; None: the true one
    elements: dict[str, str] = field(default_factory=dict)

    def page(self) -> str:
        """Return its page netftapi2.xml."""
        elements = {
            "prodname": "SIM NET F/T",
            "runstat": "0x00000000",
            "cfgcalsn": "FT31415",
            "scfgfu": "N",
            "scfgtu": "N-m",
            "cfgtfx": "0;0;0;0;0;0",
            "scfgtdu": "mm",
            "scfgtau": "degrees",
            "cfgcpf": f"{COUNTS[0]:.0f}",
            "cfgcpt": f"{COUNTS[3]:.0f}",
            "comrdte": "Enabled",
            "comrdtrate": f"{RDT_HZ}",
            "comrdtbsiz": "1",
            **self.elements,
        }
        lines = "".join(f"<{name}>{value}</{name}>\n" for name, value in elements.items() if value)
        return f'<?xml version="1.0"?>\n<netft>\n{lines}</netft>\n'

    def step(self) -> None:
        """Wait for a request or the next batch, and serve it."""
        wait = TICK_S if self.client is not None else 10 * TICK_S
        if select.select([self.line], [], [], wait)[0]:
            data, sender = self.line.recvfrom(64)
            if len(data) == 8:
                self._serve(sender, *struct.unpack(">HHI", data))
        now = time.monotonic()
        if self.client is None or now < self.due:
            return
        count = int((now - self.due) * RDT_HZ) + 1
        late = count - int(LATE_S * RDT_HZ)
        if late > 0:
            self._skip(late)
            count -= late
        for wrench in self.gauge.read(count):
            self._skip(1)
            if not self.stalled:
                self._send(wrench)

    def _serve(self, sender: tuple[str, int], header: int, command: int, count: int) -> None:
        if header != 0x1234:
            return
        if command == 0:
            self.client = None
        elif command in (2, 3):
            self.client, self.remaining, self.number = sender, count, 0
            self.due = time.monotonic()

    def _skip(self, count: int) -> None:
        self.number += count
        self.due += count / RDT_HZ

    def _send(self, wrench: Any) -> None:
        clipped = np.clip(wrench, -FULL, FULL)
        over = SATURATED if np.any(clipped != wrench) else 0
        status = over if self.status is None else self.status
        measured = int((self.due - self.power_on) * MEASURING_HZ) & 0xFFFFFFFF
        unit = np.repeat([_FACTORS[self.elements.get("scfgfu", "N")], 1.0], 3)
        counts = np.rint(clipped * unit * COUNTS).astype(int)
        record = struct.pack(">3I6i", self.number & 0xFFFFFFFF, measured, status, *counts)
        lost, twice, cut = self.rng.random(3) < (self.lose, self.twice, self.cut)
        with contextlib.suppress(OSError):  # nobody listens on the client's port
            if not lost and self.client is not None:
                self.line.sendto(record[: 20 if cut else None], self.client)
                if twice:
                    self.line.sendto(record, self.client)
        if self.remaining:
            self.remaining -= 1
            if not self.remaining:
                self.client = None

    def restart(self) -> None:
        """Reset the counters, and wait for a request."""
        self.client, self.number, self.power_on = None, 0, time.monotonic()

    def operations(self) -> admin.Operations:
        """Return the admin operations."""
        functions = self.gauge.faults(self) | {
            "restart": self.restart,
            **{name: admin.setter(self, name, float) for name in ("lose", "twice", "cut")},
            "status": admin.setter(self, "status", lambda word: word),
            "page": admin.setter(self, "elements", dict),
        }
        return admin.Operations(functions, self.state)

    def state(self) -> dict[str, Any]:
        """Return zero, noise and the state of sending."""
        return self.gauge.state() | {"frames": self.number, "streaming": self.client is not None}


def serve_page(sensor: NetFt, host: str, port: int) -> None:
    """Answer on HTTP in a daemon thread."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            known = self.path.split("?")[0] == "/netftapi2.xml"
            content = (sensor.page() if known else "not found").encode()
            self.send_response(200 if known else 404)
            self.send_header("Content-Type", "text/xml")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Log nothing."""

    server = HTTPServer((host, port), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()


def start(options: admin.Arguments) -> admin.Device:
    """Return a sensor in the network, with its page served, or on a serial line."""
    board = Blackboard(options.directory / "world.bin")
    noise, faults = np.random.default_rng(options.seed).spawn(2)
    sensor: NetFt | Stream
    if options.kind == "netft":
        line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        line.bind((options.host, options.port or 49152))
        sensor = NetFt(StrainGauge(board, RDT_NOISE, noise, options.on), faults, line)
        serve_page(sensor, options.host, options.web_port)
    else:
        protocol = KINDS[options.kind]()
        gauge = StrainGauge(board, protocol.noise, noise, options.on)
        port = PtyPort(options.directory / "force", protocol.baud, faults)
        sensor = Stream(protocol, gauge, port, due=time.monotonic())
    return sensor.operations(), sensor.step


OPTIONS: dict[str, dict[str, Any]] = {
    "--kind": {"choices": [*sorted(KINDS), "netft"], "required": True},
    "--host": {},
    "--port": {"type": int},
    "--web-port": {"type": int, "default": 8081},
    "--on": {"type": float, "default": 1200.0, "help": "s that it has been on"},
}

if __name__ == "__main__":
    admin.run(__doc__, "force", start, OPTIONS)
