"""Simulated instruments in a network for tests, and cells that name them."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from drivers.simulated.cell_processes import EMSCON_PORT, free_host
from hilcal.config import CellConfig
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
