"""Leica instruments that speak GeoCOM over a serial line: total stations and laser stations.

A reading is hz, v (from the zenith) and slope distance d, turned into

    x = d sin(v) sin(hz)    y = d sin(v) cos(hz)    z = d cos(v)

geocompy writes the requests and checks the replies. This module adds: a reply without checksum is
refused, failures of the line are recorded, damaged exchanges are repeated after draining the line,
and every exchange has a deadline. geocompy never raises from a request, and `bool` of its response
is False for usable codes too: only codes count.
Source: Leica Geosystems, GeoCOM Reference Manual (return codes; TMC, AUT, BAP, CSV, COM).
"""

import re
import termios
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
import serial
from geocompy.communication import SerialConnection
from geocompy.geo import GeoCom
from geocompy.geo.gctypes import GeoComCode
from pydantic import Field

from hilcal.config import CellConfig
from hilcal.config.cell import Tracker as TrackerConfig
from hilcal.drivers.links import check_tracker_frame, close_port, drain, line_failures, open_port
from hilcal.errors import DeviceError, InputError, undone_by
from hilcal.measuring.devices import Clock, Report, Row, TargetLostError, TrackerSample, report_of
from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.toml import NonNegative, Positive, Section, check_section
from hilcal.types import Floats

NULL, GEOCOM_VERSION, DO_MEASURE, FACE = 0, 110, 2008, 2026
GET_ATMOSPHERE, FULL_MEASUREMENT = 2029, 2167
SERIAL_NUMBER, NAME, FIRMWARE, POWER = 5003, 5004, 5034, 5039
LOCK_IN, LOCK_STATE, TURN, FINE_ADJUST = 9013, 9021, 9027, 9037
MEASURE_DISTANCE_ANGLE, SEARCH = 17017, 17020

OK = 0
UNKNOWN = frozenset({5, 27, 3081})
"""Not implemented, not available, no such request: the instrument lacks the request."""
BUSY = frozenset({13, 1293})
"""Another process inside the instrument is running; repeat the request later."""
GARBLED = frozenset({3073, 3074, 3076, 3078, 3080, 3082, 3085, 3087, 3093, 3094, 3101, 3102})
"""Request or reply was damaged or out of step; repeat the request after draining the line."""

WARNINGS = {
    1283: "not all corrections were applied (code 1283: level or compensator?)",
    1284: "the instrument does not guarantee its accuracy (code 1284)",
}
"""Codes of a full measurement that is usable, with a remark."""

NO_READING = {
    1285: "only angles were measured, no distance (beam broken?)",
    1288: "only angles were measured, without full correction",
    1289: "only angles were measured, without guarantee",
    1292: "the distance could not be measured (beam broken, or no reflector?)",
    1294: "no signal returns from the target",
    8704: "the target was not found in time",
    8706: "the target could not be aimed at",
    8708: "the target could not be aimed at exactly",
    8710: "no target in sight",
    8711: "more than one target in sight; cover the others",
    8712: "the target cannot be made out (stray light?)",
    8725: "the lock on the target was lost",
}
"""Codes without a reading; another try after a search may give one."""

_ADVICE = {
    16: "charge or change its battery",
    18: "charge or change its battery",
    21: "it is too cold or too hot",
    22: "level it",
    25: "wake it up",
    1290: "level it and check its compensator",
    1291: "set its atmospheric correction and prism constant",
    8714: "switch on its automatic target recognition",
}
"""What a person can do about other codes."""


_MEANING = {
    13: "busy with something else",
    16: "its battery is empty",
    21: "its temperature is out of range",
    22: "its tilt is out of range",
    25: "asleep",
    1293: "still busy measuring",
}
"""Meaning of the commonest codes, to stand alone or after a colon."""


def code_text(code: int) -> str:
    """Return meaning and number of a return code, for people."""
    try:
        name = GeoComCode(code).name.replace("_", " ").lower()
        meaning = _MEANING.get(code) or f'"{name}"'
        return f"{meaning} (code {code})"
    except ValueError:
        return f"code {code}"


