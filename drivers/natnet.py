"""OptiTrack (Motive) by NatNet as a tracker: a rigid body's pose, or the position of its pivot.

A measurement is the mean of the frames that come after the request; its covariance is that of
these frames, divided by their number. The covariance does not state the accuracy: a camera system
has the same error in all frames of one pose. Leave the noise in [tracker] open, so that it is
estimated from the campaign. Reads frames of 3.0 to 4.2; a server of a later version is asked for
4.2. The simulated cameras (`simulated.natnet_server`) write the same messages.

A message is little-endian: number (uint16), bytes that follow (uint16), content. From 4.1 on each
list in a frame or in the descriptions also states its length in bytes.

Source: OptiTrack, NatNet SDK 4.x (NatNetTypes.h and the depacketization samples).
"""

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from hilcal.config import CellConfig
from hilcal.drivers.links import address, check_tracker_frame, network_failures
from hilcal.errors import DeviceError, InputError, undone_by
from hilcal.measuring.devices import Report, Row, TargetLostError, TrackerSample, report_of
from hilcal.toml import Section, check_section
from hilcal.types import Floats

PORT, DATA_PORT = 1510, 1511
CONNECT, SERVER_INFO, REQUEST, RESPONSE = 0, 1, 2, 3
REQUEST_DESCRIPTIONS, DESCRIPTIONS, FRAME, KEEP_ALIVE = 4, 5, 7, 10
Version = tuple[int, int]
OLDEST: Version = (3, 0)
NEWEST: Version = (4, 2)
FIRST_SIZED: Version = (4, 1)  # first version whose lists state their length in bytes
LARGEST = 1 << 16
MARKER_SET, RIGID_BODY = 0, 1
_HEAD = struct.Struct("<HH")
_COUNT = struct.Struct("<I")
_BODY = struct.Struct("<I3f4ffH")
_SERVER = struct.Struct("<256s4B4B")
_CONNECTION = struct.Struct("<QHB4B")


def message(number: int, content: bytes = b"") -> bytes:
    """Return a message."""
    return _HEAD.pack(number, len(content)) + content


def unpacked(data: bytes) -> tuple[int, bytes]:
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
    """The server that answered, and how it sends frames."""

    name: str
    program: str
    version: Version  # of NatNet, of its frames
    data_port: int  # to which it sends frames; 0 if not stated
    group: str  # multicast address; empty where it sends to each client


def server(content: bytes) -> NatNetServer:
    """Parse the answer to `connect`; raises struct.error if cut short."""
    name, *numbers = _SERVER.unpack_from(content)
    version = numbers[4], numbers[5]
    text = name.split(b"\0")[0].decode("utf-8", "replace")
    port, address = 0, ""
    if len(content) >= _SERVER.size + _CONNECTION.size:
        _, port, multicast, *group = _CONNECTION.unpack_from(content, _SERVER.size)
        address = ".".join(map(str, group)) if multicast else ""
    return NatNetServer(text, ".".join(map(str, numbers[:4])), version, port, address)


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

    def list_head(self) -> tuple[int, int]:
        """Return the number of elements of a list, and where it ends (0: not stated)."""
        count = self.count()
        size = self.count() if self.version >= FIRST_SIZED else 0
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


def frame(content: bytes, version: Version) -> tuple[int, list[Body]]:
    """Return a frame's number and its rigid bodies."""
    r = Reader(content, version)
    number = r.count()
    sets, end = r.list_head()
    if end:
        r.skip(end - r.at)
    else:
        for _ in range(sets):
            r.text()
            r.skip(12 * r.count())
    markers, _ = r.list_head()  # unlabelled
    r.skip(12 * markers)
    bodies = []
    for _ in range(r.list_head()[0]):
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
        end = r.count() + r.at if version >= FIRST_SIZED else 0
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


DEVICE = "tracker"
ANSWER_S, TRIES = 0.5, 4
"""Longest wait for an answer, real s, and number of requests: datagrams may be lost."""
DEADLINE_S = 4.0  # longest wait for a frame, real s
SLOWEST_HZ = 20.0
LOST_S = 1.0  # a body not seen for this time is lost, real s
FLOOR = 1e-7  # least standard deviation of a frame, m and rad: frames have single precision


