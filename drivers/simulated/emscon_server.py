"""A simulated laser tracker that speaks emScon on TCP; admin `tracker.sock`.

    python -m hilcal.drivers.simulated.emscon_server --directory DIR --host 127.A.B.C [--port 7000]
        --range-std A B --transverse-std C E --orientation-std S --seed N

One client at a time, as an AT40x. Admin operations: `beam {on}` blocks it, `hide {targets}`,
`lock_lost`, `freeze {on}`, `stray {on}`, `uninitialize` loses the zeros, `reflector {number}` sets
another one at the controller, `fail {command, status, count}`, `change {number}` tells a change of
state, `transform {on}` sets an object's coordinate system, `drop` closes the connection,
`mute {on}`, `rubbish {data}` sends what is no packet, `log`, `state`.

Source: as `hilcal.drivers.emscon_packets`. CESAPI, a client of others, is tested against it.
"""

import contextlib
import select
import socket
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.drivers import emscon_packets as es
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard, settled_truth
from hilcal.drivers.simulated.geocom_server import Beam, PolarPoint, Station
from hilcal.drivers.simulated.world import SimulatedNoise
from hilcal.types import Floats

NAME, SERIAL = "SIM AT401", 391234
REFLECTORS = {1: "RRR 1.5in", 2: "RRR 0.5in"}
WRONG_PARAMETER = 3
MBAR, HUMIDITY, ROOM = 1013.25, 45.0, 20.0
_PULSE = 0.02

DEFAULTS = {
    es.GET_UNITS: struct.pack("<5I", 1, 1, 0, 0, 0),  # mm and degrees
    es.GET_COORDINATES: struct.pack("<I", 0),
    es.GET_STATISTICS: struct.pack("<2I", 0, 0),
    es.GET_MODE: struct.pack("<I", es.STATIONARY),
    es.GET_STATIONARY: struct.pack("<2i", 2000, 1),
    es.GET_SETTINGS: struct.pack("<I8i", 2, 0, 0, 1, 0, 0, 0, 1, 0),
    es.GET_REFLECTOR: struct.pack("<i", 1),
    44: struct.pack("<di", 0.05, 5000),  # search
}
SETS = {
    es.SET_UNITS: (es.GET_UNITS, 6),
    es.SET_COORDINATES: (es.GET_COORDINATES, 12),
    es.SET_STATISTICS: (es.GET_STATISTICS, 24),
    es.SET_MODE: (es.GET_MODE, 17),
    es.SET_STATIONARY: (es.GET_STATIONARY, 18),
    es.SET_SETTINGS: (es.GET_SETTINGS, 8),
    es.SET_REFLECTOR: (es.GET_REFLECTOR, es.REFLECTOR_CHANGED),
    es.SET_SEARCH: (44, 4),
}
"""By command: what it sets, and the change of state that is told."""


