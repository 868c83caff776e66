"""A simulated GeoCOM laser station on a pseudo-terminal: `DIR/tracker`, admin `tracker.sock`.

    python -m hilcal.drivers.simulated.geocom_server --directory DIR --range-std A B
        --transverse-std C E --seed N [--baud 115200]

Admin operations beside those of the line (`PtyPort.faults`): `beam {on}` blocks it, `hide
{targets}` covers reflectors by number, `lock_lost`, `freeze {on}` repeats the last measurement,
`stray {on}` follows a reflector at rest 0.2 m behind the target,
`dist_error {on}`, `warn {code}` (1283 or 1284; 0 ends it), `busy {on}`, `delay {rpc, seconds,
count}` in real time, `wrong_trid {count}`, `meas_s {seconds}` of world time, `log`, `state`.

Sources: Leica Geosystems, "TPS1200+ GeoCOM Reference Manual"; its chapter "ASCII protocol" has the
lines `%R1Q,<rpc>,<trid>[,<crc>]:<p>` and `%R1P,<com>,<trid>[,<crc>]:<rc>,<p>`. Their checksum is
CRC-16/ARC over the line without the checksum and its comma.
"""

import re
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

import numpy as np

from hilcal.drivers.links import crc16
from hilcal.drivers.simulated import admin
from hilcal.drivers.simulated.admin import setter
from hilcal.drivers.simulated.blackboard import Blackboard, settled_truth
from hilcal.drivers.simulated.pty_port import PtyPort
from hilcal.drivers.simulated.world import SimulatedNoise
from hilcal.types import Floats


@dataclass(frozen=True, slots=True)
class PolarPoint:
    """A direction and a slope distance: x = d sinV sinHz, y = d sinV cosHz, z = d cosV."""

    hz: float  # horizontal angle, 0 to 2 pi, rad
    v: float  # zenith angle, 0 to pi, rad
    distance: float  # m

    @staticmethod
    def of(point: Floats) -> "PolarPoint":
        """Return the polar coordinates of a point (3,), m."""
        x, y, z = map(float, point)
        level = float(np.hypot(x, y))
        hz, v = np.arctan2(x, y) % (2 * np.pi), np.arctan2(level, z)
        return PolarPoint(float(hz), float(v), float(np.hypot(level, z)))

    def angle_to(self, point: "PolarPoint") -> float:
        """Return the angle between two directions, rad."""
        return float(np.arccos(np.clip(self.direction() @ point.direction(), -1.0, 1.0)))

    def direction(self) -> Floats:
        """Return the unit vector (3,)."""
        level = np.sin(self.v)
        return np.array([level * np.sin(self.hz), level * np.cos(self.hz), np.cos(self.v)])


WARNINGS = (0, 1283, 1284)
BEHIND_M = 0.2  # distance of a stray reflector behind the target, m
AIM_S = 0.3  # world time of a search, a fine adjustment, a lock-in or a turn, s
FIELD_OF_VIEW = 0.026  # half angle of the camera's view, rad (1.5°)
LEVEL_STD = 1e-6  # noise of the inclinations, rad