class NatNetOptions(Section):
    """[tracker.options]: keys of the driver "natnet"."""

    rigid_body: str | None = Field(
        None,
        min_length=1,
        description="the name of the rigid body in Motive, or its streaming ID; may be absent "
        "where there is one only",
        examples=["tool"],
    )
    target: Literal["position", "pose"] = Field(
        "pose", description='"pose" (position and orientation) or "position" (of its pivot)'
    )
    frames: int = Field(
        20, strict=True, ge=2, description="frames averaged for one measurement, 2 or more"
    )
    local: str = Field(
        "0.0.0.0",  # noqa: S104 - of a multicast group
        min_length=1,
        description="the address of this computer in the cameras' network, for multicast",
    )


class NatNetTracker:
    """A rigid body as a `hilcal.measuring.devices.TrackerDevice`; m = 6, or 3."""

    def __init__(self, host: str, port: int, options: NatNetOptions) -> None:
        """Connect, agree on a version, find the rigid body."""
        self._options, self._to = options, (host, port)
        self.where = f"{host}:{port}"
        self._data: socket.socket | None = None
        self._newest = -1
        with network_failures(DEVICE, self.where):
            self._line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            with undone_by(self.close):
                self._line.connect(self._to)
                self._server = self._greet()
                if self._server.group:
                    self._data = self._joined(self._server)
                self._body, self._name = self._rigid_body()

    def measure(self) -> TrackerSample:
        """Average the next frames, see the module; identical frames are refused."""
        bodies = self._frames(self._options.frames)
        position = np.array([b.position for b in bodies])
        turns = Rotation.from_quat(np.array([b.quaternion for b in bodies]))
        if len(bodies) > 1 and not np.any(np.ptp(position, axis=0)):
            raise self._error(
                "all frames are the same to the last digit; is Motive paused, or does it play a "
                "recording?"
            )
        turn = turns.mean()
        shift = position - position.mean(axis=0)
        tilt = (turns * turn.inv()).as_rotvec()
        K = len(bodies)
        covariance = np.zeros((6, 6))
        for part, scatter in ((slice(0, 3), shift), (slice(3, 6), tilt)):
            variance = max(float(np.sum(scatter**2)) / (3 * max(K - 1, 1)), FLOOR**2)
            covariance[part, part] = variance / K * np.eye(3)
        value = np.concatenate([position.mean(axis=0), turn.as_rotvec()])
        m = 6 if self._options.target == "pose" else 3
        return TrackerSample(time.monotonic_ns(), value[:m], covariance[:m, :m])

    def find_target(self) -> None:
        """Wait until the rigid body is seen; cameras do not turn."""
        self._frames(1)

    def report(self) -> Report:
        """Report the server and the rigid body, and measure once."""
        s = self._server
        sent = f"multicast {s.group}:{s.data_port}" if s.group else "to this computer"
        rows: list[Row] = [
            ("", "", "name", s.name),
            ("NatNet", self._version, "natnet", self._version),
            ("frames", sent, "", None),
            ("rigid body", self._name, "rigid_body", self._name),
        ]
        problems: list[str] = []
        try:
            sample = self.measure()
            std = float(np.sqrt(self._options.frames * sample.covariance[0, 0]))
            text = f"a frame scatters by {1e6 * std:.0f} µm along each axis"
            rows.append(("target", text, "frame_std_m", std))
        except TargetLostError as error:
            problems.append(str(error).removeprefix(f"{DEVICE} at {self.where}: "))
        return report_of(DEVICE, f"{s.name} {s.program}", rows, problems)

    def close(self) -> None:
        """Close the sockets. Never raises; may be called twice."""
        self._line.close()
        if self._data is not None:
            self._data.close()

    def _frames(self, count: int) -> list[Body]:
        """Return the rigid body in the next `count` frames in which it is seen."""
        line = self._data or self._line
        with network_failures(DEVICE, self.where):
            self._send(message(KEEP_ALIVE))
            line.setblocking(False)
            with contextlib.suppress(BlockingIOError):  # drop what came before
                while True:
                    line.recv(LARGEST)
            self._newest = -1
            start = heard = tracked = requested = time.monotonic()
            until = start + DEADLINE_S + count / SLOWEST_HZ
            out: list[Body] = []
            others: set[int] = set()
            while len(out) < count:
                now = time.monotonic()
                if now - heard > DEADLINE_S or now > until:
                    raise self._error(
                        "no frames come; is streaming switched on, and does a firewall let them "
                        "through?"
                    )
                if now - max(heard, requested) > ANSWER_S:  # the server may have dropped us
                    requested = now
                    self._send(connect(NEWEST))
                if now - tracked > LOST_S and heard > tracked:
                    listed = f"; in the frames: {sorted(others)}" if others else ""
                    raise TargetLostError(
                        f"{DEVICE} at {self.where}: the rigid body {self._name} is not seen{listed}"
                    )
                bodies = self._next(line)
                if bodies is None:
                    continue
                heard = time.monotonic()
                others |= {b.number for b in bodies if b.number != self._body}
                for body in bodies:
                    if body.number == self._body and body.tracked:
                        tracked = heard
                        out.append(body)
        return out

    def _next(self, line: socket.socket) -> list[Body] | None:
        """Return the rigid bodies of the next new frame; None where none came."""
        content = self._receive(line, FRAME, 0.1)
        if content is None:
            return None
        wrong = f"frames are not of NatNet {self._version}; was the version changed in Motive?"
        with self._parsing(wrong):
            number, bodies = frame(content, self._server.version)
        if number == self._newest:
            return None
        self._newest = number
        for body in bodies:
            turn = float(np.linalg.norm(body.quaternion))
            if body.tracked and not (np.isfinite(body.position).all() and abs(turn - 1.0) < 0.01):
                return None
        return bodies

    def _greet(self) -> NatNetServer:
        content = self._ask(connect(NEWEST), SERVER_INFO)
        with self._parsing("the answer is not a NatNet server's; is this its command port?"):
            answered = server(content)
        if answered.version > NEWEST:
            command = f"Bitstream,{NEWEST[0]}.{NEWEST[1]}".encode() + b"\0"
            answer = self._ask(message(REQUEST, command), RESPONSE)
            if answered.group or answer[:4] not in (bytes(4), command[:4]):
                self._refuse(answered)
            answered = replace(answered, version=NEWEST)
        if answered.version < OLDEST:
            self._refuse(answered)
        return answered

    def _refuse(self, server: NatNetServer) -> None:
        raise self._error(
            f"it sends frames of NatNet {server.version[0]}.{server.version[1]}; valid: 3.0 to "
            f"{NEWEST[0]}.{NEWEST[1]} (set it in Motive)"
        )

    @property
    def _version(self) -> str:
        return ".".join(map(str, self._server.version))

    def _error(self, complaint: str) -> DeviceError:
        return DeviceError(f"{DEVICE} at {self.where}: {complaint}")

    @contextlib.contextmanager
    def _parsing(self, wrong: str) -> Iterator[None]:
        """Raise DeviceError where the parsed content is cut short."""
        try:
            yield
        except struct.error:
            raise self._error(wrong) from None

    def _joined(self, server: NatNetServer) -> socket.socket:
        line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        with undone_by(line.close):
            line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            line.bind((server.group, server.data_port or DATA_PORT))
            member = socket.inet_aton(server.group) + socket.inet_aton(self._options.local)
            line.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        return line

    def _rigid_body(self) -> tuple[int, str]:
        content = self._ask(message(REQUEST_DESCRIPTIONS), DESCRIPTIONS)
        with self._parsing(f"its descriptions are not of NatNet {self._version}"):
            bodies = names(content, self._server.version)
        body = self._options.rigid_body
        if body is None and len(bodies) == 1:
            return next(iter(bodies.items()))
        for number, name in bodies.items():
            if body in (name, str(number)):
                return number, name
        listed = ", ".join(f'"{name}"' for name in bodies.values()) or "none is streamed"
        wrong = "rigid_body is missing" if body is None else f'no rigid body "{body}"'
        raise InputError(f"[tracker] options: {wrong}; valid: {listed}")

    def _ask(self, request: bytes, answer: int) -> bytes:
        """Repeat a request until its answer comes; frames that come meanwhile are dropped."""
        for _ in range(TRIES):
            self._send(request)
            end = time.monotonic() + ANSWER_S
            while (remaining := end - time.monotonic()) > 0.0:
                content = self._receive(self._line, answer, remaining)
                if content is not None:
                    return content
        raise TimeoutError

    def _send(self, data: bytes) -> None:
        self._line.setblocking(True)
        self._line.send(data)

    def _receive(self, line: socket.socket, kind: int, seconds: float) -> bytes | None:
        """Return the content of the next message if it is of the kind, else None."""
        line.settimeout(max(seconds, 1e-3))
        try:
            number, content = unpacked(line.recv(LARGEST))
        except (TimeoutError, struct.error):
            return None
        return content if number == kind else None


def open_tracker(config: CellConfig) -> NatNetTracker:
    """Connect to the server that [tracker] names."""
    tracker = config.tracker
    host, port = address("[tracker]", "natnet", tracker.host, PORT)
    check_tracker_frame(tracker)
    options = check_section(tracker.options, NatNetOptions, "[tracker] options")
    return NatNetTracker(host, port, options)
