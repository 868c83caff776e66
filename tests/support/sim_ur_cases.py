"""A running simulated UR controller for tests, and the real client library in its own process."""

import json
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from hilcal.drivers.simulated.blackboard import Blackboard
from hilcal.drivers.simulated.cell_processes import DeviceProcess, free_host
from hilcal.drivers.ur_link.worker import environment
from tests.support.instruments import Instrument
from tests.support.paths import ROOT


@dataclass(eq=False)
class SimulatedUr(Instrument):
    """A running controller."""

    host: str
    is_x: bool

    def wait(self, what, value, timeout=5.0):
        """Wait until a field of the state has a value; returns the state."""
        deadline = time.monotonic() + timeout
        while (state := self.admin())[what] != value:
            assert time.monotonic() < deadline, f"{what} stays {state[what]!r}, not {value!r}"
            time.sleep(0.005)
        return state


def server(directory, host, *arguments):
    """The process of a controller, to be started."""
    arguments = ("--host", host, "--robot", "ur10e", *arguments)
    return DeviceProcess("arm", "hilcal.drivers.simulated.ur_server", directory, arguments)


def start(directory, scale=1.0, truth=None, *arguments):
    """Start a controller in a world of its own; `truth` are fields of the blackboard's section."""
    board = Blackboard.create(directory / "world.bin", scale)
    if truth is not None:
        board.write("truth", **{"flange": np.eye(4), "time": 1e-6, **truth})
    host = free_host()
    is_x = any(argument.startswith("10.") for argument in arguments)
    running = SimulatedUr(server(directory, host, *arguments), board, host, is_x)
    try:
        running.start()
    except BaseException:
        running.close()
        raise
    return running


class ClientError(Exception):
    """What the client library raised."""


class Client:
    """The real client library in a process of its own: its constructors hold the GIL."""

    def __init__(self):
        self.process = subprocess.Popen(
            [sys.executable, str(ROOT / "tests" / "support" / "sim_ur_client.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            env={**environment(), "OMP_NUM_THREADS": "1"},
        )

    def __call__(self, part, call, *arguments):
        """Call `part` ("control", "receive", "dashboard"); the call "open" constructs it."""
        self.process.stdin.write(json.dumps([part, call, arguments]).encode() + b"\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise ClientError(f"died, exit code {self.process.wait()}")
        result = json.loads(answer)
        if "error" in result:
            raise ClientError(result["error"])
        return result["result"]

    def close(self):
        self.process.kill()
        self.process.wait()
        self.process.stdin.close()
        self.process.stdout.close()


@contextmanager
def client(host, *parts):
    """A client with these parts opened."""
    made = Client()
    try:
        for part in parts:
            made(part, "open", host)
        yield made
    finally:
        made.close()


class Wire:
    """A plain socket that speaks RTDE frames."""

    def __init__(self, host, port=30004):
        self.socket = socket.create_connection((host, port), timeout=5.0)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.socket.close()

    def send(self, kind, payload=b""):
        self.socket.sendall(struct.pack(">HB", 3 + len(payload), ord(kind)) + payload)

    def receive(self):
        size, kind = struct.unpack(">HB", self.exactly(3))
        return chr(kind), self.exactly(size - 3)

    def ask(self, kind, payload=b""):
        """Send a frame and return the payload of the next one, which has the same type."""
        self.send(kind, payload)
        came, body = self.receive()
        assert came == kind
        return body

    def outputs(self, names, hz=125.0):
        """Agree on outputs; returns their types."""
        assert self.ask("V", struct.pack(">H", 2)) == b"\x01"
        return self.ask("O", struct.pack(">d", hz) + names.encode())[1:].decode()

    def exactly(self, count):
        data = b""
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            if not more:
                raise ConnectionResetError("closed")
            data += more
        return data


class Lines:
    """A plain socket that speaks lines: the dashboard."""

    def __init__(self, host, port=29999):
        self.socket = socket.create_connection((host, port), timeout=5.0)
        self.stream = self.socket.makefile("rb")

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.stream.close()
        self.socket.close()

    def read(self):
        return self.stream.readline().decode().rstrip("\n")

    def ask(self, words):
        self.socket.sendall(words.encode() + b"\n")
        return self.read()


def send_script(host, text):
    with socket.create_connection((host, 30003), timeout=5.0) as line:
        line.sendall(text.encode())
