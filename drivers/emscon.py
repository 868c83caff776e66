"""Leica laser trackers by emScon over TCP: AT40x, AT901, LTD; reflectors, and 6-D targets.

Readings are Cartesian in the tracker's own axes, in m. Their covariance is the one that the tracker
states a priori. For the orientation, the tracker states the covariance of the rotation angles a
about x, y and z; with the rotation R(a),

    Cov(small rotation about the tracker's axes) = J Cov(a) Jᵀ,    J_k = log(R(a + h e_k) Rᵀ) / h

Source: Leica Geosystems, emScon TPI V3.6 (`emscon_packets`).
"""

import contextlib
import math
import socket
import struct
import time
from collections.abc import Callable, Iterator
from typing import Any, Literal, NoReturn

import numpy as np
from pydantic import Field
from scipy.spatial.transform import Rotation

from hilcal.config import CellConfig
from hilcal.config.cell import Tracker as TrackerConfig
from hilcal.drivers import emscon_packets as es
from hilcal.drivers.links import address, check_tracker_frame, network_failures
from hilcal.errors import DeviceError, InputError, undone_by
from hilcal.measuring.devices import Clock, Report, Row, TargetLostError, TrackerSample, report_of
from hilcal.readings.covariance import tracker_covariance, tracker_noise
from hilcal.toml import Positive, Section, check_section
from hilcal.types import Floats

DEVICE = "tracker"
CONNECT_S = 2.0  # longest wait for the connection, real s
DEADLINE_S = 4.0  # longest wait for an answer, without time of measuring or moving, real s
SEARCHING_S = 30.0
"""Longest turn or search for the reflector, cell s; at least `_LEAST_S` real s."""
HOMING_S = 120.0  # longest search for the tracker's zeros, cell s
HOMED = "the tracker was initialised again before this reading: its axes may have moved"
_LEAST_S, _PAUSE_S = 1.0, 0.1
_FARTHEST_M = 500.0  # beyond the reach of any tracker
_UNITS = struct.pack("<5I", 0, 0, 0, 0, 0)  # m, rad, °C, mbar, % of relative humidity
_ORDERS = ("xyz", "XYZ")
_STEP, _SAME_ROTATION = 1e-6, 1e-4  # rad


class EmsconOptions(Section):
    """[tracker.options]: keys of the driver "emscon"."""

    target: Literal["position", "pose"] = Field(
        "position", description='"position" (a reflector) or "pose" (a 6-D target: T-Probe, T-Mac)'
    )
    reflector: str | None = Field(
        None,
        min_length=1,
        description="the name of the reflector in the tracker's list; the one that is set if "
        "absent",
        examples=["RRR 1.5in"],
    )
    measuring_s: Positive = Field(
        0.5, description="how long the tracker averages for one measurement in s, over 0"
    )
    search_m: Positive = Field(
        0.1, description="radius in m in which the reflector is searched, over 0"
    )


