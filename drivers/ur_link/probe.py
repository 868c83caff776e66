"""Connections to the controller, and checks of it over RTDE before the client library connects.

The library waits for ever, with the interpreter locked, for a silent controller; and an output that
the controller lacks silently shifts all later fields. Both are therefore checked here first, with a
deadline; each function raises LinkError without a valid answer. Frames: big-endian size (u16,
header included), type (u8), body. Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide",
protocol 2.
"""

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from typing import Self

from hilcal.errors import undone_by

PORT = 30004
_HEAD = struct.Struct(">HB")
_PROBE_HZ, _STREAM_HZ = 10.0, 125.0
_CHUNK = 65536


class LinkError(Exception):
    """A connection failed; the text names it and the reason."""


class Connection:
    """A TCP connection; a call that does not end before the deadline raises LinkError."""

    def __init__(self, host: str, port: int, service: str, seconds: float) -> None:
        """Connect to a service (its name for errors); the deadline is `seconds` from now."""
        self._where = f"{service} (port {port})"
        self._buffer = b""
        self.extend(seconds)
        with self._failures(host):
            self._socket = socket.create_connection((host, port), timeout=seconds)

    @contextlib.contextmanager
    def _failures(self, host: str = "") -> Iterator[None]:
        """Turn what the socket raises into LinkError."""
        try:
            yield
        except ConnectionRefusedError:
            raise LinkError(f"the {self._where} refuses the connection") from None
        except socket.gaierror:
            raise LinkError(f'the address "{host}" is unknown') from None
        except TimeoutError:
            late = f"does not answer within {self._seconds:g} s"
            raise LinkError(f"the {self._where} {late}") from None
        except OSError as error:
            raise LinkError(f"the {self._where}: {error.strerror or error}") from None

    def extend(self, seconds: float) -> None:
        """Set a new deadline, `seconds` from now."""
        self._seconds, self._end = seconds, time.monotonic() + seconds

    def send(self, data: bytes) -> None:
        """Send everything."""
        with self._failures():
            self._limit()
            self._socket.sendall(data)

    def read(self, count: int) -> bytes:
        """Return exactly `count` bytes."""
        while len(self._buffer) < count:
            self._receive()
        out, self._buffer = self._buffer[:count], self._buffer[count:]
        return out

    def read_line(self) -> str:
        """Return the next line without its end."""
        while b"\n" not in self._buffer:
            if len(self._buffer) > _CHUNK:
                raise LinkError(f"the {self._where} sends something else than lines")
            self._receive()
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode(errors="replace").strip()

    def close(self) -> None:
        """Close the connection, after up to 0.1 s for the other side to close it, too."""
        with contextlib.suppress(OSError), self._socket:
            self._socket.shutdown(socket.SHUT_WR)
            end = time.monotonic() + 0.1
            while (remaining := end - time.monotonic()) > 0:
                self._socket.settimeout(remaining)
                if not self._socket.recv(_CHUNK):
                    break

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _receive(self) -> None:
        with self._failures():
            self._limit()
            data = self._socket.recv(_CHUNK)
        if not data:
            raise LinkError(f"the {self._where} closed the connection")
        self._buffer += data

    def _limit(self) -> None:
        """Let the socket's next call end at the deadline."""
        seconds = self._end - time.monotonic()
        if seconds <= 0:
            raise TimeoutError
        self._socket.settimeout(seconds)


def controller(
    host: str, outputs: tuple[str, ...], seconds: float
) -> tuple[tuple[int, ...], tuple[str, ...]]:
    """Return the controller's version (4 numbers), and which of `outputs` it has."""
    with _greeted(host, seconds) as line:
        _send(line, "v")
        version = struct.unpack(">4I", _reply(line, "v", 16))
        kinds = _kinds(_agreed(line, _PROBE_HZ, outputs))
        if len(kinds) != len(outputs):
            raise LinkError("the RTDE server (port 30004) answers with a wrong number of outputs")
        return version, tuple(n for n, k in zip(outputs, kinds, strict=True) if k != "NOT_FOUND")


def check_stream(host: str, seconds: float) -> None:
    """Raise LinkError if no packet of data comes in time."""
    with stream(host, _STREAM_HZ, ("timestamp",), seconds) as line:
        packet(line)


def stream(host: str, hz: float, outputs: tuple[str, ...], seconds: float) -> Connection:
    """Return a connection that receives packets of `outputs`; the controller must have them."""
    line = _greeted(host, seconds)
    with undone_by(line.close):
        _agreed(line, hz, outputs)
        _send(line, "S")
        _reply(line, "S", 1)
    return line


def packet(line: Connection) -> bytes:
    """Return the next packet of a stream: the number of the recipe (u8) and the outputs."""
    return _reply(line, "U", None)


def in_use(host: str, inputs: tuple[str, ...], seconds: float) -> bool:
    """Whether another client holds one of these input registers for commands."""
    with _greeted(host, seconds) as line:
        _send(line, "I", ",".join(inputs).encode())
        return "IN_USE" in _kinds(_reply(line, "I", None))


def _greeted(host: str, seconds: float) -> Connection:
    """Return a connection that speaks protocol 2."""
    line = Connection(host, PORT, "RTDE server", seconds)
    with undone_by(line.close):
        _send(line, "V", struct.pack(">H", 2))
        if _reply(line, "V", 1) != b"\x01":
            raise LinkError("the RTDE server (port 30004) does not speak protocol 2")
    return line


def _agreed(line: Connection, hz: float, outputs: tuple[str, ...]) -> bytes:
    _send(line, "O", struct.pack(">d", hz) + ",".join(outputs).encode())
    return _reply(line, "O", None)


def _kinds(answer: bytes) -> list[str]:
    """Return the types of the variables in an answer, after the number of the recipe."""
    return answer[1:].decode(errors="replace").split(",")


def _send(line: Connection, kind: str, body: bytes = b"") -> None:
    line.send(_HEAD.pack(_HEAD.size + len(body), ord(kind)) + body)


def _reply(line: Connection, kind: str, size: int | None) -> bytes:
    """Return the body of the next frame of a type; text messages in between are dropped."""
    while True:
        length, received = _HEAD.unpack(line.read(_HEAD.size))
        body = line.read(max(0, length - _HEAD.size))
        if received == ord("M"):
            continue
        if length < _HEAD.size or received != ord(kind) or (size is not None and len(body) != size):
            raise LinkError("the RTDE server (port 30004) does not answer as a controller does")
        return body