def failure(action: str, code: int) -> DeviceError:
    """Return the exception for a return code without a reading; `action`: e.g. "measuring"."""
    if code in NO_READING:
        return TargetLostError(f"tracker: {action}: {NO_READING[code]} (code {code})")
    advice = f"; {_ADVICE[code]}" if code in _ADVICE else ""
    return DeviceError(f"tracker: {action}: the instrument reports: {code_text(code)}{advice}")


DEVICE = "tracker"
ANSWER_S = 1.0  # longest wait for an answer, without time of measuring or moving, real s
_FIRST_ANSWER_S = 0.7
_TRIES = 8
_PAUSE_S = 0.1
_QUIET_S, _DRAIN_S = 0.03, 0.4
_REPLY = re.compile(r"%R1P,(\d+),\d+,\d+:(\d+)(?:,.*)?$")
_UNPROTECTED = re.compile(rb"%R1P,\d+,\d+:\d+(,.*)?\r\n$")
_MISMATCH, _CLIENT_CHECKSUM = 3093, 3102
Values = Sequence[int | float]
Parsers = Sequence[Callable[[str], Any]]


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply whose checksum and transaction were right."""

    code: int  # return code of the line if not 0, else of the request
    values: tuple[Any, ...]
    """Parsed values; empty where the reply does not have the requested form."""
    host_ns: int  # `time.monotonic_ns` right after arrival


class _Connection(SerialConnection):
    """geocompy's serial connection; keeps the bytes received and the failure."""

    def __init__(self, port: serial.Serial) -> None:
        super().__init__(port)
        self.received = b""
        self.failure: Exception | None = None

    def exchange(self, cmd: str) -> str:
        """Send a request and return the reply (called by geocompy)."""
        self.received, self.failure = b"", None
        try:
            return super().exchange(cmd)
        except (OSError, termios.error, UnicodeDecodeError) as error:
            self.failure = error
            raise

    def receive_binary(self) -> bytes:
        """Return a line without its end; `received` keeps all bytes."""
        self.received = self._port.read_until(self.eoabytes)
        if not self.received.endswith(self.eoabytes):
            raise TimeoutError
        return self.received.removesuffix(self.eoabytes)

    def raise_if_broken(self) -> None:
        """Raise what the port raised in the last exchange, if anything but a timeout."""
        if self.failure and not isinstance(self.failure, TimeoutError | UnicodeDecodeError):
            raise self.failure