class EmsconConnection:
    """A connection to an emScon server; `changes`: state changes received, not yet handled."""

    def __init__(self, host: str, port: int) -> None:
        """Connect; raises DeviceError without an answer within `CONNECT_S`."""
        self.where = f"{host}:{port}"
        with network_failures(DEVICE, self.where):
            self._socket = socket.create_connection((host, port), CONNECT_S)
        self._buffer = bytearray()
        self.changes: list[int] = []
        self.open = True

    def close(self) -> None:
        """Close the connection. Never raises; may be called twice."""
        self.open = False
        self._socket.close()

    def ask(self, command: int, parameters: bytes = b"", *, deadline: float) -> tuple[int, bytes]:
        """Send a command, again while the server is busy; return its status and content."""
        while True:
            body = struct.pack("<I", command) + parameters
            with self._failures():
                self._socket.settimeout(DEADLINE_S)
                self._socket.sendall(es.HEADER.pack(es.HEADER.size + len(body), es.COMMAND) + body)
            status, returned = self.answer(command, deadline=deadline)
            if status != es.BUSY or time.monotonic() + _PAUSE_S > deadline:
                return status, returned
            time.sleep(_PAUSE_S)

    def answer(self, command: int, *, deadline: float) -> tuple[int, bytes]:
        """Return the next answer to a command; late answers to other commands are dropped."""
        while True:
            kind, body = self._packet(deadline)
            if kind in (es.COMMAND, es.ERROR):
                number, status = self._command_and_status(body)
                if number == command or (kind == es.ERROR and number == es.UNKNOWN):
                    return status, body[8:]

    def result(self, *, deadline: float) -> tuple[int, int, bytes]:
        """Return type, status and content of the result of the running measurement."""
        while True:
            kind, body = self._packet(deadline)
            if kind in (es.SINGLE, es.SINGLE2, es.PROBE):
                if len(body) < 4:
                    self.refuse("a packet that is cut short")
                return kind, int.from_bytes(body[:4], "little"), body[4:]
            if kind == es.ERROR and self._command_and_status(body)[0] in (
                es.START_MEASUREMENT,
                es.UNKNOWN,
            ):
                return kind, self._command_and_status(body)[1], b""

    def drain(self) -> None:
        """Read what the server has sent by itself; old results are dropped."""
        with contextlib.suppress(BlockingIOError):
            while True:
                self._packet(0.0)

    def unpack(self, layout: str, body: bytes) -> tuple[Any, ...]:
        """Unpack the content of an answer, which may be longer than the layout."""
        try:
            return struct.unpack_from(layout, body)
        except struct.error:
            self.refuse("an answer that is too short")

    def _command_and_status(self, body: bytes) -> tuple[int, int]:
        if len(body) < 8:
            self.refuse("a packet that is cut short")
        number, status = struct.unpack_from("<II", body)
        return number, status

    @contextlib.contextmanager
    def _failures(self) -> Iterator[None]:
        """Turn what the socket raises into DeviceError, and close the connection."""
        try:
            with network_failures(DEVICE, self.where):
                yield
        except DeviceError:
            self.close()
            raise

    def _packet(self, until: float) -> tuple[int, bytes]:
        """Type and content of the next packet; state changes go to `changes`.

        With `until` 0, raises BlockingIOError if no packet waits.
        """
        while True:
            if len(self._buffer) >= es.HEADER.size:
                size, kind = es.HEADER.unpack_from(self._buffer)
                if not es.HEADER.size <= size <= es.LARGEST:
                    self.refuse("data that are not emScon packets")
                if len(self._buffer) >= size:
                    body = bytes(self._buffer[es.HEADER.size : size])
                    del self._buffer[:size]
                    if kind == es.CHANGE and len(body) == 4:
                        self.changes.append(int.from_bytes(body, "little"))
                        continue
                    return kind, body
            self._receive(until)

    def _receive(self, until: float) -> None:
        with self._failures():
            remaining = until - time.monotonic()
            if until and remaining <= 0.0:
                raise TimeoutError
            self._socket.settimeout(remaining if until else 0.0)
            try:
                data = self._socket.recv(es.LARGEST)
            except BlockingIOError:  # until is 0
                data = None
        if data is None:
            raise BlockingIOError
        if not data:
            self.close()
            raise DeviceError(f"{DEVICE} at {self.where}: the tracker has closed the connection")
        self._buffer += data

    def refuse(self, content: str) -> NoReturn:
        """Refuse what the server sent, and close the connection."""
        self.close()
        raise DeviceError(
            f"{DEVICE} at {self.where}: it sends {content}; is an emScon server at this address?"
        )