@dataclass(slots=True, eq=False)
class Station:
    """A tracking station; it holds its target through jumps while the beam is free."""

    board: Blackboard
    noise: SimulatedNoise
    rng: np.random.Generator
    meas_s: float = 0.3  # world time of one distance measurement, s
    locked: bool = True  # whether the target is held; without lock no distance
    broken: bool = False  # whether the beam is blocked
    dist_error: bool = False  # whether distance measurements fail (1292)
    warning: int = 0  # code of a good measurement in place of 0
    busy: bool = False  # whether measurements are refused (1293)
    delays: dict[int, tuple[float, int]] = field(default_factory=dict)
    """By procedure: delay in real s, and number of late answers."""
    wrong_transactions: int = 0  # number of next answers with a wrong transaction number
    lock_enabled: bool = True  # as set by 9020
    atr_enabled: bool = True  # as set by 9018
    digits: int = 15  # decimals of floating-point numbers
    atmosphere: tuple[float, ...] = (658e-9, 1013.25, 20.0, 20.0)
    """Wavelength m, pressure mbar, dry and wet temperature °C."""
    settings: dict[int, str] = field(
        default_factory=lambda: {2020: "2", 17019: "0", 17021: "0", 17008: "0"}
    )
    """Plain settings by the procedure that sets them."""
    pointing: PolarPoint = field(default_factory=lambda: PolarPoint(0.0, np.pi / 2, 0.0))
    """Direction of the telescope."""
    distance: float = 0.0  # the last distance, m; 0 is none
    distance_ms: int = 0  # station time of the last distance, ms
    ranging: float | None = None
    """End of the running distance measurement, `time.monotonic`; None: none runs."""
    tracking: bool = False  # whether the distance meter measures continuously
    requests: deque[tuple[int, tuple[str, ...]]] = field(
        default_factory=lambda: deque(maxlen=10_000)
    )
    measured: int = 0
    number: int = 0  # of the target held, or held last
    hidden: set[int] = field(default_factory=set)  # numbers of covered targets
    several: bool = False
    newest: PolarPoint | None = None  # the newest measurement
    stuck: PolarPoint | None = None
    """The measurement that is repeated to the last digit; None: the target is measured."""
    stray: PolarPoint | None = None
    """A reflector at rest that is followed in place of the target."""

    def faults(self) -> dict[str, Callable[..., None]]:
        """Return the faults between instrument and target, by name."""
        return {
            "beam": setter(self, "broken"),
            "hide": self.hide,
            "lock_lost": lambda: setattr(self, "locked", False),
            "freeze": lambda on: setattr(self, "stuck", self.newest if on else None),
            "stray": self.follow_stray,
        }

    def hide(self, targets: Iterable[int]) -> None:
        """Cover these targets by number, and no others."""
        self.hidden = {int(k) for k in targets}
        self.locked = self.locked and self.number not in self.hidden

    def follow_stray(self, on: bool) -> None:
        """Follow a reflector at rest behind the target's present place, or the target again."""
        target = self.target() if on else None
        self.stray = target and replace(target, distance=target.distance + BEHIND_M)

    def warn(self, code: int) -> None:
        """Give a warning with every good measurement, or none (0)."""
        if code not in WARNINGS:
            raise ValueError(f"code = {code}; valid: {WARNINGS}")
        self.warning = code

    def targets(self) -> dict[int, PolarPoint]:
        """Return the true present places of the visible targets, by number."""
        if self.broken:
            return {}
        truth = settled_truth(self.board)
        points = truth["targets"]
        valid = np.isfinite(points).all(axis=1) & points.any(axis=1)
        self.several = bool(valid.any())
        if not self.several:
            points = truth["target"][None]
            valid = np.isfinite(points).all(axis=1) & points.any(axis=1)  # the world has started
        visible = (k for k in np.flatnonzero(valid).tolist() if k not in self.hidden)
        return {k: PolarPoint.of(points[k]) for k in visible}

    def target(self) -> PolarPoint | None:
        """Return the true present place of its target; None if not visible."""
        return self.stray or self.targets().get(self.number)

    def held_target(self) -> PolarPoint | None:
        """Return the true place of the held target; None without lock or sight."""
        return self.target() if self.locked else None

    def measure_target(self) -> PolarPoint | None:
        """Measure the held target once and turn the telescope to it; None without one."""
        true = self.held_target()
        if true is None:
            return None
        self.pointing = self.newest = self.stuck or self._observed(true)
        self.measured += 1
        return self.newest

    def _observed(self, true: PolarPoint) -> PolarPoint:
        """Return one measurement of a point, with new noise."""
        place = true.distance * true.direction()
        return PolarPoint.of(self.noise.observe(place[None], self.rng)[0])

    def angle_std(self, distance: float) -> float:
        """Return the standard deviation of a direction at a distance, rad."""
        fixed, growing = self.noise.transverse_std
        return fixed / distance + growing

    def wait(self, world_seconds: float) -> None:
        """Wait for `world_seconds` of world time."""
        time.sleep(max(0.0, world_seconds) / self.board.scale)

    def acquire(self, window: float = np.inf) -> bool:
        """Hold the target closest to the telescope's direction; return whether there is any.

        Of several targets only those within `window` of this direction count, rad.
        """
        self.wait(AIM_S)
        angles = {k: point.angle_to(self.pointing) for k, point in self.targets().items()}
        if self.several:
            angles = {k: angle for k, angle in angles.items() if angle <= window}
        if angles:
            self.number = min(angles, key=lambda k: angles[k])
        self.locked = bool(angles)
        self.measure_target()
        return self.locked

    def start_ranging(self) -> None:
        """Start a distance measurement; it takes `meas_s` of world time."""
        self.distance, self.distance_ms = 0.0, 0
        self.ranging = time.monotonic() + self.meas_s / self.board.scale

    def stop_ranging(self, *, clear: bool) -> None:
        """Stop measuring distances; `clear`: also forget the last distance."""
        self.ranging = None
        self.distance = 0.0 if clear else self.distance

    def finish_ranging(self, patience: float) -> None:
        """Wait for a running distance measurement, at most `patience` s of world time."""
        if self.ranging is not None:
            remaining = self.ranging - time.monotonic()
            time.sleep(max(0.0, min(remaining, patience / self.board.scale)))
            self.tick()

    def tick(self) -> None:
        """Finish a distance measurement whose time is over, at the target's present place."""
        if self.ranging is None or time.monotonic() < self.ranging:
            return
        self.ranging = None
        polar = self.measure_target()
        if polar is not None and not self.dist_error:
            self.distance, self.distance_ms = polar.distance, int(self.board.time * 1e3)

    def turn(self, hz: float, v: float) -> None:
        """Turn the telescope; the lock ends unless the target is in the new field of view."""
        self.pointing = PolarPoint(hz % (2 * np.pi), v, 0.0)
        true = self.target()
        if true is None or true.angle_to(self.pointing) > FIELD_OF_VIEW:
            self.locked = False

    def inclination(self) -> tuple[float, float, float]:
        """Return cross and lengthwise inclination and their accuracy, rad; the station is level."""
        cross, length = self.rng.normal(0.0, LEVEL_STD, 2)
        return float(cross), float(length), LEVEL_STD

    def temperature(self) -> float:
        """Return the temperature inside, °C: some kelvins above the air's."""
        air = float(self.board.read("truth")["air_temperature"])
        return (air if air != 0.0 else 20.0) + 6.0


