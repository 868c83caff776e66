"""Leica instruments that speak GeoCOM over a serial line: total stations and laser stations.

A reading is hz, v (from the zenith) and slope distance d, turned into

    x = d sin(v) sin(hz)    y = d sin(v) cos(hz)    z = d cos(v)

Source: Leica Geosystems, GeoCOM Reference Manual.
"""

import time
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from pydantic import Field

from hilcal.config import CellConfig
from hilcal.config.cell import Tracker as TrackerConfig
from hilcal.drivers import geocom_codes as geo
from hilcal.drivers.geocom_line import ANSWER_S, DEVICE, Link, Reply
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Clock, Report, TargetLostError, TrackerSample
from hilcal.readings.covariance import TrackerNoise, tracker_covariance
from hilcal.toml import NonNegative, Positive, Section, check_section
from hilcal.types import Floats

BAUD = 115200
DEADLINE_S = 4.0
"""How long a call may take beside what is measured or moved, real s."""
MEASURING_S = 3.0
"""How long a distance may take to measure, cell s."""
SEARCHING_S = 20.0
"""How long one search for the target may take, cell s; at least `_LEAST_S` real s."""
_LEAST_S = 1.0
_DISTANCE, _CORRECTED, _DISTANCE_PROGRAM = 1, 1, 2  # TMC_DEF_DIST, TMC_AUTO_INC, BAP_DEF_DIST
_LOW_BATTERY, _INTERNAL = 10, 2  # %, power source
TURN = 2.0 * np.pi + 1e-6
"""Of a full circle, rad, with what rounding adds."""
LARGEST_STD = 0.01
"""rad; a choice, a thousand times what the poorest total station states (2 mgon)."""
LARGEST_TILT = 0.5 * np.pi
"""rad; no station measures upside down."""


@dataclass(frozen=True, slots=True)
class PolarReading:
    """One measurement as the instrument gives it."""

    host_ns: int  # `time.monotonic_ns` right after it came
    hz: float  # horizontal angle, rad
    v: float  # angle from the zenith, rad
    distance: float  # slope distance, m; 0 is none
    angle_std: float = 0.0  # what it states of both angles, rad; 0 where it does not tell
    tilt: tuple[float, float] | None = None  # inclination across and along, rad
    warning: str = ""  # what it remarks


class GeoComOptions(Section):
    """[tracker.options]: keys of the driver "geocom"."""

    search_rad: Positive = Field(
        0.1, description="width and height of the window searched for the target in rad, over 0"
    )
    lock: bool = Field(True, description="true or false: whether the instrument follows the target")
    min_distance_m: NonNegative = Field(
        0.2, description="the least distance that is believed in m, 0 or more"
    )
    max_distance_m: Positive = Field(
        100.0, description="the largest distance that is believed in m, over 0"
    )


