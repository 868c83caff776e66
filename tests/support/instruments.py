"""Simulated instruments for tests: a process each, in a world that the test writes."""

import tempfile
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated.admin import ask
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import EMSCON_PORT, WEB_PORT, DeviceProcess, free_host
from tests.support.timing import wait_until

TRACKER_NOISE = ("--range-std", "5e-6", "0.15e-6", "--transverse-std", "7.5e-6", "3e-6")
TARGET = (0.5, 2.8, 0.4)
TURNED = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
WRENCH = np.array([1.0, -2.0, 30.0, 0.1, 0.2, -0.3])
WARM = ("--on", "1e6")
"""The zero of a force sensor that has been on for so long drifts no more."""


@dataclass(eq=False)
class Instrument:
    """A running simulated device in a world that the test writes."""

    process: DeviceProcess  # the server
    board: Blackboard  # the shared world; the test is its writer

    @property
    def port(self):
        """The serial port to open."""
        return self.process.socket.with_suffix("")

    def admin(self, op="state", **arguments):
        """Switch a fault, or ask for the state."""
        return ask(self.process.socket, op, **arguments)

    def truth(self, **fields):
        """Write what is true in the world, e.g. `target` or `sensor_wrench`."""
        self.board.write("truth", time=self.board.time, **fields)

    def start(self):
        """Start the server, and wait until it answers."""
        self.process.start()
        wait_until(lambda: self.process.socket.exists() or self.process.has_ended, "started")
        self.process.check()

    def close(self):
        """End the server as the end of its parent would."""
        self.process.end()


@contextmanager
def running(module, name, *options, scale=1.0, seed=1, **truth):
    """Run `hilcal.drivers.simulated.<module>` in a world that says `truth` from the beginning."""
    with tempfile.TemporaryDirectory() as directory:
        arguments = ("--seed", str(seed), *options)
        server = f"hilcal.drivers.simulated.{module}"
        process = DeviceProcess(name, server, Path(directory), arguments)
        board = Blackboard.create(Path(directory) / "world.bin", scale)
        instrument = Instrument(process, board)
        if truth:  # before it starts: no frame of an empty world is on its way then
            instrument.truth(**truth)
        with closing(instrument):
            instrument.start()
            yield instrument


@contextmanager
def tracker(target=TARGET, *options, scale=20.0):
    """Run a GeoCOM station that sees `target` (its own axes, m)."""
    at = np.array(target)
    with running(
        "geocom_server", "tracker", *TRACKER_NOISE, *options, scale=scale, target=at
    ) as station:
        yield station


@contextmanager
def force_sensor(kind, *options, scale=1.0, seed=1):
    """Run a force sensor ("ft300", "bota", "hex") that feels `WRENCH` (its axes, N and N·m)."""
    with running(
        "force_server", "force", "--kind", kind, *options,
        scale=scale, seed=seed, sensor_wrench=WRENCH,
    ) as sensor:  # fmt: skip
        yield sensor


# in a network


@contextmanager
def emscon():
    """Run a laser tracker that sees `TARGET`, turned by `TURNED`; yields its address, too."""
    host = free_host()
    place = ("--host", host, "--port", str(EMSCON_PORT))
    with running(
        "emscon_server", "tracker", *TRACKER_NOISE, *place,
        scale=20.0, target=np.array(TARGET), target_rotation=TURNED,
    ) as station:  # fmt: skip
        yield station, f"{host}:{EMSCON_PORT}"


@contextmanager
def natnet(*options):
    """Run cameras that see `TARGET`, turned by `TURNED`; yields their address, too."""
    host = free_host()
    with running(
        "natnet_server", "tracker", "--host", host, *options,
        scale=2.0, target=np.array(TARGET), target_rotation=TURNED,
    ) as cameras:  # fmt: skip
        yield cameras, host


@contextmanager
def netft():
    """Run a Net F/T that feels `WRENCH`, warm; yields its address without a port, too."""
    host = free_host()
    place = ("--kind", "netft", "--host", host)
    with running("force_server", "force", *place, *WARM, sensor_wrench=WRENCH) as sensor:
        yield sensor, host


def cell(address, driver, **options):
    """A cell whose tracker is in the network."""
    return CellConfig.model_validate(
        {
            "robot": {"model": "ur10e"},
            "tracker": {"driver": driver, "host": address, "options": options},
            "operator": {"driver": "simulated"},
            "simulation": {"clock": 20.0},
        }
    )


def force_cell(host, **options):
    """A cell whose force sensor is a Net F/T."""
    section = {"driver": "netft", "host": host, "options": {"web_port": WEB_PORT, **options}}
    return CellConfig.model_validate({"robot": {"model": "ur10e"}, "force_sensor": section})