OK = 0
INVALID_PARAMETER = 2
ANGLES_ONLY = 1285  # TMC_ANGLE_OK: no distance, which is given as 0
DISTANCE_ERROR, BUSY = 1292, 1293
CANNOT_DECODE, UNKNOWN_PROCEDURE = 3080, 3081  # COM_CANT_DECODE_REQ, COM_PROC_UNAVAIL
BAD_CHECKSUM = 3101  # COM_SRVR_RX_CHECKSUM_ERROR
NO_TARGET, NOT_ENABLED = 8710, 8714

_REQUEST = re.compile(r"%R1Q,(\d{1,5})(?:,(\d{1,5}))?(?:,(\d{1,5}))?:(.*)")
NAME, SERIAL = "SIM LASER STATION", 123456


def reply(
    com: int, transaction: int, code: int, parameters: Sequence[str], *, checked: bool
) -> bytes:
    """Return the line of an answer."""
    body = ",".join([str(code), *parameters])
    head = f"%R1P,{com},{transaction}"
    if checked:
        head += f",{crc16(f'{head}:{body}'.encode())}"
    return f"{head}:{body}\r\n".encode()


Answer = tuple[int, list[str]]
Parameters = tuple[str, ...]
_CONSTANT: dict[int, list[str]] = {
    **{0: [], 11001: [], 11004: [], 110: ["1", "50", "0"], 2007: ["1"], 2026: ["0"]},
    **{5003: [str(SERIAL)], 5004: [f'"{NAME}"'], 5034: ["6", "20", "0"], 5039: ["100", "1", "1"]},
}
_STORED = {2021: 2020, 17009: 17008, 17018: 17019, 17022: 17021}
"""By the procedure that reads a plain setting: the one that sets it."""


def answer(station: Station, rpc: int, parameters: Parameters) -> Answer:
    """Carry out a procedure, in its world time."""
    try:
        return _carried_out(station, rpc, parameters)
    except (ValueError, IndexError):  # too few parameters or no numbers
        return INVALID_PARAMETER, []


