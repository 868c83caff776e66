"""A force sensor that sends by itself, read in the background: newest frame, means, counters.

One thread takes what waits on the line every few milliseconds (the kernel keeps 4096 bytes,
110 frames of the longest kind), finds the frames and keeps the last ones in a ring.
"""

import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from hilcal.config import CellConfig
from hilcal.config.sections import PORT
from hilcal.config.sections import ForceSensor as Section
from hilcal.drivers.frame_losses import LossCounter
from hilcal.drivers.frames import Deframer, FrameFormat
from hilcal.drivers.serial_line import close_port, drain, line_failures, open_port
from hilcal.errors import DeviceError, InputError
from hilcal.measuring.devices import Losses, Report, WrenchSample
from hilcal.types import Floats, Ints

DEVICE = "force sensor"
STALE_S = 0.5
"""Older than this, a frame is not the present. A busy computer hands bytes over late: the kernel
passes them on in a thread that competes with all programs; 0.2 s are not rare."""
POLL_S = 0.005
LOOK_S = 1.0
"""The reader gets so long to look once more; it takes two passes where the computer is idle."""
SLICE_S = 0.05
MIN_SHARE = 0.5
"""Share of the frames due in a window that has to come for a mean."""
FEW, MAX_LOST = 5, 0.01
"""So many lost frames, and this share of all, are no problem yet."""
RING = 4096
FIRST_FRAME_S, OLD_S = 1.0, 0.05


@dataclass(frozen=True, slots=True, eq=False)
class SensorFormat:
    """What a sensor puts on its line."""

    name: str  # the maker's, for people
    frame: FrameFormat  # its frames; of no meaning where they come as datagrams
    body: np.dtype[Any]
    """What is between header and checksum; field `wrench` (6), and where it gives them `status`,
    `ticks` (device clock) and `temperature` (°C)."""
    unit: Floats  # (6,) N and N·m per count of `wrench`
    losses: Callable[[], LossCounter]  # makes the counter of lost frames
    overload: Callable[[Floats, int], str]
    """(wrench (6,), status) to what is wrong with such a frame, "" where nothing."""


class Port(Protocol):
    """What a stream is read from: a serial port, or datagrams behind the same few names."""

    @property
    def port(self) -> Any:
        """Its name."""

    @property
    def baudrate(self) -> int:
        """Rate of the line, Bd; 0 where there is none."""

    @property
    def in_waiting(self) -> int:
        """Bytes that have come."""

    def read(self, size: int) -> bytes:
        """Return so many of them."""

    def close(self) -> None:
        """Give it back."""


class FrameSource(Protocol):
    """What takes frames out of bytes, and counts; see `frames.Deframer`."""

    frames: int
    corrupt: int
    skipped: int

    def push(self, data: bytes) -> list[bytes]:
        """Take bytes, return the bodies of the frames in them."""
        ...


