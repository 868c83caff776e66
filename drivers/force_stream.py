"""A force sensor that streams, read in the background: newest frame, means, counters.

Every few milliseconds one thread reads the waiting bytes (the kernel keeps 4096, 110 frames of the
longest kind), finds the frames in them and writes them to a ring buffer.
"""

import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from hilcal.config import CellConfig
from hilcal.config.sections import PORT
from hilcal.config.sections import ForceSensor as Section
from hilcal.drivers.links import close_port, drain, line_failures, open_port
from hilcal.errors import DeviceError, InputError, undone_by
from hilcal.measuring.devices import Losses, Report, Row, WrenchSample, report_of
from hilcal.types import Floats, Ints


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """Layout of a frame of fixed length: header, body, two bytes of checksum."""

    header: bytes  # the bytes that every frame begins with
    size: int  # of the frame, with header and checksum, bytes
    checksum: Callable[[bytes], bytes]
    """From all bytes but the last two: what these two must be."""
    weak_checksum: bool = False
    """Whether the checksum is a mere sum; then a frame counts only if the next header follows it
    directly."""


class Deframer:
    """Finds frames in a stream of bytes; after a bad frame it skips one byte only.

    A 16-bit checksum passes 1 of 65536 wrong candidates, and during a search for a header every
    byte is a candidate. A frame that does not directly follow a good one therefore counts only if a
    second good frame directly follows it. `corrupt` frames (candidates within one frame length
    count as one) and `skipped` bytes are counted from the first good frame on.
    """

    def __init__(self, frame: FrameFormat) -> None:
        self.frames = self.corrupt = self.skipped = 0
        self._format = frame
        self._buffer = bytearray()
        self._in_step = self._synchronised = False
        self._offset = 0  # position in the stream of the buffer's first byte
        self._bad_until = 0  # stream position up to which a bad frame has been counted

    def push(self, data: bytes) -> list[bytes]:
        """Add bytes; return the bodies (without header and checksum) of the frames now complete."""
        buffer, size, header = self._buffer, self._format.size, self._format.header
        buffer += data
        out: list[bytes] = []
        at = 0
        while True:
            start = buffer.find(header, at)
            if start < 0:
                start = max(at, len(buffer) - len(header) + 1)  # may hold a part of a header
                self._skip(start - at)
                at = start
                break
            self._skip(start - at)
            at = start
            if len(buffer) - at < size:
                break
            good = self._good(at)
            if good and (not self._in_step or self._format.weak_checksum):
                needed = len(header) if self._in_step else size
                if len(buffer) - at < size + needed:
                    break  # decided when the next frame has come
                end = at + size
                good = buffer.startswith(header, end) if self._in_step else self._good(end)
            if good:
                self._in_step = self._synchronised = True
                out.append(bytes(buffer[at + len(header) : at + size - 2]))
                at += size
            else:
                if self._offset + at >= self._bad_until:
                    self.corrupt += self._synchronised
                    self._bad_until = self._offset + at + size
                self._skip(1)
                at += 1
        del buffer[:at]
        self._offset += at
        self.frames += len(out)
        return out

    def _skip(self, count: int) -> None:
        """Count bytes that belong to no frame."""
        if count:
            self.skipped += count * self._synchronised
            self._in_step = False

    def _good(self, at: int) -> bool:
        """Whether a frame with a right checksum begins at this index of the buffer."""
        frame = bytes(self._buffer[at : at + self._format.size])
        checksum = self._format.checksum
        return frame.startswith(self._format.header) and checksum(frame[:-2]) == frame[-2:]


class ByDeviceClock:
    """Counts lost frames by the device's time stamps, whose counter may wrap.

    A frame is out of place if its time is not shortly after its predecessor's, unless its successor
    continues it: then the device has restarted its counter.
    """

    PERIOD_STEPS = 20
    LONGEST_S = 30.0

    def __init__(self, tick_s: float, bits: int) -> None:
        self.lost = 0
        self._tick, self._wrap = tick_s, 1 << bits
        self._last: int | None = None
        self._stray: int | None = None
        self._steps: list[int] = []
        self._period = 0.0  # ticks; 0 until `PERIOD_STEPS` steps have come

    @property
    def rate(self) -> float:
        """Frames per second of device time; 0 while unknown."""
        return 1.0 / (self._period * self._tick) if self._period else 0.0

    def follow(self, count: int, ticks: Sequence[int], now: float) -> list[bool]:
        """Return which of the `count` frames read together at the time `now`, s, are in place."""
        return [self._in_place(tick) for tick in ticks]

    def _in_place(self, tick: int) -> bool:
        if self._last is not None:
            step = (tick - self._last) % self._wrap
            if not 0 < step * self._tick <= self.LONGEST_S:
                stray, self._stray = self._stray, tick
                if stray is None or not 0 < (tick - stray) % self._wrap * self._tick <= 1.0:
                    return False
                self._last = stray  # the counter has restarted; the stray frame is lost
                self.lost += 1
                step = (tick - stray) % self._wrap
            self._count(step)
        self._last, self._stray = tick, None
        return True

    def _count(self, step: int) -> None:
        if self._period:
            self.lost += max(0, round(step / self._period) - 1)
            return
        self._steps.append(step)
        if len(self._steps) == self.PERIOD_STEPS:
            self._period = float(np.median(self._steps))
            self.lost += sum(max(0, round(step / self._period) - 1) for step in self._steps)