@dataclass(slots=True, eq=False)
class SimulatedTracker:
    """What the tracker is set to and what it answers."""

    station: Station
    noise: SimulatedNoise
    rng: np.random.Generator  # of the orientation's noise
    initialized: bool = True
    settings: dict[int, bytes] = field(default_factory=lambda: dict(DEFAULTS))
    """What the commands have set, by the command that reads it."""
    failing: dict[int, tuple[int, int]] = field(default_factory=dict)
    """Status and how many next answers have it, by command."""
    mute: bool = False
    client: socket.socket | None = None
    asked: deque[int] = field(default_factory=lambda: deque(maxlen=10_000))

    def send(self, kind: int, body: bytes) -> None:
        """Send a packet to who is connected."""
        if self.client is not None and not self.mute:
            with contextlib.suppress(OSError):  # gone; seen when it is read from
                self.client.sendall(es.HEADER.pack(es.HEADER.size + len(body), kind) + body)

    def tell(self, change: int) -> None:
        """Tell a change of state, where the client wants to hear of it."""
        if struct.unpack("<I8i", self.settings[es.GET_SETTINGS])[4]:
            self.send(es.CHANGE, struct.pack("<I", change))

    def answer(self, command: int, status: int, body: bytes = b"") -> None:
        """Answer a command."""
        self.send(es.COMMAND, struct.pack("<II", command, status) + body)

    def carry_out(self, command: int, body: bytes) -> None:
        """Carry out a command and answer it."""
        self.asked.append(command)
        status, count = self.failing.pop(command, (es.OK, 0))
        if count > 1:
            self.failing[command] = status, count - 1
        if status != es.OK:
            self.answer(command, status)
        elif command in self.settings:
            self.answer(command, es.OK, self.settings[command])
        elif command in SETS:
            what, change = SETS[command]
            if len(body) != len(self.settings[what]):
                self.answer(command, WRONG_PARAMETER)
                return
            changed = self.settings[what] != body
            self.settings[what] = body
            self.answer(command, es.OK)
            if changed:
                self.tell(change)
        elif command in _DO:
            _DO[command](self, body)
        else:
            self.answer(command, es.NOT_IMPLEMENTED)

    def status(self) -> int:
        """Return the bits of its state."""
        held = es.REFLECTOR_FOUND if self.station.held() is not None else 0
        return 15 | 4096 | es.LEVELLED | held

    def environment(self) -> tuple[float, float, float]:
        """Return temperature °C, pressure mbar, relative humidity %."""
        air = float(self.station.board.read("truth")["air_temperature"])
        return (air if air != 0.0 else ROOM), MBAR, HUMIDITY

    def measured(self) -> es.Measurement | None:
        """Measure, in m and rad; None without a target."""
        milliseconds, _ = struct.unpack("<2i", self.settings[es.GET_STATIONARY])
        self.station.meas_s = milliseconds * 1e-3
        self.station.start_ranging()
        self.station.finish_ranging(self.station.meas_s)
        seen = self.station.seen
        if seen is None or self.station.distance == 0.0:
            return None
        position: Floats = seen.distance * seen.direction()
        covariance = self.noise.covariance(position[None], 3)[0]
        turn: Floats | None = None
        turned: Floats = np.zeros((3, 3))
        angles = np.zeros(3)
        if struct.unpack("<I", self.settings[es.GET_MODE])[0] == es.STATIONARY_6D:
            rotation = settled_truth(self.station.board)["target_rotation"]
            moved = Rotation.from_rotvec(self.noise.orientation_std * self.rng.normal(size=3))
            seen_turn = moved * Rotation.from_matrix(rotation)
            turn, angles = np.roll(seen_turn.as_quat(), 1), seen_turn.as_euler("xyz")
            J = _rates(angles)
            turned = np.asarray(self.noise.orientation_std**2 * np.linalg.inv(J.T @ J))
        return es.Measurement(position, covariance, turn, angles, turned, self.environment())

    def in_units(self, m: es.Measurement) -> es.Measurement:
        """Return a measurement in the units and coordinates that are set."""
        length, angle, *_ = struct.unpack("<5I", self.settings[es.GET_UNITS])
        a, b = (1.0, 1e3, 1e6)[length], (1.0, np.rad2deg(1.0), 200 / np.pi)[angle]
        settings = struct.unpack("<I8i", self.settings[es.GET_SETTINGS])
        moved = np.array([1.0, 2.0, 3.0]) if settings[1] else np.zeros(3)
        c, t = a * a * m.covariance, b * b * m.angle_covariance
        return es.Measurement(
            a * (m.position + moved), c, m.quaternion, b * m.angles, t, m.environment
        )


def _rates(angles: Floats) -> Floats:
    """(3, 3) angular velocity about the tracker's axes per rate of x, y, z of R = Rz Ry Rx."""
    _, b, c = map(float, angles)
    cb, sb, cc, sc = np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    return np.array([[cc * cb, -sc, 0.0], [sc * cb, cc, 0.0], [-sb, 0.0, 1.0]])


def _measure(t: SimulatedTracker, body: bytes) -> None:
    if not t.initialized:
        t.answer(es.START_MEASUREMENT, es.NOT_INITIALIZED)
        return
    t.answer(es.START_MEASUREMENT, es.OK)
    m = t.measured()
    if m is None:
        t.send(es.ERROR, struct.pack("<II", es.START_MEASUREMENT, es.NO_RESULT))
        return
    mode = struct.unpack("<I", t.settings[es.GET_MODE])[0]
    kind, packed = es.pack_measurement(t.in_units(m), mode)
    t.send(kind, struct.pack("<I", es.OK) + packed)


def _initialize(t: SimulatedTracker, body: bytes) -> None:
    t.station.wait(5.0)
    t.initialized = True
    t.answer(es.INITIALIZE, es.OK)
    t.tell(es.INITIALIZATION_CHANGED)


def _acquire(t: SimulatedTracker, command: int) -> None:
    if not t.initialized:
        t.answer(command, es.NOT_INITIALIZED)
        return
    distance = t.station.pointing.distance or t.station.distance or 2.0
    radius = struct.unpack("<di", t.settings[44])[0]
    found = t.station.acquire(float(np.arctan2(radius, distance)))
    t.answer(command, es.OK if found else es.NO_RESULT)


def _go(t: SimulatedTracker, body: bytes) -> None:
    at = PolarPoint.of(np.array(struct.unpack("<3di", body)[:3]))
    t.station.turn(at.hz, at.v)
    t.station.pointing = at
    _acquire(t, es.GO_POSITION)


def _reflectors(t: SimulatedTracker, body: bytes) -> None:
    for number, name in REFLECTORS.items():
        words = name.encode("utf-16-le").ljust(64, b"\0")
        t.answer(
            es.GET_REFLECTORS, es.OK, struct.pack("<iiId64s", len(REFLECTORS), number, 5, 0, words)
        )


