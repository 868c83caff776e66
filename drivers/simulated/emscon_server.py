"""A simulated laser tracker that speaks emScon on TCP; admin `tracker.sock`.

    python -m hilcal.drivers.simulated.emscon_server --directory DIR --host 127.A.B.C [--port 7000]
        --range-std A B --transverse-std C E --orientation-std S --seed N

One client at a time, as an AT40x. Admin operations: `beam {on}` blocks it, `hide {targets}`,
`lock_lost`, `freeze {on}`, `stray {on}`, `uninitialize` loses the zeros, `reflector {number}` sets
another one at the controller, `fail {command, status, count}`, `change {number}` reports a change
of state, `transform {on}` sets an object's coordinate system, `drop` closes the connection,
`mute {on}`, `rubbish {data}` sends data that are no packet, `log`, `state`.

Source: as `hilcal.drivers.emscon_packets`. CESAPI, an independent client, is tested against it.
"""

import contextlib
import select
import socket
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hilcal.drivers import emscon_packets as es
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.blackboard import Blackboard, settled_truth
from hilcal.drivers.simulated.geocom_server import PolarPoint, Station
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
"""By command: the command that reads the setting, and the change of state reported."""
_QUERIES = (es.GET_SYSTEM_STATUS, es.GET_REFLECTORS, es.GET_TRACKER_INFO, es.GET_ENVIRONMENT,
            es.GET_STATUS_INFO)  # fmt: skip
INFO = struct.pack("<iiiidddiiddIii", 1, 1, 1, 1, 0.0, 160.0, 0.8, 10, 2, 3.14, 3.14, 1, 1, 0)
"""Equipment and limits of the tracker: the end of the answer to GetTrackerInfo."""


@dataclass(slots=True, eq=False)
class SimulatedTracker:
    """Settings and answers of the tracker."""

    station: Station
    rng: np.random.Generator  # of the orientation's noise
    initialized: bool = True
    settings: dict[int, bytes] = field(default_factory=lambda: dict(DEFAULTS))
    """Settings by the command that reads them."""
    failing: dict[int, tuple[int, int]] = field(default_factory=dict)
    """By command: status, and number of next answers that have it."""
    mute: bool = False
    client: socket.socket | None = None
    log: deque[int] = field(default_factory=lambda: deque(maxlen=10_000))

    def setting(self, command: int, layout: str) -> tuple[Any, ...]:
        """Return the values that a command reads."""
        return struct.unpack(layout, self.settings[command])

    def send(self, kind: int, body: bytes) -> None:
        """Send a packet to the client, if any."""
        if self.client is not None and not self.mute:
            with contextlib.suppress(OSError):  # a lost client is noticed when reading
                self.client.sendall(es.HEADER.pack(es.HEADER.size + len(body), kind) + body)

    def report(self, change: int) -> None:
        """Report a change of state, if the client has enabled reports."""
        if self.setting(es.GET_SETTINGS, "<I8i")[4]:
            self.send(es.CHANGE, struct.pack("<I", change))

    def carry_out(self, command: int, body: bytes) -> None:
        """Carry out a command and answer it."""
        self.log.append(command)
        status, count = self.failing.pop(command, (es.OK, 0))
        if count > 1:
            self.failing[command] = status, count - 1
        changed, answers = None, [b""]
        if status != es.OK:
            pass
        elif command in self.settings:
            answers = [self.settings[command]]
        elif command in SETS:
            reader, change = SETS[command]
            if len(body) != len(self.settings[reader]):
                status = WRONG_PARAMETER
            else:
                changed = change if self.settings[reader] != body else None
                self.settings[reader] = body
        elif command in _QUERIES:
            answers = self._answers(command)
        elif command == es.INITIALIZE:
            self.station.wait(5.0)
            self.initialized, changed = True, es.INITIALIZATION_CHANGED
        elif command not in (es.START_MEASUREMENT, es.GO_POSITION, es.FIND_REFLECTOR):
            status = es.NOT_IMPLEMENTED
        elif command != es.GO_POSITION and not self.initialized:
            status = es.NOT_INITIALIZED
        elif command != es.START_MEASUREMENT:
            status = self._acquire(command, body)
        for answer in answers:
            self.send(es.COMMAND, struct.pack("<II", command, status) + answer)
        if changed is not None:
            self.report(changed)
        if command == es.START_MEASUREMENT and status == es.OK:
            self._measure()

    def environment(self) -> tuple[float, float, float]:
        """Return temperature °C, pressure mbar, relative humidity %."""
        air = float(self.station.board.read("truth")["air_temperature"])
        return (air if air != 0.0 else ROOM), MBAR, HUMIDITY

    def _answers(self, query: int) -> list[bytes]:
        if query == es.GET_ENVIRONMENT:
            return [struct.pack("<3d", *self.environment())]
        if query == es.GET_REFLECTORS:
            return [
                struct.pack("<iiId64s", len(REFLECTORS), number, 5, 0, _text(name))
                for number, name in REFLECTORS.items()
            ]
        if query == es.GET_TRACKER_INFO:
            return [struct.pack("<I64si", 70, _text(NAME), SERIAL) + INFO]
        if query == es.GET_SYSTEM_STATUS:
            state = es.INITIALIZED if self.initialized else es.BOOTED
            return [struct.pack("<4I3iI2i", es.OK, state, 3, 2, 3, 8, 900, 2, 0, SERIAL)]
        held = es.REFLECTOR_FOUND if self.station.held_target() is not None else 0
        return [struct.pack("<Ii", es.OK, 15 | 4096 | es.LEVELLED | held)]

    def _acquire(self, command: int, body: bytes) -> int:
        """Turn to the expected reflector, and search for it; return the status."""
        station = self.station
        if command == es.GO_POSITION:
            goal = PolarPoint.of(np.array(struct.unpack("<3di", body)[:3]))
            station.turn(goal.hz, goal.v)
            station.pointing = goal
            if not self.initialized:
                return es.NOT_INITIALIZED
        distance = station.pointing.distance or station.distance or 2.0
        radius = self.setting(44, "<di")[0]
        acquired = station.acquire(float(np.arctan2(radius, distance)))
        return es.OK if acquired else es.NO_RESULT

    def _measure(self) -> None:
        """Measure and send the result, in the units and coordinates set."""
        station, noise = self.station, self.station.noise
        station.meas_s = self.setting(es.GET_STATIONARY, "<2i")[0] * 1e-3
        station.start_ranging()
        station.finish_ranging(station.meas_s)
        polar = station.newest
        if polar is None or station.distance == 0.0:
            self.send(es.ERROR, struct.pack("<II", es.START_MEASUREMENT, es.NO_RESULT))
            return
        (mode,) = self.setting(es.GET_MODE, "<I")
        length, angle, *_ = self.setting(es.GET_UNITS, "<5I")
        a, b = (1.0, 1e3, 1e6)[length], (1.0, np.rad2deg(1.0), 200 / np.pi)[angle]
        transformed = self.setting(es.GET_SETTINGS, "<I8i")[1]
        origin = np.array([1.0, 2.0, 3.0]) if transformed else np.zeros(3)
        position: Floats = polar.distance * polar.direction()
        covariance = a * a * noise.covariance(position[None], 3)[0]
        turn: Floats | None = None
        angle_covariance: Floats = np.zeros((3, 3))
        angles: Floats = np.zeros(3)
        if mode == es.STATIONARY_6D:
            rotation = settled_truth(station.board)["target_rotation"]
            error = Rotation.from_rotvec(noise.orientation_std * self.rng.normal(size=3))
            observed = error * Rotation.from_matrix(rotation)
            turn, angles = np.roll(observed.as_quat(), 1), observed.as_euler("xyz")
            J = _rates(angles)
            variance = (b * noise.orientation_std) ** 2
            angle_covariance = np.asarray(variance * np.linalg.inv(J.T @ J))
        m = es.Measurement(a * (position + origin), covariance, turn, b * angles, angle_covariance)
        kind, packed = es.pack_measurement(m, mode, self.environment())
        self.send(kind, struct.pack("<I", es.OK) + packed)