class Link:
    """A GeoCOM instrument on a serial port."""

    def __init__(self, path: str, baud: int) -> None:
        """Open the port for this program alone; raises DeviceError if no instrument answers."""
        self._path, self._baud = path, baud
        self._port = open_port(DEVICE, path, baud, _FIRST_ANSWER_S)
        with undone_by(self.close):
            with line_failures(DEVICE, path):
                if not drain(self._port, _QUIET_S, _DRAIN_S):
                    raise DeviceError(
                        f"{DEVICE}: port {path} keeps sending bytes without a request; "
                        f"is another instrument connected there, or is {baud} Bd wrong?"
                    )
            self._connection = _Connection(self._port)
            self._instrument = self._greet()

    def ask(
        self,
        request: int,
        values: Values = (),
        parsers: Parsers = (),
        *,
        deadline: float,
        seconds: float = ANSWER_S,
    ) -> Reply:
        """Repeat a request until an undamaged reply comes, by `deadline`, `time.monotonic` s.

        `parsers`: one per value of the reply; `seconds`: longest wait for one reply.
        """
        complaint, silent, damaged = "", 0, 0
        while damaged < _TRIES and time.monotonic() < deadline:
            answer, complaint = self._exchange(request, values, parsers, seconds, deadline)
            if answer is not None and answer.code not in BUSY:
                return answer
            if answer is not None:
                time.sleep(max(0.0, min(_PAUSE_S, deadline - time.monotonic())))
                continue
            damaged += 1
            if isinstance(self._connection.failure, TimeoutError):
                silent += 1
                if silent == 1:  # does even the simplest request get no reply?
                    self._exchange(NULL, (), (), ANSWER_S, deadline)
                if isinstance(self._connection.failure, TimeoutError):
                    break
        raise DeviceError(f"{DEVICE} at {self._path}: {complaint or 'no answer in time'}")

    def close(self) -> None:
        """Close the port. Never raises; may be called twice."""
        close_port(self._port)

    def _greet(self) -> GeoCom:
        with line_failures(DEVICE, self._path):
            try:
                return GeoCom(self._connection, attempts=2, checksum=True)
            except ConnectionRefusedError:
                self._connection.raise_if_broken()
        raise DeviceError(f"{DEVICE} at {self._path}: {self._silence()}")

    def _exchange(
        self, request: int, values: Values, parsers: Parsers, seconds: float, until: float
    ) -> tuple[Reply | None, str]:
        """One exchange: a valid reply or None, and the complaint about an invalid one."""
        with line_failures(DEVICE, self._path):
            self._port.timeout = max(0.05, min(seconds, until - time.monotonic()))
            response = self._instrument.request(request, values, parsers)
            host_ns = time.monotonic_ns()
            self._connection.raise_if_broken()
            reply = _REPLY.match(response.response)
            code = 0 if reply is None else int(reply[1]) or int(reply[2])
            local = int(response.error)  # geocompy's error, or the instrument's
            if (
                reply is not None
                and self._connection.failure is None
                and local not in (_MISMATCH, _CLIENT_CHECKSUM)
                and code not in GARBLED
            ):
                params = response.params
                several = params if isinstance(params, tuple) else (params,)
                return Reply(code, () if params is None else several, host_ns), code_text(code)
            drain(self._port, _QUIET_S, min(_DRAIN_S, max(0.0, until - time.monotonic())))
            self._connection.reset()
        if self._connection.failure is not None or reply is None:
            return None, self._silence()
        return (
            None,
            f"answers stay damaged or out of step ({code_text(code or local)}); {self._hint()}",
        )

    def _silence(self) -> str:
        received = self._connection.received
        if not received:
            return (
                f"no answer; is it switched on, connected there, and set to GeoCOM at "
                f"{self._baud} Bd?"
            )
        if _UNPROTECTED.match(received):
            return "it answers without checksum, so damage on the line would go unnoticed"
        if received.startswith(b"%R1P,"):
            return f"answers arrive damaged or cut short; {self._hint()}"
        return f"the bytes received are not GeoCOM; {self._hint()}"

    def _hint(self) -> str:
        return f"is {self._baud} Bd right, and does no other program use this port?"


BAUD = 115200
DEADLINE_S = 4.0  # longest call, without time of measuring or moving, real s
MEASURING_S = 3.0  # longest measurement of a distance, cell s
SEARCHING_S = 20.0
"""Longest search for the target, cell s; at least `_LEAST_S` real s."""
_LEAST_S = 1.0
_DISTANCE, _CORRECTED, _DISTANCE_PROGRAM = 1, 1, 2  # TMC_DEF_DIST, TMC_AUTO_INC, BAP_DEF_DIST
_LOW_BATTERY, _INTERNAL = 10, 2  # %, power source
CIRCLE = 2.0 * np.pi + 1e-6  # full circle with rounding error, rad
LARGEST_STD = 0.01  # rad; a choice: 300 times the least accurate total station's 2 mgon
LARGEST_TILT = 0.5 * np.pi  # rad; no station measures upside down


@dataclass(frozen=True, slots=True)
class PolarReading:
    """A measurement as the instrument gives it."""

    host_ns: int  # `time.monotonic_ns` right after arrival
    hz: float  # horizontal angle, rad
    v: float  # angle from the zenith, rad
    distance: float  # slope distance, m; 0 is none
    angle_std: float = 0.0  # of both angles, as stated, rad; 0 if not stated
    tilt: tuple[float, float] | None = None  # inclination across and along, rad
    warning: str = ""  # the instrument's remark