class EmsconTracker:
    """An emScon tracker as a `hilcal.measuring.devices.PointingTracker`; m = 3, or 6 of poses."""

    def __init__(
        self,
        connect: Callable[[], EmsconConnection],
        config: TrackerConfig,
        options: EmsconOptions,
        clock: Clock,
    ) -> None:
        """Connect and set units, axes and mode; nothing turns."""
        self._connect, self._config, self._options, self._clock = connect, config, options, clock
        self._moving_s = max(_LEAST_S, clock.real(SEARCHING_S))
        self._reflector: tuple[int, str] | None = None
        self._remarks: list[str] = []
        self._distance = 2.0
        self._line = connect()
        with undone_by(self._line.close):
            self._set_up(time.monotonic() + DEADLINE_S)

    def measure(self) -> TrackerSample:
        """Measure once; a reading of a reflector that has been changed is refused."""
        result = self._measure()
        self._distance = float(np.linalg.norm(result.position))
        stated = result.covariance
        if not _positive_definite(stated):
            stated = tracker_covariance(result.position[None], tracker_noise(self._config))[0]
        value, covariance = result.position, stated
        if result.quaternion is not None:
            turn = Rotation.from_quat(np.roll(result.quaternion, -1))  # scalar last
            value = np.concatenate([value, turn.as_rotvec()])
            covariance = np.zeros((6, 6))
            covariance[:3, :3], covariance[3:, 3:] = stated, self._turn_covariance(result, turn)
        remarks, self._remarks = "; ".join(dict.fromkeys(self._remarks)), []
        return TrackerSample(time.monotonic_ns(), value, covariance, remarks)

    def aim(self, position: Floats, radius: float) -> None:
        """Turn to an expected reflector and hold it; see `PointingTracker.aim`."""
        until = self._ready(self._moving_s)
        self._search(min(radius, self._options.search_m), until)
        place = struct.pack("<3di", *map(float, position), 1)
        self._find("turning to the target", es.GO_POSITION, place, until)

    def find_target(self) -> None:
        """Find the zeros again if they are lost, and search for the reflector."""
        until = self._ready(self._moving_s)
        if self._system(until)[1] != es.INITIALIZED:
            homing = until + max(_LEAST_S, self._clock.real(HOMING_S))
            self._do("finding its zeros", es.INITIALIZE, until=homing)
            self._remarks.append(HOMED)
            until = self._ready(self._moving_s)
        self._search(self._options.search_m, until)
        distance = struct.pack("<d", self._distance)
        self._find("searching for the reflector", es.FIND_REFLECTOR, distance, until)

    def report(self) -> Report:
        """Report identity and state of the tracker, and measure once; nothing turns."""
        until = self._ready()
        status, body = self._line.ask(es.GET_TRACKER_INFO, deadline=until)
        name, serial = "emScon tracker", 0
        if status == es.OK:
            _, field, number = self._line.unpack("<I64si", body)
            name, serial = es.text(field) or name, number
        rows: list[Row] = [("", "", "name", name), ("", "", "serial_number", serial or None)]
        problems: list[str] = []
        if self._reflector is not None:
            rows.append(("reflector", self._reflector[1], "reflector", self._reflector[1]))
        body = self._do("reading the environment", es.GET_ENVIRONMENT, until=until)
        celsius, mbar, humid = self._line.unpack("<3d", body)
        air = f"{celsius:.1f} °C, {mbar:.1f} mbar, {humid:.0f} %"
        _, state, _, _, *version, weather, _, _ = self._system(until)
        firmware = ".".join(map(str, version))
        station = dict(enumerate(es.WEATHER)).get(weather, f"state {weather}")
        rows += [
            ("environment", air, "temperature_degC", celsius),
            ("", "", "pressure_mbar", mbar),
            ("", "", "humidity", humid),
            ("emScon", firmware, "emscon", firmware),
            ("weather station", station, "weather_station", station),
        ]
        holds = self._options.target == "pose"
        if state == es.INITIALIZED and not holds:
            body = self._do("reading its state", es.GET_STATUS_INFO, until=until)
            holds = bool(self._line.unpack("<Ii", body)[1] & es.REFLECTOR_FOUND)
        if state != es.INITIALIZED:
            problems.append("it has not found its zeros (it is not initialised); initialise it")
        elif not holds:
            problems.append("it holds no reflector; put the beam on it")
        else:
            try:
                sample = self.measure()
                std = 1e6 * float(np.sqrt(np.trace(sample.covariance[:3, :3])))
                where = f"{self._distance:.4f} m away; standard deviation of a point {std:.1f} µm"
                rows.append(("target", where, "distance_m", self._distance))
                remark = "remark" if sample.warning else ""
                rows.append((remark, sample.warning, "std_m", 1e-6 * std))
            except DeviceError as error:
                if not self._line.open:
                    raise
                problems.append(str(error).removeprefix(f"{DEVICE}: "))
        full = f"{name}, serial {serial}" if serial else name
        return report_of(DEVICE, full, rows, problems)

    def close(self) -> None:
        """Close the connection only. Never raises; may be called twice."""
        self._line.close()

    def _measure(self) -> es.Measurement:
        """Return a plausible result; raise DeviceError for a failed or impossible one."""
        until = self._ready(self._clock.real(self._options.measuring_s))
        self._do("measuring", es.START_MEASUREMENT, until=until)
        kind, status, body = self._line.result(deadline=until)
        if status != es.OK or kind == es.ERROR:
            raise es.failure("measuring", status)
        try:
            result = es.measurement(kind, body)
        except struct.error:
            self._line.refuse(f"a result of {len(body)} bytes")
        if (result.quaternion is None) == (self._options.target == "pose"):
            raise DeviceError(f"{DEVICE}: measuring: the tracker measures in another mode than set")
        size = float(np.linalg.norm(result.position))
        turn = 1.0 if result.quaternion is None else float(np.linalg.norm(result.quaternion))
        if not (0.0 < size < _FARTHEST_M and abs(turn - 1.0) < 0.01):
            raise DeviceError(
                f"{DEVICE}: measuring: the tracker gives a target {size:.4g} m away with a "
                f"quaternion of length {turn:.3g}; are its units or its mode being changed?"
            )
        return result

    def _turn_covariance(self, result: es.Measurement, turn: Rotation) -> Floats:
        """(3, 3) covariance of a small rotation about the tracker's axes, rad²."""
        stated = result.angle_covariance
        if not (_positive_definite(stated) and np.isfinite(result.angles).all()):
            return self._config.orientation_std_rad**2 * np.eye(3)
        for order in _ORDERS:
            nominal = Rotation.from_euler(order, result.angles)
            if (nominal * turn.inv()).magnitude() < _SAME_ROTATION:
                moved = Rotation.from_euler(order, result.angles + _STEP * np.eye(3))
                J = (moved * nominal.inv()).as_rotvec().T / _STEP
                C = J @ stated @ J.T
                return np.asarray(0.5 * (C + C.T))
        return float(np.linalg.eigvalsh(stated)[-1]) * np.eye(3)  # unknown order of the angles

    def _ready(self, seconds: float = 0.0) -> float:
        """Restore a lost connection and lost settings; return the deadline of the next command.

        `seconds`: time of measuring or moving, in addition to `DEADLINE_S`.
        """
        until = time.monotonic() + DEADLINE_S + seconds
        reset = not self._line.open
        if reset:
            self._line = self._connect()
            self._remarks.append("the connection to the tracker was lost and restored")
        self._line.drain()
        changes, self._line.changes = self._line.changes, []
        for change in changes:
            if change in es.CLOSING:
                self._line.close()
                raise DeviceError(f"{DEVICE}: {es.CLOSING[change]}; is it switched off?")
            if change in es.RESTARTED:
                self._remarks.append(f"{es.RESTARTED[change]}: its axes may have moved")
            reset |= change in es.SETTINGS_CHANGED or change in es.RESTARTED
            if change == es.INITIALIZATION_CHANGED:
                self._remarks.append(HOMED)
        if reset:
            self._set_up(until)
        elif es.REFLECTOR_CHANGED in changes:
            self._check_reflector(until)
        return until

    def _set_up(self, until: float) -> None:
        """Set units, axes, statistics and mode where they differ from those needed."""
        mode = es.STATIONARY_6D if self._options.target == "pose" else es.STATIONARY
        measuring = struct.pack("<2i", max(1, math.ceil(1e3 * self._options.measuring_s)), 1)
        for setting, get, put, value in (
            ("units", es.GET_UNITS, es.SET_UNITS, _UNITS),
            ("coordinate system", es.GET_COORDINATES, es.SET_COORDINATES, struct.pack("<I", 0)),
            ("statistics", es.GET_STATISTICS, es.SET_STATISTICS, struct.pack("<2I", 1, 1)),
            ("mode", es.GET_MODE, es.SET_MODE, struct.pack("<I", mode)),
            ("time of a measurement", es.GET_STATIONARY, es.SET_STATIONARY, measuring),
        ):
            if self._do(f"reading its {setting}", get, until=until) != value:
                self._do(f"setting its {setting}", put, value, until=until)
        body = self._do("reading its settings", es.GET_SETTINGS, until=until)
        old = self._line.unpack("<I8i", body)
        # own axes, not those of a station or of an object; reports changes; single results only
        new = (old[0], 0, 0, old[3], 1, 0, 0, *old[7:])
        if new != old:
            packed = struct.pack("<I8i", *new)
            self._do("setting its settings", es.SET_SETTINGS, packed, until=until)
        if self._options.target == "position":
            self._check_reflector(until)
        self._line.drain()
        self._line.changes = [c for c in self._line.changes if c in es.CLOSING]

    def _check_reflector(self, until: float) -> None:
        """Set the reflector at the first call; refuse a later change: centres of types differ."""
        body = self._do("reading its reflector", es.GET_REFLECTOR, until=until)
        (number,) = self._line.unpack("<i", body)
        names = self._reflectors(until)
        if self._reflector is None:
            name = self._options.reflector
            if name is not None and names.get(number) != name:
                numbers = {name: number for number, name in names.items()}
                if name not in numbers:
                    raise InputError(
                        f'[tracker] options: the tracker has no reflector "{name}"; valid: '
                        f"{', '.join(numbers)}"
                    )
                number = numbers[name]
                packed = struct.pack("<i", number)
                self._do("setting its reflector", es.SET_REFLECTOR, packed, until=until)
            self._reflector = number, names.get(number, f"number {number}")
        elif number != self._reflector[0]:
            self._line.changes.append(es.REFLECTOR_CHANGED)  # checked again at the next call
            raise DeviceError(
                f'{DEVICE}: its reflector was changed to "{names.get(number, number)}", '
                f'readings so far are of "{self._reflector[1]}"; set that one again'
            )

    def _reflectors(self, until: float) -> dict[int, str]:
        """Names of the reflectors by number; the tracker answers with a packet for each."""
        out: dict[int, str] = {}
        body = self._do("reading its reflectors", es.GET_REFLECTORS, until=until)
        for k in range(es.LARGEST):
            total, number, _, _, name = self._line.unpack("<iiId64s", body)
            out[number] = es.text(name)
            if k + 1 >= total:
                break
            status, body = self._line.answer(es.GET_REFLECTORS, deadline=until)
            if status != es.OK:
                raise es.failure("reading its reflectors", status)
        return out

    def _system(self, until: float) -> tuple[int, ...]:
        """Last status; states of tracker, laser, distance meter; version (3); weather; 2 others."""
        body = self._do("reading its state", es.GET_SYSTEM_STATUS, until=until)
        return self._line.unpack("<4I3iI2i", body)

    def _search(self, radius: float, until: float) -> None:
        packed = struct.pack("<di", radius, math.ceil(1e3 * self._moving_s))
        self._do("setting the search", es.SET_SEARCH, packed, until=until)

    def _find(self, doing: str, command: int, parameters: bytes, until: float) -> None:
        status, _ = self._line.ask(command, parameters, deadline=until)
        if status == es.NOT_IMPLEMENTED or status in (1, 35, 38):
            raise es.failure(doing, status)
        if status != es.OK:
            raise TargetLostError(f"{DEVICE}: {doing}: it is not found (status {status})")

    def _do(self, doing: str, command: int, parameters: bytes = b"", *, until: float) -> bytes:
        """Carry out a command and return its content; raises DeviceError if it fails."""
        status, body = self._line.ask(command, parameters, deadline=until)
        if status not in es.SUCCESS:
            raise es.failure(doing, status)
        return body


def _positive_definite(covariance: Floats) -> bool:
    return bool(np.isfinite(covariance).all() and np.linalg.eigvalsh(covariance)[0] > 0.0)


def open_tracker(config: CellConfig) -> EmsconTracker:
    """Connect to the tracker that [tracker] names; nothing turns."""
    tracker = config.tracker
    host, port = address("[tracker]", "emscon", tracker.host, es.PORT)
    check_tracker_frame(tracker)
    options = check_section(tracker.options, EmsconOptions, "[tracker] options")
    clock = Clock(config.clock)
    return EmsconTracker(lambda: EmsconConnection(host, port), tracker, options, clock)