class GeoComTracker:
    """A GeoCOM instrument as a `hilcal.measuring.devices.TrackerDevice` of positions (m = 3)."""

    def __init__(
        self, link: Link, config: TrackerConfig, options: GeoComOptions, clock: Clock
    ) -> None:
        """Take over an open link; sends nothing yet."""
        self._link, self._config, self._options, self._clock = link, config, options, clock
        self._full_known = True
        self._last_ms = 0.0

    def measure(self) -> TrackerSample:
        """Measure angles and distance once, with the covariance of this very reading.

            Cov = J diag(σ_hz², σ_v², (a + b d)²) Jᵀ,    d sin(v) σ_hz = d σ_v = σ_t

        with σ_t = c + e d from the configuration, or d times the standard deviation that the
        instrument states of its angles if that is larger; J = d(x, y, z)/d(hz, v, d).

        Raises:
            TargetLostError: no target, no distance, or an implausible one.
            DeviceError: the instrument or its line failed.
        """
        polar = self._measure()
        sine = np.sin(polar.v)
        beam = np.array([sine * np.sin(polar.hz), sine * np.cos(polar.hz), np.cos(polar.v)])
        value = polar.distance * beam
        along, across = self._spread(polar)
        covariance = tracker_covariance(value[None], TrackerNoise(along, 0.0, across, 0.0))[0]
        return TrackerSample(polar.host_ns, value, covariance, polar.warning)

    def aim(self, position: Floats, radius: float) -> None:
        """Turn to where a target is expected, aim at it, lock on it; see `PointingTracker.aim`."""
        x, y, z = (float(v) for v in position)
        moving = max(_LEAST_S, self._clock.real(SEARCHING_S))
        hz, v = np.arctan2(x, y) % (2 * np.pi), np.arctan2(np.hypot(x, y), z)
        until = time.monotonic() + DEADLINE_S + moving
        answer = self._link.ask(
            geo.TURN, (float(hz), float(v), 0, 0, 0), until=until, seconds=ANSWER_S + moving
        )
        if answer.code != geo.OK:
            raise geo.failure("turning to the target", answer.code)
        distance = max(float(np.linalg.norm(position)), self._options.min_distance_m)
        self._find(min(2 * radius / distance, self._options.search_rad), search=False)

    def find_target(self) -> None:
        """Aim at the target, search for it where it is not in sight, lock on it."""
        self._find(self._options.search_rad, search=True)

    def _find(self, window: float, search: bool) -> None:
        moving = max(_LEAST_S, self._clock.real(SEARCHING_S))
        until = time.monotonic() + DEADLINE_S + 4 * moving

        def do(request: int, *values: float) -> int:
            answer = self._link.ask(request, values, until=until, seconds=ANSWER_S + moving)
            return answer.code

        code = do(geo.FINE_ADJUST, window, window, 0)
        if code in geo.LOST and search:
            code = do(geo.SEARCH, 0)
            if code != geo.OK:
                raise geo.failure("searching for the target", code)
            code = do(geo.FINE_ADJUST, window, window, 0)
        if code != geo.OK:
            raise geo.failure("aiming at the target", code)
        if self._options.lock:
            code = do(geo.LOCK_IN)
            if code != geo.OK:
                raise geo.failure("locking on the target", code)
            if self._locked(until) is False:
                raise TargetLostError(f"{DEVICE}: the instrument does not hold its target locked")

    def report(self) -> Report:
        """Ask the instrument who it is and how it is, and measure once; nothing turns."""
        until = time.monotonic() + DEADLINE_S + self._clock.real(MEASURING_S)
        name = self._told(until, geo.NAME, lambda told: told.strip('"')) or ("GeoCOM instrument",)
        serial = self._told(until, geo.SERIAL_NUMBER, int)
        facts: list[tuple[str, str]] = []
        fields: list[tuple[str, object]] = [("name", name[0])]
        if serial:
            fields.append(("serial_number", str(serial[0])))
        for what, request in (("firmware", geo.FIRMWARE), ("GeoCOM", geo.GEOCOM_VERSION)):
            version = self._told(until, request, int, int, int)
            if version:
                facts.append((what, ".".join(map(str, version))))
                fields.append((what.lower(), facts[-1][1]))
        face = self._told(until, geo.FACE, int)
        if face:
            facts.append(("face", "second" if face[0] else "first"))
            fields.append(("face", 2 if face[0] else 1))
        problems: list[str] = []
        power = self._told(until, geo.POWER, int, int, int)
        if power:
            facts.append(("battery", f"{power[0]} %"))
            fields.append(("battery_percent", power[0]))
            if power[0] < _LOW_BATTERY and power[1] == _INTERNAL:
                problems.append(f"its battery is at {power[0]} %; change it or connect power")
        air = self._told(until, geo.GET_ATMOSPHERE, float, float, float, float)
        if air:
            facts.append(("atmosphere set", f"{air[1]:.1f} hPa, {air[2]:.1f} °C"))
            fields += [("pressure_hPa", air[1]), ("temperature_degC", air[2])]
        locked = self._locked(until)
        if locked is not None:
            facts.append(("lock", "on the target" if locked else "none"))
            fields.append(("locked", locked))
            if self._options.lock and not locked:
                problems.append("it is not locked on its target")
        try:
            polar = self._measure()
            facts += self._sight(polar)
            along, across = self._spread(polar)
            fields += [("distance_m", polar.distance), ("tilt_rad", polar.tilt)]
            fields += [("std_along_m", along), ("std_across_m", across)]
        except TargetLostError as error:
            problems.append(str(error).removeprefix(f"{DEVICE}: "))
        except DeviceError as error:
            if not self._answers(until):
                raise
            problems.append(str(error).removeprefix(f"{DEVICE}: "))
        full_name = f"{name[0]}, serial {serial[0]}" if serial else str(name[0])
        return Report(DEVICE, full_name, tuple(facts), tuple(problems), tuple(fields))

    def close(self) -> None:
        """Give the port back. Never raises, may be called twice."""
        self._link.close()

    def _measure(self) -> PolarReading:
        """One plausible measurement with a distance of its own."""
        measuring = self._clock.real(MEASURING_S)
        until = time.monotonic() + DEADLINE_S + measuring
        polar = self._full(until, measuring) if self._full_known else None
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
        return plausible(polar)

    def _full(self, until: float, measuring: float) -> PolarReading | None:
        """Measurement with the standard deviation of the angles; None if it is unknown."""
        started = self._link.ask(geo.DO_MEASURE, (_DISTANCE, _CORRECTED), until=until)
        if started.code in geo.UNKNOWN:
            self._full_known = False
            return None
        if started.code != geo.OK:
            raise geo.failure("starting a measurement", started.code)
        answer = self._link.ask(
            geo.FULL_MEASUREMENT,
            (round(1000 * MEASURING_S), _CORRECTED),
            (float,) * 8,
            until=until,
            seconds=ANSWER_S + measuring,
        )
        if answer.code in geo.UNKNOWN:
            self._full_known = False
            return None
        warning = usable(answer)
        hz, v, std, cross, length, _, distance, ms = numbers(answer, 8)
        if ms == self._last_ms and ms > 0:
            raise DeviceError(
                f"{DEVICE}: measuring: the instrument gives the distance of the measurement "
                "before again, not a new one; is another program using it?"
            )
        self._last_ms = ms
        return PolarReading(answer.host_ns, hz, v, distance, std, (cross, length), warning)

    def _simple(self, until: float, measuring: float) -> PolarReading:
        """Measurement without a word on its accuracy, as older instruments know it."""
        answer = self._link.ask(
            geo.MEASURE_DISTANCE_ANGLE,
            (_DISTANCE_PROGRAM,),
            (float,) * 4,
            until=until,
            seconds=ANSWER_S + measuring,
        )
        warning = usable(answer)
        hz, v, distance, _ = numbers(answer, 4)
        return PolarReading(answer.host_ns, hz, v, distance, warning=warning)

    def _spread(self, polar: PolarReading) -> tuple[float, float]:
        """Standard deviations along and across the beam, m."""
        known, d = self._config, polar.distance
        across = known.transverse_std_m + known.transverse_std_per_m * d
        return known.range_std_m + known.range_std_per_m * d, max(across, polar.angle_std * d)

    def _sight(self, polar: PolarReading) -> list[tuple[str, str]]:
        """Facts about a measurement for people."""
        along, across = self._spread(polar)
        facts = [
            (
                "target",
                f"{polar.distance:.4f} m away; standard deviation {1e6 * along:.1f} µm along "
                f"the beam, {1e6 * across:.1f} µm across",
            )
        ]
        if polar.tilt is not None:
            cross, length = (1e3 * angle for angle in polar.tilt)
            facts.append(("inclination", f"{cross:.3f} mrad across, {length:.3f} mrad along"))
        if polar.warning:
            facts.append(("remark", polar.warning))
        return facts

    def _locked(self, until: float) -> bool | None:
        """Whether it follows the target; None where the instrument does not report it."""
        state = self._told(until, geo.LOCK_STATE, int)
        return None if state is None else bool(state[0])

    def _told(self, until: float, request: int, *parsers: Any) -> tuple[Any, ...] | None:
        """What the instrument answers to a simple question; None where it does not know."""
        answer = self._link.ask(request, (), parsers, until=until)
        return answer.values if answer.code == geo.OK and answer.values else None

    def _answers(self, until: float) -> bool:
        try:
            self._link.ask(geo.NULL, until=until)
        except DeviceError:
            return False
        return True


