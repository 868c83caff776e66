"""Simulated OptiTrack cameras: NatNet on UDP; admin `tracker.sock`.

    python -m hilcal.drivers.simulated.natnet_server --directory DIR --host 127.A.B.C [--port 1510]
        [--version 4.1] [--multicast GROUP] [--frame-std M] [--distortion M] --seed N

The errors are those of a camera system: frames scatter by `--frame-std`; waves of the amplitude
`--distortion` and the length 0.4 m distort the volume, the same in all frames of a pose. The same
errors on a lever of 0.1 m are those of the orientation.

Admin operations: `beam {on}` hides the rigid body, `stall {on}` sends no frames, `pause {on}`
repeats one frame, `lose {share}` of the frames, `forget` all clients, `rename {name}`, `bodies
{count}` adds other bodies, `insist {on}` ignores the version that a client requests, `state`.

Source: as `hilcal.drivers.natnet`. natnet, an independent client, is tested against it.
"""

import contextlib
import select
import socket
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.drivers import natnet as nn
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard, settled_truth
from hilcal.types import Floats

NAME, BODY = "SIM Motive", 7
RATE_HZ, FASTEST_HZ = 120.0, 240.0
"""Frames per second of world time, and the maximum per second of real time."""
WAVE_M, ARM_M = 0.4, 0.1
FORGOTTEN_S = 10.0
_COUNT = struct.Struct("<I")


@dataclass(slots=True, eq=False)
class Cameras:
    """State of the cameras, and their clients."""

    board: Blackboard
    rng: np.random.Generator
    line: socket.socket
    version: nn.Version
    frame_std: float  # scatter of a frame, m
    waves: Floats  # (6, 4) direction and phase of the distortion of each coordinate and rotation
    distortion: float  # its amplitude, m
    group: str = ""  # multicast group; empty for none
    clients: dict[tuple[str, int], tuple[nn.Version, float]] = field(default_factory=dict)
    """By address: version, and time of the last request, `time.monotonic`."""
    name: str = "tool"
    extra: int = 0  # number of other rigid bodies
    number: int = 0
    hidden: bool = False
    stalled: bool = False
    paused: bool = False  # whether one frame is repeated
    lose: float = 0.0
    insist: bool = False  # whether the version that a client requests is ignored
    newest: tuple[Floats, Floats] | None = None  # pose in the newest frame

    def pose(self) -> tuple[Floats, Floats]:
        """Return position (m) and quaternion (scalar last) in a new frame."""
        if self.paused and self.newest is not None:
            return self.newest
        truth = settled_truth(self.board)
        position, rotation = truth["target"], truth["target_rotation"]
        wave = self.distortion * np.sin(
            2 * np.pi / WAVE_M * self.waves[:, :3] @ position + self.waves[:, 3]
        )
        error = wave + self.frame_std * self.rng.standard_normal(6)
        proper = np.linalg.det(rotation) > 0.5  # else the world has not started
        turn = Rotation.from_matrix(rotation if proper else np.eye(3))
        erroneous = Rotation.from_rotvec(error[3:] / ARM_M) * turn
        self.newest = position + error[:3], erroneous.as_quat()
        return self.newest

    def frame(self, version: nn.Version) -> bytes:
        """Return the content of a frame."""
        position, turn = self.pose()
        tool = struct.pack("<I3f4ffH", BODY, *position, *turn, 2e-4, 0 if self.hidden else 1)
        bodies = tool + b"".join(
            struct.pack("<I3f4ffH", BODY + 1 + k, k, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1e-4, 1)
            for k in range(self.extra)
        )
        markers = b"all\0" + struct.pack("<I6f", 2, *range(6))
        lists = [(1, markers), (1, struct.pack("<3f", 9, 9, 9)), (1 + self.extra, bodies)]
        lists += [(0, b"")] * (2 if version >= nn.FIRST_SIZED else 1)  # skeletons, assets
        lists += [(1, struct.pack("<I3ffHf", 1, 0, 0, 0, 0.01, 2, 1e-4)), (0, b""), (0, b"")]
        out = _COUNT.pack(self.number)
        for count, content in lists:
            out += _COUNT.pack(count)
            out += (_COUNT.pack(len(content)) if version >= nn.FIRST_SIZED else b"") + content
        suffix = struct.pack("<IId3Q", 0, 0, self.board.time, 0, 0, 0)
        precise = struct.pack("<II", 0, 0) if version >= (4, 0) else b""
        return out + suffix + precise + struct.pack("<HI", 0, 0)

    def descriptions(self, version: nn.Version) -> bytes:
        """Return the content of the descriptions: a marker set, then the rigid bodies."""
        parts = [(0, b"all\0" + _COUNT.pack(2) + b"a\0b\0")]
        names = {BODY: self.name} | {BODY + 1 + k: f"other {k}" for k in range(self.extra)}
        for number, name in names.items():
            content = name.encode() + b"\0" + struct.pack("<Ii3f", number, -1, 0, 0, 0)
            content += struct.pack("<4f", 0, 0, 0, 1) if version >= (4, 2) else b""
            content += struct.pack("<I6f2I", 2, *range(6), 0, 0)
            content += b"m1\0m2\0" if version >= (4, 0) else b""
            parts.append((1, content))
        if version < nn.FIRST_SIZED:  # a description after those of the rigid bodies
            parts.append((5, b"camera\0" + struct.pack("<7f", *range(7))))
        out = _COUNT.pack(len(parts))
        for kind, content in parts:
            size = _COUNT.pack(len(content)) if version >= nn.FIRST_SIZED else b""
            out += _COUNT.pack(kind) + size + content
        return out

    def step(self, wait: float) -> None:
        """Serve a request, if one comes within `wait` s."""
        if not select.select([self.line], [], [], max(wait, 0.0))[0]:
            return
        data, sender = self.line.recvfrom(1 << 16)
        with contextlib.suppress(struct.error):
            self._serve(*nn.unpacked(data), sender)

    def _serve(self, number: int, content: bytes, sender: tuple[str, int]) -> None:
        version, _ = self.clients.get(sender, (self.version, 0.0))
        if number == nn.CONNECT:
            requested = (content[265], content[266]) if len(content) > 266 else self.version
            version = self.version
            if version >= (4, 0) and not self.group and not self.insist:
                version = min(requested, version)
            name = NAME.encode().ljust(256, b"\0")
            group = bytes(map(int, self.group.split("."))) if self.group else bytes(4)
            facts = struct.pack("<4B4B", 3, 1, 0, 0, *version, 0, 0)
            facts += struct.pack("<QHB4B", 10_000_000, nn.DATA_PORT, bool(self.group), *group)
            self._answer(sender, nn.message(nn.SERVER_INFO, name + facts))
        elif number == nn.REQUEST_DESCRIPTIONS:
            self._answer(sender, nn.message(nn.DESCRIPTIONS, self.descriptions(version)))
        elif number == nn.REQUEST:
            command = content.split(b"\0")[0].decode("ascii", "replace")
            numbers = command.removeprefix("Bitstream,").split(".")
            good = command.startswith("Bitstream,") and self.version >= (4, 0) and not self.group
            if good:
                version = int(numbers[0]), int(numbers[1])
            self._answer(sender, nn.message(nn.RESPONSE, struct.pack("<i", 0 if good else 1)))
        elif number != nn.KEEP_ALIVE or sender not in self.clients:
            return
        self.clients[sender] = version, time.monotonic()

    def _answer(self, sender: tuple[str, int], data: bytes) -> None:
        with contextlib.suppress(OSError):
            self.line.sendto(data, sender)

    def send(self) -> None:
        """Send a frame to all clients, or to the group."""
        self.number += not self.paused
        if self.stalled or self.rng.random() < self.lose:
            return
        if self.group:
            self._answer((self.group, nn.DATA_PORT), nn.message(nn.FRAME, self.frame(self.version)))
            return
        now = time.monotonic()
        self.clients = {
            client: (v, last)
            for client, (v, last) in self.clients.items()
            if now - last < FORGOTTEN_S
        }
        for client, (version, _) in list(self.clients.items()):
            self._answer(client, nn.message(nn.FRAME, self.frame(version)))


