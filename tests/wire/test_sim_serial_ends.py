"""A simulated instrument ends with its parent, however that ends, and dies when told to."""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
import serial

from drivers.simulated.blackboard import Blackboard
from tests.support.sim_serial_cases import force_sensor, tracker

PARENT = """
import subprocess, sys, time
child = subprocess.Popen([sys.executable, "-m", *sys.argv[1:]], stdin=subprocess.PIPE)
print(child.pid, flush=True)
time.sleep(600)
"""
COMMANDS = {
    "tracker": "drivers.simulated.geocom_server --range-std 1e-5 0 --transverse-std 1e-5 0",
    "force": "drivers.simulated.force_server --kind bota",
}


def wait_until(what: Callable[[], bool], seconds: float = 20.0) -> None:
    deadline = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_it_ends_when_its_parent_is_killed(name: str) -> None:
    with tempfile.TemporaryDirectory() as directory:
        Blackboard.create(Path(directory) / "world.bin", 1.0)
        command = [*COMMANDS[name].split(), "--directory", directory, "--seed", "1"]
        with subprocess.Popen(
            [sys.executable, "-c", PARENT, *command], stdout=subprocess.PIPE
        ) as parent:
            assert parent.stdout is not None
            child = psutil.Process(int(parent.stdout.readline()))
            wait_until((Path(directory) / f"{name}.sock").exists)
            parent.kill()
        wait_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


def test_the_station_dies_when_told_to() -> None:
    with tracker() as station, serial.Serial(str(station.port), 115200, timeout=5) as line:
        station.admin("die")
        assert station.process.wait(10) == 1
        with pytest.raises(serial.SerialException):
            line.read(1)


def test_the_sensor_dies_when_told_to() -> None:
    with force_sensor("bota") as sensor, serial.Serial(str(sensor.port), 460800) as line:
        sensor.admin("die")
        assert sensor.process.wait(10) == 1
        with pytest.raises(serial.SerialException):
            line.read(10_000_000)