class GeoComOptions(Section):
    """[tracker.options]: keys of the driver "geocom"."""

    search_rad: Positive = Field(
        0.1, description="width and height of the window searched for the target in rad, over 0"
    )
    lock: bool = Field(True, description="true or false: whether the instrument follows the target")
    min_distance_m: NonNegative = Field(
        0.2, description="shorter distances in m are refused, 0 or more"
    )
    max_distance_m: Positive = Field(100.0, description="longer distances in m are refused, over 0")


class GeoComTracker:
    """A GeoCOM instrument as a `hilcal.measuring.devices.TrackerDevice` of positions (m = 3)."""

    def __init__(
        self, link: Link, config: TrackerConfig, options: GeoComOptions, clock: Clock
    ) -> None:
        self._link, self._config, self._options, self._clock = link, config, options, clock
        self._moving_s = max(_LEAST_S, clock.real(SEARCHING_S))
        self._has_full = True
        self._last_ms = 0.0

    def measure(self) -> TrackerSample:
        """Measure angles and distance once, with the covariance of this reading.

            Cov = J diag(σ_hz², σ_v², (a + b d)²) Jᵀ,    d sin(v) σ_hz = d σ_v = σ_t

        with σ_t = c + e d from the configuration, or d times the standard deviation of the
        angles that the instrument states, if larger; J = d(x, y, z)/d(hz, v, d).
        """
        polar = self._measure()
        sine = np.sin(polar.v)
        beam = np.array([sine * np.sin(polar.hz), sine * np.cos(polar.hz), np.cos(polar.v)])
        value = polar.distance * beam
        along, across = self._spread(polar)
        covariance = tracker_covariance(value[None], TrackerNoise(along, 0.0, across, 0.0))[0]
        return TrackerSample(polar.host_ns, value, covariance, polar.warning)

    def aim(self, position: Floats, radius: float) -> None:
        """Turn to an expected target, aim at it, lock on it; see `PointingTracker.aim`."""
        x, y, z = (float(v) for v in position)
        hz, v = np.arctan2(x, y) % (2 * np.pi), np.arctan2(np.hypot(x, y), z)
        until = time.monotonic() + DEADLINE_S + self._moving_s
        answer = self._link.ask(
            TURN, (float(hz), float(v), 0, 0, 0), deadline=until, seconds=ANSWER_S + self._moving_s
        )
        if answer.code != OK:
            raise failure("turning to the target", answer.code)
        distance = max(float(np.linalg.norm(position)), self._options.min_distance_m)
        self._find(min(2 * radius / distance, self._options.search_rad), search=False)

    def find_target(self) -> None:
        """Aim at the target, search for it if it is not in sight, lock on it."""
        self._find(self._options.search_rad, search=True)

    def _find(self, window: float, search: bool) -> None:
        until = time.monotonic() + DEADLINE_S + 4 * self._moving_s
        seconds = ANSWER_S + self._moving_s

        def do(request: int, *values: float) -> int:
            return self._link.ask(request, values, deadline=until, seconds=seconds).code

        code = do(FINE_ADJUST, window, window, 0)
        if code in NO_READING and search:
            code = do(SEARCH, 0)
            if code != OK:
                raise failure("searching for the target", code)
            code = do(FINE_ADJUST, window, window, 0)
        if code != OK:
            raise failure("aiming at the target", code)
        if self._options.lock:
            code = do(LOCK_IN)
            if code != OK:
                raise failure("locking on the target", code)
            if self._locked(until) is False:
                raise TargetLostError(f"{DEVICE}: the instrument does not hold its target locked")

    def report(self) -> Report:
        """Report identity and state of the instrument, and measure once; nothing turns."""
        until = time.monotonic() + DEADLINE_S + self._clock.real(MEASURING_S)
        name = self._values(until, NAME, lambda text: text.strip('"')) or ("GeoCOM instrument",)
        serial = self._values(until, SERIAL_NUMBER, int)
        rows: list[Row] = [("", "", "name", name[0])]
        if serial:
            rows.append(("", "", "serial_number", str(serial[0])))
        for label, request in (("firmware", FIRMWARE), ("GeoCOM", GEOCOM_VERSION)):
            numbers = self._values(until, request, int, int, int)
            if numbers:
                version = ".".join(map(str, numbers))
                rows.append((label, version, label.lower(), version))
        face = self._values(until, FACE, int)
        if face:
            rows.append(("face", "second" if face[0] else "first", "face", 2 if face[0] else 1))
        problems: list[str] = []
        power = self._values(until, POWER, int, int, int)
        if power:
            rows.append(("battery", f"{power[0]} %", "battery_percent", power[0]))
            if power[0] < _LOW_BATTERY and power[1] == _INTERNAL:
                problems.append(f"its battery is at {power[0]} %; change it or connect power")
        air = self._values(until, GET_ATMOSPHERE, float, float, float, float)
        if air:
            text = f"{air[1]:.1f} hPa, {air[2]:.1f} °C"
            rows.append(("atmosphere set", text, "pressure_hPa", air[1]))
            rows.append(("", "", "temperature_degC", air[2]))
        locked = self._locked(until)
        if locked is not None:
            rows.append(("lock", "on the target" if locked else "none", "locked", locked))
            if self._options.lock and not locked:
                problems.append("it is not locked on its target")
        try:
            rows += self._target_rows(self._measure())
        except DeviceError as error:
            if not isinstance(error, TargetLostError):
                try:  # does it answer at all?
                    self._link.ask(NULL, deadline=until)
                except DeviceError:
                    raise error from None
            problems.append(str(error).removeprefix(f"{DEVICE}: "))
        full_name = f"{name[0]}, serial {serial[0]}" if serial else str(name[0])
        return report_of(DEVICE, full_name, rows, problems)

    def close(self) -> None:
        """Close the port. Never raises; may be called twice."""
        self._link.close()

    def _measure(self) -> PolarReading:
        """Return a plausible measurement with a new distance."""
        measuring = self._clock.real(MEASURING_S)
        until = time.monotonic() + DEADLINE_S + measuring
        polar = self._full(until, measuring) if self._has_full else None
        if polar is None:
            polar = self._simple(until, measuring)
        nearest, farthest = self._options.min_distance_m, self._options.max_distance_m
        if polar.distance == 0.0:
            raise TargetLostError(f"{DEVICE}: measuring: the distance was not measured (0.0 m)")
        if not nearest <= polar.distance <= farthest:
            raise TargetLostError(
                f"{DEVICE}: measuring: the distance {polar.distance:.4g} m is not within "
                f"{nearest:g} to {farthest:g} m; does it aim at something else?"
            )
        if not (abs(polar.hz) <= CIRCLE and 0.0 <= polar.v <= CIRCLE):
            _refuse(f"angles of {polar.hz:.6g} and {polar.v:.6g} rad")
        if not 0.0 <= polar.angle_std <= LARGEST_STD:
            _refuse(f"a standard deviation of its angles of {polar.angle_std:.3g} rad")
        if polar.tilt is not None and max(map(abs, polar.tilt)) > LARGEST_TILT:
            _refuse(f"an inclination of {max(map(abs, polar.tilt)):.3g} rad")
        return polar

    def _full(self, until: float, measuring: float) -> PolarReading | None:
        """Measure, with the standard deviation of the angles; None if the request is unknown."""
        started = self._link.ask(DO_MEASURE, (_DISTANCE, _CORRECTED), deadline=until)
        if started.code in UNKNOWN:
            self._has_full = False
            return None
        if started.code != OK:
            raise failure("starting a measurement", started.code)
        answer = self._link.ask(
            FULL_MEASUREMENT,
            (round(1000 * MEASURING_S), _CORRECTED),
            (float,) * 8,
            deadline=until,
            seconds=ANSWER_S + measuring,
        )
        if answer.code in UNKNOWN:
            self._has_full = False
            return None
        warning = usable(answer)
        hz, v, std, cross, length, _, distance, ms = numbers(answer, 8)
        if ms == self._last_ms and ms > 0:
            raise DeviceError(
                f"{DEVICE}: measuring: the instrument gives the previous distance again "
                "instead of a new one; is another program using it?"
            )
        self._last_ms = ms
        return PolarReading(answer.host_ns, hz, v, distance, std, (cross, length), warning)

    def _simple(self, until: float, measuring: float) -> PolarReading:
        """Measure without stated accuracy, by a request that older instruments have, too."""
        answer = self._link.ask(
            MEASURE_DISTANCE_ANGLE,
            (_DISTANCE_PROGRAM,),
            (float,) * 4,
            deadline=until,
            seconds=ANSWER_S + measuring,
        )
        warning = usable(answer)
        hz, v, distance, _ = numbers(answer, 4)
        return PolarReading(answer.host_ns, hz, v, distance, warning=warning)

    def _spread(self, polar: PolarReading) -> tuple[float, float]:
        """Standard deviations along and across the beam, m."""
        noise, d = self._config, polar.distance
        across = noise.transverse_std_m + noise.transverse_std_per_m * d
        return noise.range_std_m + noise.range_std_per_m * d, max(across, polar.angle_std * d)

    def _target_rows(self, polar: PolarReading) -> list[Row]:
        along, across = self._spread(polar)
        target = (
            f"{polar.distance:.4f} m away; standard deviation {1e6 * along:.1f} µm along the "
            f"beam, {1e6 * across:.1f} µm across"
        )
        tilt = polar.tilt
        angles = " across, ".join(f"{1e3 * angle:.3f} mrad" for angle in tilt or ())
        return [
            ("target", target, "distance_m", polar.distance),
            ("inclination" if tilt else "", f"{angles} along", "tilt_rad", tilt),
            ("remark" if polar.warning else "", polar.warning, "std_along_m", along),
            ("", "", "std_across_m", across),
        ]

    def _locked(self, until: float) -> bool | None:
        """Whether the instrument follows the target; None if it does not report this."""
        state = self._values(until, LOCK_STATE, int)
        return None if state is None else bool(state[0])

    def _values(self, until: float, request: int, *parsers: Any) -> tuple[Any, ...] | None:
        """Return the values of a reply; None where the instrument gives none."""
        answer = self._link.ask(request, (), parsers, deadline=until)
        return answer.values if answer.code == OK and answer.values else None


