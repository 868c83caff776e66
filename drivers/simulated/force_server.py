"""A simulated force sensor on a pseudo-terminal: `DIR/force`, admin `force.sock`.

    python -m drivers.simulated.force_server --directory DIR --kind ft300|bota|hex --seed N
        [--rate HZ] [--on S]

Admin operations besides those of the line (`pty_port.FAULTS`): `overload {force}` adds a wrench
(6 numbers, N and N·m), `freeze {on}` repeats one reading, `stall {on}` stops sending while the
sensor's clock goes on, `state`; Bota: `saturate {on}` and `clock {us}`.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drivers.simulated import admin
from drivers.simulated.blackboard import Blackboard
from drivers.simulated.force.bota import Bota
from drivers.simulated.force.ft300 import Ft300
from drivers.simulated.force.gauge import Gauge
from drivers.simulated.force.hex import Hex
from drivers.simulated.force.sensor import SensorProtocol
from drivers.simulated.parent import end_with_parent
from drivers.simulated.pty_port import PtyPort

TICK_S = 0.004
"""Frames are handed over in batches at least so far apart, as a USB adapter does."""
LATE_S = 2.0
"""Frames that are later than this are lost: the process was suspended."""
KINDS: dict[str, type[Bota | Ft300 | Hex]] = {"bota": Bota, "ft300": Ft300, "hex": Hex}


@dataclass(slots=True, eq=False)
class Stream:
    """The sensor's clock: frame k is due at start + k / rate.

    Attributes:
        sensor: its protocol.
        gauge: its measuring bridge.
        port: its line.
        stalled: whether frames are made but not sent.
        number: of the next frame, since power-on.
        due: when it is due, `time.monotonic`.
        lost: frames that came too late to be sent.
    """

    sensor: SensorProtocol
    gauge: Gauge
    port: PtyPort
    stalled: bool = False
    number: int = 0
    due: float = 0.0
    lost: int = 0

    def step(self) -> None:
        """Wait for the next batch or for a request, and serve it."""
        until = min(self.due, self.port.next_arrival)
        data = self.port.read(max(TICK_S, until - time.monotonic()))
        if data:
            answer = self.sensor.receive(data, self.gauge.read(1)[0])
            if answer:
                self.port.send(answer)
        self.emit(time.monotonic())
        self.port.pump()

    def emit(self, now: float) -> None:
        """Send every frame that is due; after a delay all that were missed meanwhile."""
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

    def operate(self, op: str, arguments: dict[str, Any]) -> Any:
        """Carry out an admin operation and return the state."""
        match op:
            case "overload":
                force = np.asarray(arguments["force"], dtype=np.float64)
                if force.shape != (6,):
                    raise ValueError(f"force has the shape {force.shape}; valid: 6 numbers")
                self.gauge.overload = force
            case "freeze":
                self.gauge.frozen = self.gauge.read(1)[0] if arguments["on"] else None
            case "stall":
                self.stalled = bool(arguments["on"])
            case "state":
                pass
            case _:
                if not self.sensor.admin(op, arguments):
                    self.port.admin(op, arguments)
        return self.port.state() | {
            "bias": list(self.gauge.bias),
            "noise": list(self.gauge.noise),
            "temperature": self.gauge.temperature(),
            "rate": self.sensor.rate,
            "streaming": self.sensor.streaming,
            "stalled": self.stalled,
            "frames": self.number,
            "lost": self.lost,
        }


def main() -> None:
    """Run until the parent ends."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--directory", type=Path, required=True)
    parser.add_argument("--kind", choices=sorted(KINDS), required=True)
    parser.add_argument("--seed", type=int, required=True)
    parser.add_argument("--rate", type=float, help="frames per second")
    parser.add_argument("--on", type=float, default=1200.0, help="s that it has been on")
    options = parser.parse_args()
    end_with_parent()
    kind = KINDS[options.kind]
    sensor = kind() if options.rate is None else kind(options.rate)
    measuring, faults = np.random.default_rng(options.seed).spawn(2)
    board = Blackboard.attach(options.directory / "world.bin")
    gauge = Gauge.draw(board, sensor.noise, measuring, options.on)
    port = PtyPort(options.directory / "force", sensor.baud, faults)
    stream = Stream(sensor, gauge, port, due=time.monotonic())
    admin.serve(options.directory / "force.sock", stream.operate)
    while True:
        stream.step()


if __name__ == "__main__":
    main()
