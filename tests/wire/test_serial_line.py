"""A serial port: one clear line for whatever goes wrong, and nobody else's bytes."""

import os
import subprocess
import sys
import threading
import tty
from dataclasses import dataclass
from pathlib import Path

import pytest

from hilcal.drivers.links import close_port, drain, line_failures, open_port
from hilcal.errors import DeviceError, InputError

HOLD = """
import sys
from hilcal.drivers.links import open_port
port = open_port("tracker", sys.argv[1], 19200)
print("held", flush=True)
sys.stdin.read()
"""


@dataclass(eq=False)
class Line:
    """A pseudo-terminal under a stable name, whose other end the test holds."""

    path: Path
    master: int
    slave: int

    def unplug(self):
        self.path.unlink(missing_ok=True)
        for end in (self.master, self.slave):
            os.close(end)
        self.master = self.slave = -1


@pytest.fixture
def line(tmp_path):
    master, slave = os.openpty()
    tty.setraw(slave)
    path = tmp_path / "adapter"
    path.symlink_to(os.ttyname(slave))
    line = Line(path, master, slave)
    yield line
    if line.master >= 0:
        line.unplug()


def test_a_port_that_another_program_uses_is_refused_and_named(line):
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(line.path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    with other:
        assert other.stdout is not None
        assert other.stdout.readline() == b"held\n"
        with pytest.raises(DeviceError, match="in use by another program") as caught:
            open_port("force sensor", str(line.path), 19200)
        assert str(line.path) in str(caught.value)
        assert str(caught.value).startswith("force sensor: ")
        other.kill()  # as its death may be; the lock dies with it
    close_port(open_port("force sensor", str(line.path), 19200))


def test_a_port_that_does_not_exist(tmp_path):
    with pytest.raises(DeviceError, match=r"^tracker: there is no port .*nothing; is its adapter"):
        open_port("tracker", str(tmp_path / "nothing"), 19200)


def test_a_file_is_no_port(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"hello")
    with pytest.raises(DeviceError, match="is not a serial port"):
        open_port("tracker", str(path), 19200)
    with pytest.raises(DeviceError, match="is not a serial port"):
        open_port("tracker", str(tmp_path), 19200)
    assert path.read_bytes() == b"hello"


@pytest.mark.parametrize("baud", [-1, 10**12])
def test_a_rate_that_no_port_has(line, baud):
    with pytest.raises(InputError, match=f"{baud} is no rate"):
        open_port("tracker", str(line.path), baud)
    close_port(open_port("tracker", str(line.path), 19200))  # nothing is left locked


@pytest.mark.parametrize("action", ["read", "write", "waiting", "reset", "drain"])
def test_an_unplugged_adapter_is_one_line_whatever_was_tried(line, action):
    port = open_port("tracker", str(line.path), 19200, timeout=0.2)
    try:
        line.unplug()
        assert port.is_open
        actions = {
            "read": lambda: port.read(1),
            "write": lambda: port.write(b"x"),
            "waiting": lambda: port.in_waiting,
            "reset": port.reset_input_buffer,
            "drain": lambda: drain(port, 0.05, 1.0),
        }
        with (
            pytest.raises(DeviceError, match=r"^tracker: port .* is gone; was its adapter unp"),
            line_failures("tracker", str(line.path)),
        ):
            actions[action]()
    finally:
        close_port(port)


@pytest.mark.parametrize(("words", "limit"), [(10, 20.0), (10**9, 1.0)])
def test_a_line_is_drained_until_quiet_or_told_of(line, words, limit):
    port = open_port("tracker", str(line.path), 19200)
    stop = threading.Event()

    def talk():
        for _ in range(words):
            if stop.wait(0.005):
                return
            os.write(line.master, b"late\r\n")

    thread = threading.Thread(target=talk)
    try:
        thread.start()
        drained = drain(port, quiet=0.3, limit=limit)
        assert drained is (words == 10)
        if drained:
            assert not thread.is_alive()
            assert port.in_waiting == 0
    finally:
        stop.set()
        thread.join()
        close_port(port)