class ForceStream:
    """A sensor that is sending; see `hilcal.measuring.devices.ForceSensorDevice`."""

    def __init__(
        self,
        port: Port,
        sensor: SensorFormat,
        name: str = "",
        facts: tuple[tuple[str, str], ...] = (),
        *,
        deframer: FrameSource | None = None,
        failures: Callable[[str, str], AbstractContextManager[None]] = line_failures,
        before_close: Callable[[], None] = lambda: None,
    ) -> None:
        """Start to read an open port, which `close` closes.

        Args:
            port: open.
            sensor: what it sends.
            name: the maker's, with the serial number where known.
            facts: for the report, besides those of the stream.
            deframer: takes the frames out of the bytes where `sensor.frame` does not tell how.
            failures: turns what the port raises into DeviceError, from the device and its place.
            before_close: sends the last command to the sensor; must not raise.
        """
        self._name, self._facts, self._before_close = name or sensor.name, facts, before_close
        self._port, self._sensor, self._failures = port, sensor, failures
        self._path = str(port.port)
        self._deframer: FrameSource = Deframer(sensor.frame) if deframer is None else deframer
        self._counter = sensor.losses()
        self._lock = threading.Lock()
        self._failure = ""
        self._passes = 0
        self._bytes = self._impossible = self._kept = 0
        self._byte_time = self._frame_time = self._start = time.monotonic()
        self._wrench = np.zeros((RING, 6))
        self._stamp = np.zeros(RING, dtype=np.int64)
        self._status = np.zeros(RING, dtype=np.int64)
        self._temperature: float | None = None
        self._running = True
        self._thread = threading.Thread(target=self._read, name=DEVICE, daemon=True)
        self._thread.start()

    def wait_for_first(self, seconds: float) -> None:
        """Return when a frame has come; raises DeviceError where none came or the line failed."""
        end = time.monotonic() + seconds
        while not self._kept and not self._failure and time.monotonic() < end:
            time.sleep(POLL_S)
        if not self._kept:
            raise DeviceError(self._silence())

    def latest(self) -> WrenchSample:
        """Return the newest frame, at most `STALE_S` old.

        Raises:
            DeviceError: the stream is dead or stale, or the sensor is loaded over its range.
        """
        self._check()
        with self._lock:
            at = (self._kept - 1) % RING
            wrench, stamp, status = self._wrench[at].copy(), self._stamp[at], self._status[at]
            temperature = self._temperature
        self._check_load(wrench, int(status))
        return WrenchSample(int(stamp), wrench, np.zeros((6, 6)), 1, temperature)

    def average(self, seconds: float) -> WrenchSample:
        """Return the mean of the frames of the next so many real seconds.

        Raises:
            DeviceError: the stream is dead, gave under half of its frames, or the sensor was
                loaded over its range meanwhile.
        """
        if not np.isfinite(seconds) or seconds < 0.0:
            raise ValueError(f"seconds = {seconds}; valid: 0 or more")
        self._check()
        end = time.monotonic() + seconds
        least = max(1.0, MIN_SHARE * np.floor(self.rate * seconds))
        since = first = self._kept
        runs: list[tuple[Floats, Ints, Ints]] = []
        while True:
            left = end - time.monotonic()
            time.sleep(max(0.0, min(SLICE_S, left)) if left > 0.0 else POLL_S)
            self._check()
            with self._lock:
                rows = np.arange(since, self._kept) % RING
                since = self._kept
                runs.append((self._wrench[rows], self._stamp[rows], self._status[rows]))
            late = time.monotonic() - end  # frames may be late, too
            if late >= 0.0 and (since - first >= least or late > STALE_S):
                break
        wrench, stamp, status = (np.concatenate(parts) for parts in zip(*runs, strict=True))
        K = len(wrench)
        if least > K:
            raise DeviceError(
                f"{DEVICE}: port {self._path} gave {K} of {self.rate * seconds:.0f} frames in "
                f"{seconds:.3g} s; check its cable"
            )
        for one, word in zip(wrench, status, strict=True):
            self._check_load(one, int(word))
        covariance = np.cov(wrench, rowvar=False) if K > 1 else np.zeros((6, 6))
        return WrenchSample(
            int(stamp[-1]), wrench.mean(axis=0), np.asarray(covariance), K, self._temperature
        )

    def losses(self) -> Losses:
        """Return the counters; `lost` are all that did not come whole, corrupt ones included."""
        with self._lock:
            found = self._deframer
            return Losses(
                self._kept, self._counter.lost, found.corrupt + self._impossible, found.skipped
            )

    @property
    def rate(self) -> float:
        """Frames per second as the sensor sends them; 0 while that is unknown."""
        return self._counter.rate

    def report(self) -> Report:
        """Say who answered, rate, temperature, counters, and every problem."""
        count, warm = self.losses(), self._temperature
        facts = [*self._facts, ("port", self._path)]
        if self.rate:
            facts.append(("rate", f"{self.rate:.0f} Hz"))
        if warm is not None:
            facts.append(("temperature", f"{warm:.1f} °C"))
        facts.append(("frames", f"{count.frames}, lost {count.lost}, corrupt {count.corrupt}"))
        fields: list[tuple[str, object]] = [
            *((what.replace(" ", "_"), value) for what, value in self._facts),
            ("port", self._path),
            ("rate_Hz", self.rate or None),
            ("temperature_degC", warm),
            ("frames", count.frames),
            ("lost", count.lost),
            ("corrupt", count.corrupt),
        ]
        return Report(DEVICE, self._name, tuple(facts), self._problems(), tuple(fields))

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
        """Stop to read, give the port back. Never raises, may be called twice."""
        if self._running:
            self._running = False
            self._thread.join(2.0)
            self._failure = self._failure or f"{DEVICE}: port {self._path} is closed"
            self._before_close()
            close_port(self._port)

    def _read(self) -> None:
        """Take what waits on the line, again and again (the thread)."""
        try:
            with self._failures(DEVICE, self._path):
                while self._running:
                    time.sleep(POLL_S)
                    waiting = self._port.in_waiting
                    if waiting:
                        data = self._port.read(waiting)
                        self._take(data, time.monotonic_ns())
                    self._passes += 1
        except DeviceError as error:
            self._failure = str(error)

    def _take(self, data: bytes, stamp: int) -> None:
        """Find frames in bytes read at a time, and keep them."""
        bodies = self._deframer.push(data)
        self._bytes += len(data)
        self._byte_time = stamp * 1e-9
        if not bodies:
            return
        rows = np.frombuffer(b"".join(bodies), dtype=self._sensor.body)
        known = self._sensor.body.names or ()
        wrench = rows["wrench"] * self._sensor.unit
        ticks = rows["ticks"].tolist() if "ticks" in known else []
        possible = np.all(np.abs(wrench) < 1e5, axis=1)  # False for NaN
        with self._lock:
            possible &= self._counter.follow(len(rows), ticks, self._byte_time)
            if not np.all(possible):
                self._impossible += int(np.sum(~possible))
                rows, wrench = rows[possible], wrench[possible]
                if not len(rows):
                    return
            at = np.arange(self._kept, self._kept + len(rows)) % RING
            self._wrench[at] = wrench
            self._stamp[at] = stamp
            self._status[at] = rows["status"] if "status" in known else 0
            if "temperature" in known:
                warm = float(rows["temperature"][-1])
                self._temperature = warm if -100.0 < warm < 200.0 else None
            self._frame_time = self._byte_time
            self._kept += len(rows)

    def _check(self) -> None:
        """Refuse a dead or stale stream.

        On a busy computer it may be the reader that was late, not the sensor: it looks once more
        first, in a pass that begins after this call.
        """
        enough, end = self._passes + 2, time.monotonic() + LOOK_S
        while self._failure or time.monotonic() - self._frame_time > STALE_S:
            if self._failure or self._passes >= enough or time.monotonic() > end:
                raise DeviceError(self._silence())
            time.sleep(POLL_S)

    def _check_load(self, wrench: Floats, status: int) -> None:
        """Refuse a frame that the sensor could not measure."""
        wrong = self._sensor.overload(wrench, status)
        if wrong:
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


