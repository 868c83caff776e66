"""A simulated ATI Net F/T: RDT on UDP, its page on HTTP; admin `force.sock`.

    python -m hilcal.drivers.simulated.netft_server --directory DIR --host 127.A.B.C [--port 49152]
        [--web-port 8081] --seed N [--rate HZ] [--on S]

Admin operations: `overload {force}` adds a wrench (6 numbers, N and N·m), `freeze {on}` repeats one
reading, `stall {on}` sends nothing while the measurements go on, `restart` as after a power cut: it
counts anew and waits for a request, `lose {share}` of the datagrams, `twice {share}` sends some
again later, `cut {share}` of them short, `status {word}` sends this status, `page {words}` other
elements of its page, `state`.

Source: as `hilcal.drivers.netft`. pynetft, a client of others, is tested against it.
"""

import contextlib
import select
import socket
import struct
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, HTTPServer
from typing import Any

import numpy as np

from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.force_server import LATE_S, TICK_S, StrainGauge

COUNTS = np.repeat((1_000_000.0, 1_000_000.0), 3)
NOISE = (0.02, 0.0005)
FULL = np.array([660.0, 660.0, 1980.0, 60.0, 60.0, 60.0])
"""Full scale, N and N·m; a Delta's."""
MEASURING_HZ = 7000
SATURATED = 0x80020000
_FACTORS = {"N": 1.0, "lbf": 1.0 / 4.4482216152605}


@dataclass(slots=True, eq=False)
class NetFt:
    """The sensor: who is sent to, and how far it has counted."""

    gauge: StrainGauge
    rng: np.random.Generator
    rate: float
    line: socket.socket
    client: tuple[str, int] | None = None  # address that asked for records; None is nobody
    left: int = 0  # how many records are left to send; 0 is without end
    number: int = 0
    due: float = 0.0  # when the next one is due, `time.monotonic`
    begun: float = field(default_factory=time.monotonic)
    stalled: bool = False
    lose: float = 0.0
    twice: float = 0.0  # share of datagrams that come again later
    cut: float = 0.0  # share of datagrams that are cut short
    status: int | None = None  # sent instead of its own where it is not None
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
            "comrdtrate": f"{self.rate:.0f}",
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
                self._asked(sender, *struct.unpack(">HHI", data))
        now = time.monotonic()
        if self.client is None or now < self.due:
            return
        count = int((now - self.due) * self.rate) + 1
        late = count - int(LATE_S * self.rate)
        if late > 0:
            self._skip(late)
            count -= late
        for wrench in self.gauge.read(count):
            self._skip(1)
            if not self.stalled:
                self._send(wrench)

    def _asked(self, sender: tuple[str, int], header: int, command: int, count: int) -> None:
        if header != 0x1234:
            return
        if command == 0:
            self.client = None
        elif command in (2, 3):
            self.client, self.left, self.number = sender, count, 0
            self.due = time.monotonic()

    def _skip(self, count: int) -> None:
        self.number += count
        self.due += count / self.rate

    def _send(self, wrench: Any) -> None:
        inside = np.clip(wrench, -FULL, FULL)
        over = SATURATED if np.any(inside != wrench) else 0
        status = over if self.status is None else self.status
        measured = int((self.due - self.begun) * MEASURING_HZ) & 0xFFFFFFFF
        unit = np.repeat([_FACTORS[self.elements.get("scfgfu", "N")], 1.0], 3)
        counts = np.rint(inside * unit * COUNTS).astype(int)
        record = struct.pack(">3I6i", self.number & 0xFFFFFFFF, measured, status, *counts)
        lost, again, cut = self.rng.random(3) < (self.lose, self.twice, self.cut)
        with contextlib.suppress(OSError):  # nobody listens there any more
            if not lost and self.client is not None:
                self.line.sendto(record[: 20 if cut else None], self.client)
                if again:
                    self.line.sendto(record, self.client)
        if self.left:
            self.left -= 1
            if not self.left:
                self.client = None

    def restart(self) -> None:
        """Count anew, and wait for a request."""
        self.client, self.number, self.begun = None, 0, time.monotonic()


def operations(sensor: NetFt) -> admin.Operations:
    """Return what can be asked of the sensor."""

    def state() -> dict[str, Any]:
        return {
            "frames": sensor.number,
            "bias": list(sensor.gauge.bias),
            "noise": list(sensor.gauge.noise),
            "streaming": sensor.client is not None,
        }

    own: dict[str, Callable[..., object]] = {
        "overload": sensor.gauge.add,
        "freeze": sensor.gauge.freeze,
        "stall": admin.setter(sensor, "stalled"),
        "restart": sensor.restart,
        "lose": admin.setter(sensor, "lose", float),
        "twice": admin.setter(sensor, "twice", float),
        "cut": admin.setter(sensor, "cut", float),
        "status": admin.setter(sensor, "status", lambda word: word),
        "page": admin.setter(sensor, "elements", dict),
    }
    return admin.Operations(own, state)


def serve_page(sensor: NetFt, host: str, port: int) -> None:
    """Answer on HTTP in a daemon thread."""

    class Page(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            there = self.path.split("?")[0] == "/netftapi2.xml"
            words = (sensor.page() if there else "not found").encode()
            self.send_response(200 if there else 404)
            self.send_header("Content-Type", "text/xml")
            self.send_header("Content-Length", str(len(words)))
            self.end_headers()
            self.wfile.write(words)

        def log_message(self, format: str, *args: Any) -> None:
            """Say nothing."""

    server = HTTPServer((host, port), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()


def main() -> None:
    """Run until the parent ends."""
    parser = admin.device_parser(__doc__)
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, default=49152)
    parser.add_argument("--web-port", type=int, default=8081)
    parser.add_argument("--rate", type=float, default=1000.0, help="records per second")
    parser.add_argument("--on", type=float, default=1200.0, help="s that it has been on")
    options = parser.parse_args()
    admin.end_with_parent()
    measuring, faults = np.random.default_rng(options.seed).spawn(2)
    board = Blackboard.attach(options.directory / "world.bin")
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((options.host, options.port))
    gauge = StrainGauge.draw(board, NOISE, measuring, options.on)
    sensor = NetFt(gauge, faults, options.rate, line)
    serve_page(sensor, options.host, options.web_port)
    admin.serve(options.directory / "force.sock", operations(sensor))
    while True:
        sensor.step()


if __name__ == "__main__":
    main()