def operations(cameras: Cameras) -> admin.Operations:
    """Return the admin operations of the cameras."""

    def state() -> dict[str, Any]:
        versions = [list(version) for version, _ in cameras.clients.values()]
        return {"frames": cameras.number, "clients": versions, "hidden": cameras.hidden}

    functions: dict[str, Callable[..., object]] = {
        "beam": admin.setter(cameras, "hidden"),
        "stall": admin.setter(cameras, "stalled"),
        "pause": admin.setter(cameras, "paused"),
        "insist": admin.setter(cameras, "insist"),
        "lose": admin.setter(cameras, "lose", float),
        "forget": lambda: cameras.clients.clear(),
        "rename": admin.setter(cameras, "name", str),
        "bodies": admin.setter(cameras, "extra", int),
    }
    return admin.Operations(functions, state)


def start(options: admin.Arguments) -> admin.Device:
    """Return the cameras, listening, and the step that sends frames at their rate."""
    noise, distortion = np.random.default_rng(options.seed).spawn(2)
    board = Blackboard(options.directory / "world.bin")
    line = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    line.bind((options.host, options.port or nn.PORT))
    if options.multicast:
        host = socket.inet_aton(options.host)
        line.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, host)
    direction = distortion.standard_normal((6, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    waves = np.column_stack([direction, distortion.uniform(0.0, 2 * np.pi, 6)])
    major, minor = map(int, options.version.split("."))
    cameras = Cameras(
        *(board, noise, line, (major, minor), options.frame_std, waves, options.distortion),
        options.multicast,
    )
    period = 1.0 / min(RATE_HZ * board.scale, FASTEST_HZ)
    due = time.monotonic()

    def step() -> None:
        nonlocal due
        cameras.step(due - time.monotonic())
        now = time.monotonic()
        if now >= due:
            cameras.send()
            due = max(due + period, now)

    return operations(cameras), step


OPTIONS: dict[str, dict[str, Any]] = {
    **admin.NETWORK,
    "--version": {"default": "4.1"},
    "--multicast": {"default": ""},
    "--frame-std": {"type": float, "default": 5e-5},
    "--distortion": {"type": float, "default": 1e-4},
}

if __name__ == "__main__":
    admin.run(__doc__, "tracker", start, OPTIONS)