def _carried_out(s: Station, rpc: int, p: Parameters) -> Answer:
    values: list[str] = []
    match rpc:
        case 107:  # COM_SetDoublePrecision
            if not 0 <= int(p[0]) <= 15:
                raise ValueError
            s.digits = int(p[0])
        case 108:
            values = [str(s.digits)]
        case 2008 | 2107 | 2108 | 2167 | 17017 if s.busy:
            return BUSY, []
        case 2008:
            _start_measuring(s, int(p[0]))
        case 2022:
            values = [*_numbers(s, 80.0), str(int(s.board.time))]
        case 2028:  # TMC_SetAtmCorr
            wavelength, pressure, dry, wet = map(float, p)
            s.atmosphere = (wavelength, pressure, dry, wet)
        case 2029:
            values = _numbers(s, *s.atmosphere)
        case 2107:
            polar = s.measure_target() or s.pointing
            return s.warning, _numbers(s, polar.hz, polar.v)
        case 2108 | 2167:
            return _with_distance(s, int(p[0]), full=rpc == 2167)
        case 5008:  # CSV_GetDateTime
            now = datetime.now(UTC)
            parts = (now.month, now.day, now.hour, now.minute, now.second)
            values = [str(now.year), *(f"'{value:02x}'" for value in parts)]
        case 5011:
            values = _numbers(s, s.temperature())
        case 6021:  # 0 not locked, 1 locked, 2 prediction: the target is out of sight
            values = ["0" if not s.locked else "1" if s.target() is not None else "2"]
        case 9013:
            return (_acquired(s), []) if s.lock_enabled else (NOT_ENABLED, [])
        case 9018:
            s.atr_enabled = bool(int(p[0]))
        case 9019:
            values = [str(int(s.atr_enabled))]
        case 9020:
            s.lock_enabled = bool(int(p[0]))
            s.locked = s.locked and s.lock_enabled
        case 9021:
            values = [str(int(s.locked))]
        case 9027:
            s.turn(float(p[0]), float(p[1]))
            if len(p) > 3 and int(p[3]) == 1:  # AUT_TARGET: acquire the target there
                return _acquired(s), []
            s.wait(AIM_S)
        case 9037:  # AUT_FineAdjust: within a window, rad; the parameters are full widths
            return _acquired(s, 0.5 * max(float(p[0]), float(p[1]))), []
        case 17017:
            return _measure(s, int(p[0]))
        case 17020:
            return _acquired(s), []
        case _ if rpc in s.settings:
            s.settings[rpc] = str(int(p[0]))
        case _ if rpc in _STORED:
            values = [s.settings[_STORED[rpc]]]
        case _ if rpc in _CONSTANT:
            values = _CONSTANT[rpc]
        case _:
            return UNKNOWN_PROCEDURE, []
    return OK, values


def _numbers(station: Station, *values: float) -> list[str]:
    return [f"{value:.{station.digits}f}" for value in values]


def _acquired(station: Station, window: float = np.inf) -> int:
    return OK if station.acquire(window) else NO_TARGET


def _start_measuring(station: Station, command: int) -> None:
    """TMC_DoMeasure: 0 stop, 1 distance, 2 track, 3 clear, 6 restart."""
    station.tracking = command == 2
    if command in (1, 2, 6):
        station.start_ranging()
    elif command in (0, 3):
        station.stop_ranging(clear=command == 3)
    else:
        raise ValueError


def _with_distance(station: Station, patience_ms: int, *, full: bool) -> Answer:
    """TMC_GetSimpleMea, and TMC_GetFullMeas: of the measurement started by 2008.

    Values: hz, v; if full, their accuracy, the inclinations and their accuracy; distance; if full,
    its time, ms.
    """
    if station.tracking and station.ranging is None:
        station.start_ranging()
    station.finish_ranging(patience_ms * 1e-3)
    if station.dist_error:
        return DISTANCE_ERROR, []
    polar, distance = station.measure_target() or station.pointing, station.distance
    code = station.warning if distance > 0.0 else ANGLES_ONLY
    if not full:
        return code, _numbers(station, polar.hz, polar.v, distance)
    accuracy = station.angle_std(distance) if distance > 0.0 else 0.0
    values = (polar.hz, polar.v, accuracy, *station.inclination(), distance)
    return code, [*_numbers(station, *values), str(station.distance_ms)]