def _rates(angles: Floats) -> Floats:
    """(3, 3) angular velocity about the tracker's axes per rate of x, y, z of R = Rz Ry Rx."""
    _, b, c = map(float, angles)
    cb, sb, cc, sc = np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    return np.array([[cc * cb, -sc, 0.0], [sc * cb, cc, 0.0], [-sb, 0.0, 1.0]])


def _text(text: str) -> bytes:
    return text.encode("utf-16-le").ljust(64, b"\0")


def operations(t: SimulatedTracker) -> admin.Operations:
    """Return the admin operations of the tracker."""
    station = t.station

    def uninitialize() -> None:
        t.initialized = False
        t.report(es.INITIALIZATION_CHANGED)

    def reflector(number: int) -> None:
        t.settings[es.GET_REFLECTOR] = struct.pack("<i", number)
        t.report(es.REFLECTOR_CHANGED)

    def transform(on: bool) -> None:
        settings = list(t.setting(es.GET_SETTINGS, "<I8i"))
        settings[1] = int(on)
        t.settings[es.GET_SETTINGS] = struct.pack("<I8i", *settings)
        t.report(8)

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

    functions: dict[str, Callable[..., object]] = {
        **station.faults(),
        "uninitialize": uninitialize,
        "reflector": reflector,
        "fail": lambda command, status, count=1: t.failing.update({command: (status, count)}),
        "change": lambda number: t.report(int(number)),
        "transform": transform,
        "drop": drop,
        "mute": admin.setter(t, "mute"),
        "rubbish": rubbish,
        "log": lambda: list(t.log),
    }
    return admin.Operations(functions, state)


def serve(t: SimulatedTracker, door: socket.socket) -> None:
    """Answer the next client until it disconnects."""
    t.client, _ = door.accept()
    with t.client:
        buffer = bytearray()
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
            buffer += data
            while len(buffer) >= 12:
                size, kind, command = struct.unpack_from("<iII", buffer)
                if not 12 <= size <= es.LARGEST or kind != es.COMMAND:
                    buffer.clear()
                    break
                if len(buffer) < size:
                    break
                body = bytes(buffer[12:size])
                del buffer[:size]
                t.carry_out(command, body)
    t.client = None


def start(options: admin.Arguments) -> admin.Device:
    """Return the tracker, listening."""
    polar, orientation = np.random.default_rng(options.seed).spawn(2)
    along, across = tuple(options.range_std), tuple(options.transverse_std)
    board = Blackboard(options.directory / "world.bin")
    noise = SimulatedNoise(along, across, options.orientation_std)
    tracker = SimulatedTracker(Station(board, noise, polar), orientation)
    door = socket.create_server((options.host, options.port or 7000), backlog=1)
    return operations(tracker), partial(serve, tracker, door)


OPTIONS: dict[str, dict[str, Any]] = {
    **admin.NETWORK,
    **admin.NOISE,
    "--orientation-std": {"type": float, "default": 8.7e-5},
}

if __name__ == "__main__":
    admin.run(__doc__, "tracker", start, OPTIONS)