def streaming(stream: ForceStream, seconds: float = FIRST_FRAME_S) -> ForceStream:
    """Return a stream whose first frame has come; it is closed where none does.

    Raises:
        DeviceError: nothing or nothing sensible came in time.
    """
    try:
        stream.wait_for_first(seconds)
    except BaseException:
        stream.close()
        raise
    return stream


def open_streaming(section: Section, baud: int, sensor: SensorFormat) -> ForceStream:
    """Open the port of a sensor that streams from power-on, and wait for the first frame.

    The rate of the configuration comes before `baud`, the one of the sensor as delivered, Bd.

    Raises:
        DeviceError: no such port, in use, nothing or nothing sensible comes.
    """
    path = serial_port(section)
    port = open_port(DEVICE, path, section.baud or baud)
    try:
        with line_failures(DEVICE, path):
            drain(port, quiet=OLD_S, limit=OLD_S)  # adapters keep some of what came before
    except BaseException:
        close_port(port)
        raise
    return streaming(ForceStream(port, sensor))


def serial_port(section: Section) -> str:
    """Return the serial port of a sensor that needs one.

    Raises:
        InputError: there is none.
    """
    if section.port is None:
        raise InputError(f'[force_sensor] driver = "{section.driver}" lacks "port": {PORT}')
    return section.port


def checked_config(config: CellConfig, options: tuple[str, ...] = ()) -> Section:
    """Return [force_sensor], with no option that the driver does not know.

    Raises:
        InputError: the section is missing, or has an unknown option.
    """
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
