"""Simulated serial instruments for tests: a process of its own, a world that the test writes."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.drivers.simulated.admin import ask
from hilcal.drivers.simulated.blackboard import Blackboard

START_S = 30.0
TRACKER_NOISE = (
    ("--range-std", "5e-6", "0.15e-6"),
    ("--transverse-std", "7.5e-6", "3e-6"),
)


@dataclass(eq=False)
class Instrument:
    """A running simulated instrument."""

    port: Path  # the name to open
    socket: Path  # its admin socket
    board: Blackboard  # the shared world; the test is its writer
    process: subprocess.Popen[bytes]  # the server

    def admin(self, op: str, **arguments: Any) -> Any:
        """Switch a fault, or ask for the state."""
        return ask(self.socket, op, **arguments)

    def truth(self, **fields: Any) -> None:
        """Write what is true in the world, e.g. `target` or `sensor_wrench`."""
        self.board.write("truth", time=self.board.time, **fields)

    def close(self) -> None:
        """End the server as the end of its parent would."""
        assert self.process.stdin is not None
        if not self.process.stdin.closed:
            self.process.stdin.close()
        try:
            self.process.wait(5.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            raise


def start(module: str, name: str, directory: Path, scale: float, *options: str) -> Instrument:
    """Start `python -m hilcal.drivers.simulated.<module>` and wait until it is ready."""
    world = directory / "world.bin"
    board = Blackboard(world) if world.exists() else Blackboard.create(world, scale)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            f"hilcal.drivers.simulated.{module}",
            "--directory",
            directory,
            *options,
        ],
        stdin=subprocess.PIPE,
    )
    instrument = Instrument(directory / name, directory / f"{name}.sock", board, process)
    deadline = time.monotonic() + START_S
    while not instrument.socket.exists():
        if process.poll() is not None or time.monotonic() > deadline:
            process.kill()
            process.wait()
            assert process.stdin is not None
            process.stdin.close()
            raise AssertionError(f"{module} did not start (exit code {process.returncode})")
        time.sleep(0.01)
    return instrument


@contextmanager
def tracker(
    target: tuple[float, float, float] | None = (0.5, 2.8, 0.4),
    *options: str,
    scale: float = 20.0,
    seed: int = 1,
) -> Iterator[Instrument]:
    """Run a GeoCOM station that sees `target` (its own axes, m), None for an empty world."""
    noise = [word for option in TRACKER_NOISE for word in option]
    with tempfile.TemporaryDirectory() as directory:
        instrument = start(
            "geocom_server",
            "tracker",
            Path(directory),
            scale,
            *noise,
            "--seed",
            str(seed),
            *options,
        )
        try:
            if target is not None:
                instrument.truth(target=np.array(target))
            yield instrument
        finally:
            instrument.close()


@contextmanager
def force_sensor(
    kind: str,
    wrench: tuple[float, ...] = (1.0, -2.0, 30.0, 0.1, 0.2, -0.3),
    *options: str,
    scale: float = 1.0,
    seed: int = 1,
) -> Iterator[Instrument]:
    """Run a force sensor ("ft300", "bota", "hex") that feels `wrench` (its axes, N and N·m)."""
    with tempfile.TemporaryDirectory() as directory:
        world = Blackboard.create(Path(directory) / "world.bin", scale)
        # Before the sensor starts: no frame of an empty world is on its way then.
        world.write("truth", time=world.time, sensor_wrench=np.array(wrench))
        instrument = start(
            "force_server",
            "force",
            Path(directory),
            scale,
            "--kind",
            kind,
            "--seed",
            str(seed),
            *options,
        )
        try:
            yield instrument
        finally:
            instrument.close()