def open_tracker(config: CellConfig) -> GeoComTracker:
    """Connect to the instrument that [tracker] names; nothing turns."""
    tracker = config.tracker
    if tracker.port is None:
        raise InputError(
            '[tracker] driver = "geocom" lacks "port": the serial port, '
            'e.g. "/dev/serial/by-id/usb-FTDI_..."'
        )
    check_tracker_frame(tracker)
    options = check_section(tracker.options, GeoComOptions, "[tracker] options")
    link = Link(tracker.port, tracker.baud or BAUD)
    return GeoComTracker(link, tracker, options, Clock(config.clock))


def usable(answer: Reply) -> str:
    """Return the remark of a usable measurement, empty for none."""
    if answer.code == OK:
        return ""
    if answer.code in WARNINGS:
        return WARNINGS[answer.code]
    raise failure("measuring", answer.code)


def numbers(answer: Reply, count: int) -> Floats:
    """Return the (count,) numbers of a measurement."""
    numbers = np.array(answer.values, dtype=np.float64)
    if numbers.shape != (count,):
        _refuse(f"{len(answer.values)} values instead of {count}")
    if not np.all(np.isfinite(numbers)):
        _refuse("values that are no numbers")
    return numbers


def _refuse(data: str) -> NoReturn:
    raise DeviceError(f"{DEVICE}: measuring: the instrument gives {data}; is it a GeoCOM station?")
