"""OptiTrack (Motive) by NatNet as a tracker: a rigid body's pose, or the position of its pivot.

A measurement is the mean of the frames that come after the request; its covariance is that of
these frames, divided by their number. The covariance does not state the accuracy: a camera system
has the same error in all frames of one pose. Leave the noise in [tracker] open, so that it is
estimated from the campaign. Reads frames of 3.0 to 4.2; a server of a later version is asked for
4.2.

Source: see `natnet_frames`.
"""

import contextlib
import socket
import struct
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from hilcal.config import CellConfig
from hilcal.config.sections import Whole
from hilcal.drivers import natnet_frames as nn
from hilcal.drivers.links import address, check_own_axes, network_failures
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Report, Row, TargetLostError, TrackerSample, report_of
from hilcal.toml import Section, check_section

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
    frames: Whole = Field(20, description="frames averaged for one measurement, 2 or more")
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
            try:
                self._line.connect(self._to)
                self._server = self._greet()
                if self._server.group:
                    self._data = self._joined(self._server)
                self._body, self._name = self._rigid_body()
            except BaseException:
                self.close()
                raise

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
        """Say who answered, and measure once."""
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

    def _frames(self, count: int) -> list[nn.Body]:
        """Return the rigid body in the next `count` frames in which it is seen."""
        line = self._data or self._line
        with network_failures(DEVICE, self.where):
            self._send(nn.message(nn.KEEP_ALIVE))
            _drain(line)
            self._newest = -1
            start = heard = tracked = requested = time.monotonic()
            until = start + DEADLINE_S + count / SLOWEST_HZ
            out: list[nn.Body] = []
            foreign: set[int] = set()
            while len(out) < count:
                now = time.monotonic()
                if now - heard > DEADLINE_S or now > until:
                    raise self._error(
                        "no frames come; is streaming switched on, and does a firewall let them "
                        "through?"
                    )
                if now - max(heard, requested) > ANSWER_S:  # the server may have dropped us
                    requested = now
                    self._send(nn.connect(nn.NEWEST))
                if now - tracked > LOST_S and heard > tracked:
                    listed = f"; in the frames: {sorted(foreign)}" if foreign else ""
                    raise TargetLostError(
                        f"{DEVICE} at {self.where}: the rigid body {self._name} is not seen{listed}"
                    )
                bodies = self._next(line)
                if bodies is None:
                    continue
                heard = time.monotonic()
                foreign |= {b.number for b in bodies if b.number != self._body}
                for body in bodies:
                    if body.number == self._body and body.tracked:
                        tracked = heard
                        out.append(body)
        return out

    def _next(self, line: socket.socket) -> list[nn.Body] | None:
        """Return the rigid bodies of the next new frame; None where none came."""
        content = self._receive(line, nn.FRAME, 0.1)
        if content is None:
            return None
        wrong = f"frames are not of NatNet {self._version}; was the version changed in Motive?"
        with self._parsing(wrong):
            number, bodies = nn.frame(content, self._server.version)
        if number == self._newest:
            return None
        self._newest = number
        if not all(np.isfinite([*b.position, *b.quaternion]).all() for b in bodies):
            return None
        return bodies

    def _greet(self) -> nn.NatNetServer:
        content = self._ask(nn.connect(nn.NEWEST), nn.SERVER_INFO)
        with self._parsing("what answers is no NatNet server; is this its command port?"):
            server = nn.server(content)
        if server.version > nn.NEWEST:
            command = f"Bitstream,{nn.NEWEST[0]}.{nn.NEWEST[1]}".encode() + b"\0"
            answer = self._ask(nn.message(nn.REQUEST, command), nn.RESPONSE)
            if server.group or answer[:4] not in (bytes(4), command[:4]):
                self._refuse(server)
            server = replace(server, version=nn.NEWEST)
        if server.version < nn.OLDEST:
            self._refuse(server)
        return server

    def _refuse(self, server: nn.NatNetServer) -> None:
        raise self._error(
            f"it sends frames of NatNet {server.version[0]}.{server.version[1]}; valid: 3.0 to "
            f"{nn.NEWEST[0]}.{nn.NEWEST[1]} (set it in Motive)"
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

    def _joined(self, server: nn.NatNetServer) -> socket.socket:
        line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            line.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            line.bind((server.group, server.data_port or nn.DATA_PORT))
            member = socket.inet_aton(server.group) + socket.inet_aton(self._options.local)
            line.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        except BaseException:
            line.close()
            raise
        return line

    def _rigid_body(self) -> tuple[int, str]:
        content = self._ask(nn.message(nn.REQUEST_DESCRIPTIONS), nn.DESCRIPTIONS)
        with self._parsing(f"its descriptions are not of NatNet {self._version}"):
            names = nn.names(content, self._server.version)
        body = self._options.rigid_body
        if body is None and len(names) == 1:
            return next(iter(names.items()))
        for number, name in names.items():
            if body in (name, str(number)):
                return number, name
        listed = ", ".join(f'"{name}"' for name in names.values()) or "none is streamed"
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
            number, content = nn.opened(line.recv(nn.LARGEST))
        except (TimeoutError, struct.error):
            return None
        return content if number == kind else None


def _drain(line: socket.socket) -> None:
    line.setblocking(False)
    while True:
        try:
            line.recv(nn.LARGEST)
        except BlockingIOError:
            return


def open_tracker(config: CellConfig) -> NatNetTracker:
    """Connect to the server that [tracker] names."""
    tracker = config.tracker
    host, port = address("[tracker]", "natnet", tracker.host, nn.PORT)
    check_own_axes(tracker)
    options = check_section(tracker.options, NatNetOptions, "[tracker] options")
    if options.frames < 2:
        raise InputError("[tracker] options: frames = 1; valid: 2 or more, which show the scatter")
    return NatNetTracker(host, port, options)