def _info(t: SimulatedTracker, body: bytes) -> None:
    words = NAME.encode("utf-16-le").ljust(64, b"\0")
    rest = struct.pack("<iiiidddiiddIii", 1, 1, 1, 1, 0.0, 160.0, 0.8, 10, 2, 3.14, 3.14, 1, 1, 0)
    t.answer(es.GET_TRACKER_INFO, es.OK, struct.pack("<I64si", 70, words, SERIAL) + rest)


def _system(t: SimulatedTracker, body: bytes) -> None:
    state = es.INITIALIZED if t.initialized else es.BOOTED
    packed = struct.pack("<4I3iI2i", es.OK, state, 3, 2, 3, 8, 900, 2, 0, SERIAL)
    t.answer(es.GET_SYSTEM_STATUS, es.OK, packed)


_DO: dict[int, Callable[[SimulatedTracker, bytes], None]] = {
    es.GET_SYSTEM_STATUS: _system,
    es.INITIALIZE: _initialize,
    es.START_MEASUREMENT: _measure,
    es.FIND_REFLECTOR: lambda t, body: _acquire(t, es.FIND_REFLECTOR),
    es.GO_POSITION: _go,
    es.GET_REFLECTORS: _reflectors,
    es.GET_TRACKER_INFO: _info,
    es.GET_ENVIRONMENT: lambda t, body: t.answer(
        es.GET_ENVIRONMENT, es.OK, struct.pack("<3d", *t.environment())
    ),
    es.GET_STATUS_INFO: lambda t, body: t.answer(
        es.GET_STATUS_INFO, es.OK, struct.pack("<Ii", es.OK, t.status())
    ),
}


def operations(t: SimulatedTracker) -> admin.Operations:
    """Return what can be asked of the tracker."""
    station = t.station

    def uninitialize() -> None:
        t.initialized = False
        t.tell(es.INITIALIZATION_CHANGED)

    def reflector(number: int) -> None:
        t.settings[es.GET_REFLECTOR] = struct.pack("<i", number)
        t.tell(es.REFLECTOR_CHANGED)

    def transform(on: bool) -> None:
        settings = list(struct.unpack("<I8i", t.settings[es.GET_SETTINGS]))
        settings[1] = int(on)
        t.settings[es.GET_SETTINGS] = struct.pack("<I8i", *settings)
        t.tell(8)

    def drop() -> None:
        if t.client is not None:
            t.client.shutdown(socket.SHUT_RDWR)

    def rubbish(data: str) -> None:
        if t.client is not None:
            t.client.sendall(data.encode())

    def state() -> dict[str, Any]:
        return {
            "locked": station.locked,
            "beam": station.broken,
            "initialized": t.initialized,
            "measured": station.measured,
            "settings": {str(k): v.hex() for k, v in t.settings.items()},
        }

    own: dict[str, Callable[..., object]] = {
        **station.faults(),
        "uninitialize": uninitialize,
        "reflector": reflector,
        "fail": lambda command, status, count=1: t.failing.update({command: (status, count)}),
        "change": lambda number: t.tell(int(number)),
        "transform": transform,
        "drop": drop,
        "mute": admin.setter(t, "mute"),
        "rubbish": rubbish,
        "log": lambda: list(t.asked),
    }
    return admin.Operations(own, state)


def serve(t: SimulatedTracker, door: socket.socket) -> None:
    """Answer for ever, one client after another."""
    while True:
        t.client, _ = door.accept()
        with t.client:
            came = bytearray()
            while True:
                t.station.tick()
                if not select.select([t.client], [], [], _PULSE)[0]:
                    continue
                try:
                    data = t.client.recv(es.LARGEST)
                except OSError:
                    data = b""
                if not data:
                    break
                came += data
                while len(came) >= 12:
                    size, kind, command = struct.unpack_from("<iII", came)
                    if not 12 <= size <= es.LARGEST or kind != es.COMMAND:
                        came.clear()
                        break
                    if len(came) < size:
                        break
                    body = bytes(came[12:size])
                    del came[:size]
                    t.carry_out(command, body)
        t.client = None


def main() -> None:
    """Run until the parent ends."""
    parser = admin.device_parser(__doc__)
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, default=7000)
    parser.add_argument("--range-std", type=float, nargs=2, required=True)
    parser.add_argument("--transverse-std", type=float, nargs=2, required=True)
    parser.add_argument("--orientation-std", type=float, default=8.7e-5)
    options = parser.parse_args()
    admin.end_with_parent()
    measuring, turning = np.random.default_rng(options.seed).spawn(2)
    along, across = tuple(options.range_std), tuple(options.transverse_std)
    board = Blackboard.attach(options.directory / "world.bin")
    tracker = SimulatedTracker(
        Station(board, Beam(along, across), measuring),
        SimulatedNoise(along, across, options.orientation_std),
        turning,
    )
    door = socket.create_server((options.host, options.port), backlog=1)
    admin.serve(options.directory / "tracker.sock", operations(tracker))
    serve(tracker, door)


if __name__ == "__main__":
    main()