class ByArrival:
    """Counts lost frames by times of arrival, for a device of known rate without a clock.

    Each frame is due one period after its predecessor. The schedule follows early frames at once
    and late ones slowly (sender and host have different clocks). A frame late by `LATE` periods or
    more shows how many are missing. Frames that were only delayed then come early by this schedule,
    and are subtracted from the count again; to detect them, the schedule is held for `HOLD` times
    the delay.
    """

    LATE = 0.9
    FOLLOW = 0.05
    HOLD = 10.0

    def __init__(self, rate: float) -> None:
        self.lost = 0
        self.rate = rate
        self._due: float | None = None  # when the newest frame was due
        self._hold_until = -math.inf  # until then missing frames may turn out to be delayed

    def follow(self, count: int, ticks: Sequence[int], now: float) -> list[bool]:
        """See `ByDeviceClock.follow`; all are in place."""
        period = 1.0 / self.rate
        self._due = now if self._due is None else self._due + count * period
        late = (now - self._due) / period  # periods
        missing = 0
        if late >= self.LATE:
            missing = math.floor(late + 1.0 - self.LATE)
            self._hold_until = now + self.HOLD * late * period
        elif now < self._hold_until and late < 0.0:
            missing = -min(self.lost, math.floor(-late + 1.0 - self.LATE))
        self.lost += missing
        late -= missing
        follow = self.FOLLOW if late > 0.0 else 1.0
        if now < self._hold_until:
            follow = 0.0
        self._due += (missing + follow * late) * period
        return [True] * count


LossCounter = ByDeviceClock | ByArrival

DEVICE = "force sensor"
STALE_S = 0.5
"""Age at which the newest frame is stale. On a busy computer bytes arrive late, because the kernel
passes them on in a thread that competes with all programs; delays of 0.2 s are not rare."""
POLL_S = 0.005
RECHECK_S = 1.0
"""Longest wait for another pass of the reader; an idle computer needs two passes, 2 `POLL_S`."""
SLICE_S = 0.05
MIN_SHARE = 0.5  # least share of the frames due in a window for a mean
FEW, MAX_LOST = 5, 0.01  # this number of lost frames plus this share of all is no problem
RING = 4096
FIRST_FRAME_S, OLD_S = 1.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class SensorFormat:
    """What a sensor sends, and what its values mean."""

    name: str  # the maker's, for people
    frame: FrameFormat  # unused where records come as datagrams
    body: np.dtype[Any]
    """Fields between header and checksum: `wrench` (6); optionally `status`, `ticks` (device clock)
    and `temperature` (°C)."""
    unit: Floats  # (6,) N and N·m per count of `wrench`
    losses: Callable[[], LossCounter]  # makes the counter of lost frames
    overload: Callable[[Floats, int], str]
    """From wrench (6,) and status: what is wrong with the frame, "" if nothing."""


