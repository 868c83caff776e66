"""A force sensor's stream, read in the background: newest frame, means, counters.

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

from hilcal.drivers.frame_losses import LossCounter
from hilcal.drivers.frames import Deframer, FrameFormat
from hilcal.drivers.serial_line import line_failures
from hilcal.errors import DeviceError
from hilcal.measuring.devices import Losses, WrenchSample
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


@dataclass(frozen=True, slots=True, eq=False)
class SensorFormat:
    """What a sensor puts on its line.

    Attributes:
        name: the maker's, for people.
        frame: its frames; of no meaning where they come as datagrams.
        body: what is between header and checksum; field `wrench` (6), and where it gives them
            `status`, `ticks` (device clock) and `temperature` (°C).
        unit: (6,) N and N·m per count of `wrench`.
        losses: makes the counter of lost frames.
        overload: (wrench (6,), status) to what is wrong with such a frame, "" where nothing.
    """

    name: str
    frame: FrameFormat
    body: np.dtype[Any]
    unit: Floats
    losses: Callable[[], LossCounter]
    overload: Callable[[Floats, int], str]


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
    """Reads a sensor that is sending, until `stop`; it uses the port and does not close it."""

    def __init__(
        self,
        port: Port,
        sensor: SensorFormat,
        deframer: FrameSource | None = None,
        failures: Callable[[str, str], AbstractContextManager[None]] = line_failures,
    ) -> None:
        """Start to read.

        Args:
            port: open.
            sensor: what it sends.
            deframer: takes the frames out of the bytes where `sensor.frame` does not tell how.
            failures: turns what the port raises into DeviceError, from the device and its place.
        """
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
        """Return when a frame has come.

        Raises:
            DeviceError: none came in time, or the line failed.
        """
        end = time.monotonic() + seconds
        while not self._kept and not self._failure and time.monotonic() < end:
            time.sleep(POLL_S)
        if not self._kept:
            raise DeviceError(self._silence())

    def latest(self) -> WrenchSample:
        """Return the newest frame; see `hilcal.measuring.devices.ForceSensorDevice`."""
        self._check()
        with self._lock:
            at = (self._kept - 1) % RING
            wrench, stamp, status = self._wrench[at].copy(), self._stamp[at], self._status[at]
            temperature = self._temperature
        self._check_load(wrench, int(status))
        return WrenchSample(int(stamp), wrench, np.zeros((6, 6)), 1, temperature)

    def average(self, seconds: float) -> WrenchSample:
        """Return the mean over the next seconds; see `measuring.devices.ForceSensorDevice`."""
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

    def facts(self) -> list[tuple[str, str]]:
        """What the stream tells, for people."""
        count = self.losses()
        facts = [("port", self._path)]
        if self.rate:
            facts.append(("rate", f"{self.rate:.0f} Hz"))
        if self._temperature is not None:
            facts.append(("temperature", f"{self._temperature:.1f} °C"))
        facts.append(("frames", f"{count.frames}, lost {count.lost}, corrupt {count.corrupt}"))
        return facts

    def fields(self) -> list[tuple[str, object]]:
        """The same for scripts."""
        count = self.losses()
        return [
            ("port", self._path),
            ("rate_Hz", self.rate or None),
            ("temperature_degC", self._temperature),
            ("frames", count.frames),
            ("lost", count.lost),
            ("corrupt", count.corrupt),
        ]

    def problems(self) -> list[str]:
        """What has to be put right, one line each."""
        try:
            self.latest()
        except DeviceError as error:
            return [str(error)]
        count = self.losses()
        if count.lost > FEW + MAX_LOST * (count.frames + count.lost):
            return [
                f"{DEVICE}: {count.lost} of {count.frames + count.lost} frames lost on port "
                f"{self._path}; check its cable"
            ]
        return []

    def stop(self) -> None:
        """Stop to read; the port is free for its owner. Never raises."""
        self._running = False
        self._thread.join(2.0)
        self._failure = self._failure or f"{DEVICE}: port {self._path} is closed"

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
        """Why there is no frame, in one line."""
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