def open_tracker(config: CellConfig) -> GeoComTracker:
    """Connect to the instrument that [tracker] names; nothing turns.

    Raises:
        InputError: [tracker] lacks the port, or is not one of a GeoCOM instrument.
        DeviceError: no such port, port in use, or nobody answers, within 5 s.
    """
    tracker = config.tracker
    if tracker.port is None:
        raise InputError(
            '[tracker] driver = "geocom" lacks "port": the serial port, '
            'e.g. "/dev/serial/by-id/usb-FTDI_..."'
        )
    if tracker.frame != "tracker":
        raise InputError(
            f'[tracker] frame = "{tracker.frame}": a GeoCOM instrument gives positions in its '
            'own axes; it must be "tracker"'
        )
    options = check_section(tracker.options, GeoComOptions, "[tracker] options")
    link = Link(tracker.port, tracker.baud or BAUD)
    return GeoComTracker(link, tracker, options, Clock(config.simulation.clock))


def usable(answer: Reply) -> str:
    """Return the remark of a usable measurement, empty for none.

    Raises:
        TargetLostError: it has no distance.
        DeviceError: it is none.
    """
    if answer.code == geo.OK:
        return ""
    if answer.code in geo.WARNINGS:
        return geo.WARNINGS[answer.code]
    raise geo.failure("measuring", answer.code)


def numbers(answer: Reply, count: int) -> Floats:
    """Return the (count,) numbers of a measurement.

    Raises:
        DeviceError: there are more or fewer, or one is not finite.
    """
    numbers = np.array(answer.values, dtype=np.float64)
    if numbers.shape != (count,):
        _strange(f"{len(answer.values)} values instead of {count}")
    if not np.all(np.isfinite(numbers)):
        _strange("values that are no numbers")
    return numbers


def plausible(polar: PolarReading) -> PolarReading:
    """Return a measurement whose angles are some that an instrument can have.

    Raises:
        DeviceError: an angle beyond a full turn (`TURN`), or a standard deviation or inclination
            of angles beyond `LARGEST_STD`, `LARGEST_TILT`.
    """
    if not (abs(polar.hz) <= TURN and 0.0 <= polar.v <= TURN):
        _strange(f"angles of {polar.hz:.6g} and {polar.v:.6g} rad")
    if not 0.0 <= polar.angle_std <= LARGEST_STD:
        _strange(f"a standard deviation of its angles of {polar.angle_std:.3g} rad")
    if polar.tilt is not None and max(map(abs, polar.tilt)) > LARGEST_TILT:
        _strange(f"an inclination of {max(map(abs, polar.tilt)):.3g} rad")
    return polar


def _strange(what: str) -> NoReturn:
    raise DeviceError(f"{DEVICE}: measuring: the instrument gives {what}; is it a GeoCOM station?")