class ForceStream:
    """A streaming sensor; see `hilcal.measuring.devices.ForceSensorDevice`."""

    def __init__(
        self,
        port: Any,
        sensor: SensorFormat,
        name: str = "",
        facts: tuple[tuple[str, str], ...] = (),
        *,
        deframer: Any = None,
        failures: Callable[[str, str], AbstractContextManager[None]] = line_failures,
        before_close: Callable[[], None] = lambda: None,
    ) -> None:
        """Start to read an open port, serial or with the same interface; `close` closes it.

        `deframer` replaces a `Deframer` of `sensor.frame`; `failures` turns what the port raises
        into DeviceError; `before_close` must not raise.
        """
        self._name, self._facts, self._before_close = name or sensor.name, facts, before_close
        self._port, self._sensor, self._failures = port, sensor, failures
        self._path = str(port.port)
        self._deframer = deframer or Deframer(sensor.frame)
        self._counter = sensor.losses()
        self._lock = threading.Lock()
        self._failure = ""
        self._passes = 0
        self._bytes = self._impossible = self._count = 0
        self._byte_time = self._frame_time = self._start = time.monotonic()
        self._wrench = np.zeros((RING, 6))
        self._stamp = np.zeros(RING, dtype=np.int64)
        self._status = np.zeros(RING, dtype=np.int64)
        self._temperature: float | None = None
        self._running = True
        self._thread = threading.Thread(target=self._read, name=DEVICE, daemon=True)
        self._thread.start()

    def started(self, seconds: float = FIRST_FRAME_S) -> Self:
        """Wait for the first frame; without one in time, close the port and raise DeviceError."""
        end = time.monotonic() + seconds
        with undone_by(self.close):
            while not self._count and not self._failure and time.monotonic() < end:
                time.sleep(POLL_S)
            if not self._count:
                raise DeviceError(self._silence())
        return self

    def latest(self) -> WrenchSample:
        """Return the newest frame, at most `STALE_S` old."""
        self._check()
        with self._lock:
            at = (self._count - 1) % RING
            wrench, stamp, status = self._wrench[at].copy(), self._stamp[at], self._status[at]
            temperature = self._temperature
        self._check_load(wrench, int(status))
        return WrenchSample(int(stamp), wrench, np.zeros((6, 6)), 1, temperature)

    def average(self, seconds: float) -> WrenchSample:
        """Return mean and covariance of the frames of the next `seconds` (real time)."""
        if not np.isfinite(seconds) or seconds < 0.0:
            raise ValueError(f"seconds = {seconds}; valid: 0 or more")
        self._check()
        end = time.monotonic() + seconds
        least = max(1.0, MIN_SHARE * np.floor(self.rate * seconds))
        since = first = self._count
        runs: list[tuple[Floats, Ints, Ints]] = []
        while True:
            remaining = end - time.monotonic()
            time.sleep(max(0.0, min(SLICE_S, remaining)) if remaining > 0.0 else POLL_S)
            self._check()
            with self._lock:
                rows = np.arange(since, self._count) % RING
                since = self._count
                runs.append((self._wrench[rows], self._stamp[rows], self._status[rows]))
            late = time.monotonic() - end  # wait also for frames that come late
            if late >= 0.0 and (since - first >= least or late > STALE_S):
                break
        wrench, stamp, status = (np.concatenate(parts) for parts in zip(*runs, strict=True))
        K = len(wrench)
        if least > K:
            raise DeviceError(
                f"{DEVICE}: port {self._path} gave {K} of {self.rate * seconds:.0f} frames in "
                f"{seconds:.3g} s; check its cable"
            )
        for values, bits in zip(wrench, status, strict=True):
            self._check_load(values, int(bits))
        covariance = np.cov(wrench, rowvar=False) if K > 1 else np.zeros((6, 6))
        return WrenchSample(
            int(stamp[-1]), wrench.mean(axis=0), np.asarray(covariance), K, self._temperature
        )

    def losses(self) -> Losses:
        """Return the counters; `lost` includes corrupt frames."""
        with self._lock:
            corrupt = self._deframer.corrupt + self._impossible
            return Losses(self._count, self._counter.lost, corrupt, self._deframer.skipped)

    @property
    def rate(self) -> float:
        """Frames per second that the sensor sends; 0 while unknown."""
        return self._counter.rate

    def report(self) -> Report:
        """Report the sensor, its rate, temperature and counters, and every problem."""
        count, celsius, rate = self.losses(), self._temperature, self.rate
        rows: list[Row] = [(key, value, key.replace(" ", "_"), value) for key, value in self._facts]
        counted = f"{count.frames}, lost {count.lost}, corrupt {count.corrupt}"
        temperature = "" if celsius is None else f"{celsius:.1f} °C"
        rows += [
            ("port", self._path, "port", self._path),
            ("rate" if rate else "", f"{rate:.0f} Hz", "rate_Hz", rate or None),
            ("temperature" if temperature else "", temperature, "temperature_degC", celsius),
            ("frames", counted, "frames", count.frames),
            ("", "", "lost", count.lost),
            ("", "", "corrupt", count.corrupt),
        ]
        return report_of(DEVICE, self._name, rows, self._problems())

    def _problems(self) -> tuple[str, ...]:
        try:
            self.latest()
        except DeviceError as error:
            return (str(error),)
        count = self.losses()
        if count.lost <= FEW + MAX_LOST * (count.frames + count.lost):
            return ()
        return (
            f"{DEVICE}: {count.lost} of {count.frames + count.lost} frames lost on port "
            f"{self._path}; check its cable",
        )

    def close(self) -> None:
        """Stop reading and close the port. Never raises; may be called twice."""
        if self._running:
            self._running = False
            self._thread.join(2.0)
            self._failure = self._failure or f"{DEVICE}: port {self._path} is closed"
            self._before_close()
            close_port(self._port)

    def _read(self) -> None:
        """Read waiting bytes until closed (runs in the thread)."""
        try:
            with self._failures(DEVICE, self._path):
                while self._running:
                    time.sleep(POLL_S)
                    waiting = self._port.in_waiting
                    if waiting:
                        data = self._port.read(waiting)
                        self._store(data, time.monotonic_ns())
                    self._passes += 1
        except DeviceError as error:
            self._failure = str(error)

    def _store(self, data: bytes, stamp: int) -> None:
        """Store the frames that these bytes complete; `stamp`: time of reading, ns."""
        bodies = self._deframer.push(data)
        self._bytes += len(data)
        self._byte_time = stamp * 1e-9
        if not bodies:
            return
        rows = np.frombuffer(b"".join(bodies), dtype=self._sensor.body)
        fields = self._sensor.body.names or ()
        wrench = rows["wrench"] * self._sensor.unit
        ticks = rows["ticks"].tolist() if "ticks" in fields else []
        possible = np.all(np.abs(wrench) < 1e5, axis=1)  # False for NaN
        with self._lock:
            possible &= self._counter.follow(len(rows), ticks, self._byte_time)
            if not np.all(possible):
                self._impossible += int(np.sum(~possible))
                rows, wrench = rows[possible], wrench[possible]
                if not len(rows):
                    return
            at = np.arange(self._count, self._count + len(rows)) % RING
            self._wrench[at] = wrench
            self._stamp[at] = stamp
            self._status[at] = rows["status"] if "status" in fields else 0
            if "temperature" in fields:
                celsius = float(rows["temperature"][-1])
                self._temperature = celsius if -100.0 < celsius < 200.0 else None
            self._frame_time = self._byte_time
            self._count += len(rows)

    def _check(self) -> None:
        """Raise DeviceError for a dead or stale stream.

        On a busy computer the reader may be late, not the sensor. So the reader first gets one
        complete pass that begins after this call.
        """
        enough, end = self._passes + 2, time.monotonic() + RECHECK_S
        while self._failure or time.monotonic() - self._frame_time > STALE_S:
            if self._failure or self._passes >= enough or time.monotonic() > end:
                raise DeviceError(self._silence())
            time.sleep(POLL_S)

    def _check_load(self, wrench: Floats, status: int) -> None:
        if wrong := self._sensor.overload(wrench, status):
            raise DeviceError(f"{DEVICE}: {wrong}")

    def _silence(self) -> str:
        if self._failure:
            return self._failure
        now = time.monotonic()
        where = f"{DEVICE}: port {self._path}"
        since = f"for {now - self._frame_time:.1f} s"
        if now - self._byte_time > STALE_S or not self._bytes:
            return f"{where}: nothing came {since}; check the sensor's power and cable"
        if self._impossible and self._deframer.frames:
            return f"{where}: frames come, but their values or their clock were impossible {since}"
        rate = self._port.baudrate
        at, wrong = (f" at {rate} Bd", "the rate is wrong, ") if rate else ("", "")
        return (
            f"{where}: bytes come{at}, but no whole frame {since}; {wrong}the line is disturbed, "
            f"or it is no {self._sensor.name}"
        )


def open_streaming(section: Section, baud: int, sensor: SensorFormat) -> ForceStream:
    """Open the port of a sensor that streams from power-on, and wait for the first frame."""
    path = serial_port(section)
    port = open_port(DEVICE, path, section.baud or baud)
    with undone_by(lambda: close_port(port)), line_failures(DEVICE, path):
        drain(port, quiet=OLD_S, limit=OLD_S)  # adapters buffer old bytes
    return ForceStream(port, sensor).started()


def serial_port(section: Section) -> str:
    """Return the serial port of a sensor that needs one."""
    if section.port is None:
        raise InputError(f'[force_sensor] driver = "{section.driver}" lacks "port": {PORT}')
    return section.port


def checked_config(config: CellConfig, options: tuple[str, ...] = ()) -> Section:
    """Return [force_sensor]; raise InputError for an option that the driver does not have."""
    section = config.force_sensor
    if section is None:
        raise InputError("[force_sensor] is missing; give driver and port")
    for name in section.options:
        if name not in options:
            valid = f"valid: {', '.join(options)}" if options else "it has none"
            raise InputError(
                f'[force_sensor] options: driver "{section.driver}" has no option "{name}"; {valid}'
            )
    return section
