"""OptiTrack NatNet 3.0 to 4.2: messages, and the rigid bodies in them.

A message is little-endian: number (uint16), bytes that follow (uint16), content. From 4.1 on each
list in a frame or in the descriptions also states its length in bytes.

Source: OptiTrack, NatNet SDK 4.x (NatNetTypes.h and the depacketization samples).
"""

import struct
from dataclasses import dataclass

import numpy as np

from hilcal.types import Floats

PORT, DATA_PORT = 1510, 1511
GROUP = "239.255.42.99"
CONNECT, SERVER_INFO, REQUEST, RESPONSE = 0, 1, 2, 3
REQUEST_DESCRIPTIONS, DESCRIPTIONS, FRAME, KEEP_ALIVE = 4, 5, 7, 10
Version = tuple[int, int]
OLDEST: Version = (3, 0)
NEWEST: Version = (4, 2)
SIZED: Version = (4, 1)  # first version whose lists state their length in bytes
LARGEST = 1 << 16
MARKER_SET, RIGID_BODY = 0, 1
_HEAD = struct.Struct("<HH")
_BODY = struct.Struct("<I3f4ffH")
_SERVER = struct.Struct("<256s4B4B")
_CONNECTION = struct.Struct("<QHB4B")


def message(number: int, content: bytes = b"") -> bytes:
    """Return a message."""
    return _HEAD.pack(number, len(content)) + content


def opened(data: bytes) -> tuple[int, bytes]:
    """Return number and content of a message; raises struct.error if cut short."""
    number, size = _HEAD.unpack_from(data)
    if len(data) < _HEAD.size + size:
        raise struct.error("cut short")
    return number, data[_HEAD.size :]


def connect(version: Version) -> bytes:
    """Return the request to connect and to receive frames of a version."""
    content = bytearray(271)
    content[:4] = b"Ping"
    content[265:267] = bytes(version)
    return message(CONNECT, bytes(content))


@dataclass(frozen=True, slots=True)
class NatNetServer:
    """Who answered, and how it sends frames."""

    name: str
    program: str
    version: Version  # of NatNet, of its frames
    data_port: int  # to which it sends frames; 0 if not stated
    group: str  # multicast address; empty where it sends to each client


def server(content: bytes) -> NatNetServer:
    """Parse the answer to `connect`; raises struct.error if cut short."""
    name, *numbers = _SERVER.unpack_from(content)
    version = numbers[4], numbers[5]
    called = name.split(b"\0")[0].decode("utf-8", "replace")
    port, where = 0, ""
    if len(content) >= _SERVER.size + _CONNECTION.size:
        _, port, multicast, *group = _CONNECTION.unpack_from(content, _SERVER.size)
        where = ".".join(map(str, group)) if multicast else ""
    return NatNetServer(called, ".".join(map(str, numbers[:4])), version, port, where)


@dataclass(frozen=True, slots=True, eq=False)
class Body:
    """A rigid body in a frame."""

    number: int
    position: Floats  # (3,) of its pivot, m
    quaternion: Floats  # (4,) scalar last
    tracked: bool


class Reader:
    """Reads a content from its beginning; raises struct.error at a premature end."""

    def __init__(self, content: bytes, version: Version) -> None:
        self.content, self.version, self.at = content, version, 0

    def take(self, layout: struct.Struct) -> tuple[float, ...]:
        """Return the next numbers."""
        values = layout.unpack_from(self.content, self.at)
        self.at += layout.size
        return values

    def count(self) -> int:
        """Return the next number."""
        return int(self.take(_COUNT)[0])

    def listed(self) -> tuple[int, int]:
        """Return the number of elements of a list, and where it ends (0: not stated)."""
        count = self.count()
        size = self.count() if self.version >= SIZED else 0
        return count, self.at + size if size else 0

    def text(self) -> str:
        """Return the next text."""
        end = self.content.find(b"\0", self.at)
        if end < 0:
            raise struct.error("a text without an end")
        text = self.content[self.at : end].decode("utf-8", "replace")
        self.at = end + 1
        return text

    def skip(self, size: int) -> None:
        """Skip bytes."""
        self.at += size
        if not 0 <= self.at <= len(self.content):
            raise struct.error("cut short")


_COUNT = struct.Struct("<I")


def frame(content: bytes, version: Version) -> tuple[int, list[Body]]:
    """Return a frame's number and its rigid bodies."""
    r = Reader(content, version)
    number = r.count()
    sets, end = r.listed()
    if end:
        r.skip(end - r.at)
    else:
        for _ in range(sets):
            r.text()
            r.skip(12 * r.count())
    markers, _ = r.listed()  # unlabelled
    r.skip(12 * markers)
    bodies = []
    for _ in range(r.listed()[0]):
        v = r.take(_BODY)
        tracked = bool(int(v[9]) & 1)
        bodies.append(Body(int(v[0]), np.array(v[1:4]), np.array(v[4:8]), tracked))
    return number, bodies


def names(content: bytes, version: Version) -> dict[int, str]:
    """Return the names of the rigid bodies by their streaming IDs, from the descriptions."""
    r = Reader(content, version)
    out: dict[int, str] = {}
    for _ in range(r.count()):
        kind = r.count()
        end = r.count() + r.at if version >= SIZED else 0
        if kind == RIGID_BODY:
            name = r.text()
            out[r.count()] = name
            if not end:
                r.skip(16)
                markers = r.count()
                r.skip(16 * markers)
                for _ in range(markers if version >= (4, 0) else 0):
                    r.text()
        elif kind == MARKER_SET and not end:
            r.text()
            for _ in range(r.count()):
                r.text()
        elif not end:
            break  # skeletons, plates, cameras: they come last, without a length
        if end:
            r.skip(end - r.at)
    return out
