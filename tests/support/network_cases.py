"""Simulated instruments in a network for tests, and cells that name them."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.config import CellConfig
from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import EMSCON_PORT, WEB_PORT, free_host
from tests.support.sim_serial_cases import TRACKER_NOISE, Instrument, start

TARGET = (0.5, 2.8, 0.4)
TURNED = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])


def cell(address: str, driver: str, scale: float = 20.0, **options: Any) -> CellConfig:
    """A cell whose tracker is in the network."""
    return CellConfig.model_validate(
        {
            "robot": {"model": "ur10e"},
            "tracker": {"driver": driver, "host": address, "options": options},
            "simulation": {"clock": scale},
        }
    )


@contextmanager
def emscon(scale: float = 20.0, *options: str) -> Iterator[tuple[Instrument, str]]:
    """Run a laser tracker that sees `TARGET`, turned by `TURNED`; yields its address, too."""
    noise = [word for option in TRACKER_NOISE for word in option]
    host = free_host()
    with tempfile.TemporaryDirectory() as directory:
        place = ("--host", host, "--port", str(EMSCON_PORT), "--seed", "1")
        tracker = start(
            "emscon_server", "tracker", Path(directory), scale, *noise, *place, *options
        )
        try:
            tracker.truth(target=np.array(TARGET), target_rotation=TURNED)
            yield tracker, f"{host}:{EMSCON_PORT}"
        finally:
            tracker.close()


WRENCH = np.array([1.0, -2.0, 30.0, 0.1, 0.2, -0.3])


@contextmanager
def netft(*options: str) -> Iterator[tuple[Instrument, str]]:
    """Run a Net F/T that feels `WRENCH`, warm; yields its address without a port, too."""
    host = free_host()
    with tempfile.TemporaryDirectory() as directory:
        world = Blackboard.create(Path(directory) / "world.bin", 1.0)
        world.write("truth", time=world.time, sensor_wrench=WRENCH)
        place = ("--kind", "netft", "--host", host, "--seed", "1", "--on", "1e6")
        sensor = start("force_server", "force", Path(directory), 1.0, *place, *options)
        try:
            yield sensor, host
        finally:
            sensor.close()


def force_cell(host: str, **options: Any) -> CellConfig:
    """A cell whose force sensor is a Net F/T."""
    section = {"driver": "netft", "host": host, "options": {"web_port": WEB_PORT, **options}}
    return CellConfig.model_validate({"robot": {"model": "ur10e"}, "force_sensor": section})


@contextmanager
def natnet(*options: str) -> Iterator[tuple[Instrument, str]]:
    """Run cameras that see `TARGET`, turned by `TURNED`; yields their address, too."""
    host = free_host()
    with tempfile.TemporaryDirectory() as directory:
        place = ("--host", host, "--seed", "1")
        cameras = start("natnet_server", "tracker", Path(directory), 2.0, *place, *options)
        try:
            cameras.truth(target=np.array(TARGET), target_rotation=TURNED)
            yield cameras, host
        finally:
            cameras.close()
