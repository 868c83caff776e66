"""Checks of the controller over RTDE, before the client library connects.

The library waits for ever, with the interpreter locked, for a silent controller; and an output that
the controller lacks silently shifts all later fields. Both are therefore checked here first, with a
deadline; each function raises LinkError without a valid answer. Frames: big-endian size (u16,
header included), type (u8), body. Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide",
protocol 2.
"""

import struct
from dataclasses import dataclass

from hilcal.drivers.ur_link.lines import Connection, LinkError

PORT = 30004
NOT_FOUND = "NOT_FOUND"
IN_USE = "IN_USE"
_HEAD = struct.Struct(">HB")
_PROBE_HZ = 10.0
_STREAM_HZ = 125.0


@dataclass(frozen=True, slots=True)
class ControllerFacts:
    """Version and outputs of a controller."""

    version: tuple[int, ...]  # major, minor, bugfix, build
    outputs: tuple[str, ...]  # the requested outputs that it has


def controller(host: str, outputs: tuple[str, ...], seconds: float) -> ControllerFacts:
    """Return the controller's version, and which of `outputs` it has."""
    with _greeted(host, seconds) as line:
        line.send(_frame("v"))
        version = struct.unpack(">4I", _reply(line, "v", 16))
        line.send(_frame("O", struct.pack(">d", _PROBE_HZ) + ",".join(outputs).encode()))
        kinds = _reply(line, "O", None)[1:].decode(errors="replace").split(",")
        if len(kinds) != len(outputs):
            raise LinkError("the RTDE server (port 30004) answers with a wrong number of outputs")
        available = tuple(n for n, k in zip(outputs, kinds, strict=True) if k != NOT_FOUND)
        return ControllerFacts(version, available)


def check_stream(host: str, seconds: float) -> None:
    """Raise LinkError if no packet of data comes in time."""
    with stream(host, _STREAM_HZ, ("timestamp",), seconds) as line:
        packet(line)


def stream(host: str, hz: float, outputs: tuple[str, ...], seconds: float) -> Connection:
    """Return a connection that receives packets of `outputs`; the controller must have them."""
    line = _greeted(host, seconds)
    try:
        line.send(_frame("O", struct.pack(">d", hz) + ",".join(outputs).encode()))
        _reply(line, "O", None)
        line.send(_frame("S"))
        _reply(line, "S", 1)
    except BaseException:
        line.close()
        raise
    return line


def packet(line: Connection) -> bytes:
    """Return the next packet of a stream: the number of the recipe (u8) and the outputs."""
    return _reply(line, "U", None)


def in_use(host: str, inputs: tuple[str, ...], seconds: float) -> bool:
    """Whether another client holds one of these input registers for commands."""
    with _greeted(host, seconds) as line:
        line.send(_frame("I", ",".join(inputs).encode()))
        return IN_USE in _reply(line, "I", None)[1:].decode(errors="replace").split(",")


def _greeted(host: str, seconds: float) -> Connection:
    """Return a connection that speaks protocol 2."""
    line = Connection(host, PORT, "RTDE server", seconds)
    try:
        line.send(_frame("V", struct.pack(">H", 2)))
        if _reply(line, "V", 1) != b"\x01":
            raise LinkError("the RTDE server (port 30004) does not speak protocol 2")
    except BaseException:
        line.close()
        raise
    return line


def _frame(kind: str, body: bytes = b"") -> bytes:
    return _HEAD.pack(_HEAD.size + len(body), ord(kind)) + body


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