def _measure(station: Station, mode: int) -> Answer:
    """BAP_MeasDistanceAngle: 0 last values, 1 angles, 2 to 4 distance, 5 clear, 6 stop."""
    if not 0 <= mode <= 6:
        raise ValueError
    polar, distance = station.pointing, 0.0
    if mode in (5, 6):
        station.stop_ranging(clear=mode == 5)
        station.tracking = False
        return OK, [*_numbers(station, polar.hz, polar.v, 0.0), str(mode)]
    if mode >= 2:
        if not station.locked:
            station.wait(AIM_S)
            return NO_TARGET, []
        station.start_ranging()
        station.finish_ranging(station.meas_s)
        if station.dist_error:
            return DISTANCE_ERROR, []
        polar, distance = station.pointing, station.distance
    else:
        polar = station.measure_target() or station.pointing
        distance = station.distance if mode == 0 else 0.0
    code = station.warning if distance > 0.0 or mode == 1 else ANGLES_ONLY
    return code, [*_numbers(station, polar.hz, polar.v, distance), str(mode)]


LONGEST_LINE = 1024


def respond(station: Station, line: str) -> bytes:
    """Return the answer to a line, empty if it is not of the protocol."""
    if line == "c":  # abort: nothing is pending
        return b"?\r\n"
    if not line.startswith("%R1Q,"):
        return b""
    match = _REQUEST.fullmatch(line)
    rpc, trid, crc, text = match.groups() if match else ("-1", "0", None, "")
    number, parameters = int(rpc), tuple(text.split(",")) if text else ()
    station.requests.append((number, parameters))
    transaction = int(trid or 0)
    if station.wrong_transactions > 0:
        station.wrong_transactions -= 1
        transaction = (transaction + 1) % 2**15
    if match is None:
        return reply(CANNOT_DECODE, transaction, 0, [], checked=False)
    bare = f"%R1Q,{rpc},{trid}:{text}".encode("ascii", "replace")
    if crc is not None and int(crc) != crc16(bare):
        return reply(BAD_CHECKSUM, transaction, 0, [], checked=True)
    code, values = answer(station, number, parameters)
    pause, count = station.delays.pop(number, (0.0, 0))
    if count > 1:
        station.delays[number] = pause, count - 1
    time.sleep(pause)
    return reply(OK, transaction, code, values, checked=crc is not None)


def operations(station: Station, port: PtyPort) -> admin.Operations:
    """Return the admin operations of the station."""

    def delay(rpc: int, seconds: float, count: int = 1) -> None:
        station.delays[int(rpc)] = float(seconds), int(count)

    def state() -> dict[str, Any]:
        return port.state() | {
            "locked": station.locked,
            "beam": station.broken,
            "measured": station.measured,
            "requests": len(station.requests),
            "meas_s": station.meas_s,
        }

    functions: dict[str, Callable[..., object]] = {
        **station.faults(),
        "dist_error": admin.setter(station, "dist_error"),
        "warn": station.warn,
        "busy": admin.setter(station, "busy"),
        "delay": delay,
        "wrong_trid": lambda count=1: setattr(station, "wrong_transactions", int(count)),
        "meas_s": admin.setter(station, "meas_s", float),
        "log": lambda: [[number, *values] for number, values in list(station.requests)],
    }
    return admin.Operations(functions | port.faults(), state)


def serve(station: Station, port: PtyPort, buffer: bytearray) -> None:
    """Read requests and answer them; `buffer` keeps an incomplete line."""
    buffer += port.read(0.02)
    station.tick()
    while (end := min((i for i in map(buffer.find, b"\r\n") if i >= 0), default=-1)) >= 0:
        line = buffer[:end].decode("ascii", "replace").strip()
        del buffer[: end + 1]
        data = respond(station, line) if line else b""
        if data:
            port.send(data)
            port.drain()
    if len(buffer) > LONGEST_LINE:
        buffer.clear()
    port.pump()


def start(options: admin.Arguments) -> admin.Device:
    """Return the station on its serial line."""
    measuring, faults = np.random.default_rng(options.seed).spawn(2)
    noise = SimulatedNoise(tuple(options.range_std), tuple(options.transverse_std))
    station = Station(Blackboard(options.directory / "world.bin"), noise, measuring)
    port = PtyPort(options.directory / "tracker", options.baud, faults)
    return operations(station, port), partial(serve, station, port, bytearray())


OPTIONS: dict[str, dict[str, Any]] = {**admin.NOISE, "--baud": {"type": int, "default": 115200}}

if __name__ == "__main__":
    admin.run(__doc__, "tracker", start, OPTIONS)
