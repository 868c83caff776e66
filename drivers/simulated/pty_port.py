"""The serial line of a simulated instrument: a pseudo-terminal that behaves like a UART.

Bytes take time (8N1: ten bits each), a full buffer loses new frames, the client's rate has to be
the instrument's, and the adapter can be unplugged and replugged.
"""

import fcntl
import os
import select
import struct
import termios
import threading
import time
import tty
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from hilcal.drivers.simulated.admin import setter

BITS_PER_BYTE = 10
FIFO = 16384  # bytes that wait for a reader, beside those in the terminal's buffer

_RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[1:].isdigit()}
_SPEEDS = {rate: speed for speed, rate in _RATES.items()}
_OUTPUT_SPEED = 5  # index in the result of tcgetattr
_PULSE = 0.02  # longest wait in one call, s, so that an unplugged line closes soon


class PtyPort:
    """A serial line under a stable name; thread-safe.

    `dropped`: number of frames that nobody read in time; `flip`, `cut`: probability that a bit of a
    frame is flipped, and that the frame is truncated.
    """

    def __init__(self, link: Path, baud: int, rng: np.random.Generator) -> None:
        self.link = link
        self.set_baud(baud)
        self.sent = self.dropped = 0
        self.flip = self.cut = 0.0
        self.mute = False
        self._halve = False
        self._rng = rng
        self._lock = threading.RLock()
        self._inbox = bytearray()
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0  # bytes in the queue
        self._free_at = 0.0  # when all bytes sent have passed the wire
        self._master = self._slave = -1
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the line exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Make a new terminal under the port's name, if there is none."""
        with self._lock:
            if self.plugged:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # before a client can open it: no echo
            attributes = termios.tcgetattr(self._slave)
            attributes[4] = attributes[_OUTPUT_SPEED] = _SPEEDS[self.baud]
            termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
            # packet mode: the client's flush of its input becomes visible here (tty_ioctl(4))
            fcntl.ioctl(self._master, termios.TIOCPKT, struct.pack("i", 1))
            os.set_blocking(self._master, False)
            new = self.link.with_name(self.link.name + ".new")
            new.unlink(missing_ok=True)
            new.symlink_to(os.ttyname(self._slave))
            os.replace(new, self.link)

    def unplug(self) -> None:
        """Remove the terminal: the client gets a hang-up."""
        with self._lock:
            if not self.plugged:
                return
            self.link.unlink(missing_ok=True)
            ends, self._master, self._slave = (self._slave, self._master), -1, -1
            for end in ends:
                os.close(end)
            self._queue.clear()
            self._waiting = 0
            self._free_at = 0.0
            self._inbox.clear()

    def send(self, frame: bytes, start: float | None = None) -> None:
        """Put a frame on the wire at `start` (None: now); it arrives with its last bit."""
        with self._lock:
            if self.mute or not self.plugged:
                return
            self._absorb()
            frame = self._damaged(frame)
            if self._waiting + len(frame) > FIFO:
                self.pump()
            if self._waiting + len(frame) > FIFO:
                self.dropped += 1
                return
            self._queue_up(frame, time.monotonic() if start is None else start)
            self.sent += 1

    def pump(self) -> None:
        """Pass on all frames whose last bit has passed, as far as the terminal takes them."""
        with self._lock:
            self._absorb()
            now = time.monotonic()
            data = self._arrived(now)
            if not data:
                return
            try:
                written = os.write(self._master, data) if self.plugged else len(data)
            except BlockingIOError:
                written = 0
            except OSError:
                written = len(data)
            if written < len(data):
                self._queue.appendleft((now, data[written:]))
                self._waiting += len(data) - written

    @property
    def next_arrival(self) -> float:
        """Arrival of the next frame, `time.monotonic`; infinity if none is on the wire."""
        with self._lock:
            return self._queue[0][0] if self._queue else float("inf")

    def drain(self) -> None:
        """Wait until all frames sent have passed the wire (read or not)."""
        while True:
            self.pump()
            with self._lock:
                remaining = self._free_at - time.monotonic() if self._queue else 0.0
            if remaining <= 0.0:
                return
            time.sleep(remaining)

    def read(self, timeout: float) -> bytes:
        """Return the client's bytes; empty after `timeout` s (20 ms at most)."""
        pause = max(0.0, min(timeout, _PULSE))
        master = self._master
        if not self._inbox:
            try:
                select.select([master] if master >= 0 else [], [], [], pause)
            except OSError:  # unplugged meanwhile
                return b""
        with self._lock:
            self._absorb()
            data = bytes(self._inbox)
            self._inbox.clear()
            return data

    def faults(self) -> dict[str, Callable[..., None]]:
        """Return the faults of the line, by name."""
        return {
            "flip": setter(self, "flip", float),
            "cut": setter(self, "cut", float),
            "mute": setter(self, "mute"),
            "half_frame": lambda: setattr(self, "_halve", True),
            "garbage": self.garbage,
            "unplug": self.unplug,
            "replug": self.plug,
            "baud": self.set_baud,
        }

    def garbage(self, count: int) -> None:
        """Put random bytes on the wire."""
        with self._lock:
            if self.plugged:
                self._queue_up(self._rng.bytes(int(count)), time.monotonic())

    def set_baud(self, baud: int) -> None:
        """Let the instrument send and receive at another rate, Bd."""
        if baud not in _SPEEDS:
            raise ValueError(f"baud = {baud}; valid: {sorted(_SPEEDS)}")
        self.baud = int(baud)

    def state(self) -> dict[str, Any]:
        """Return the counters and faults."""
        names = ("sent", "dropped", "plugged", "baud", "flip", "cut", "mute")
        state = {name: getattr(self, name) for name in names}
        return {**state, "waiting": self._waiting, "client_baud": self._client_baud()}

    def _absorb(self) -> None:
        """Read the client's packets: packet mode puts a status byte before the data.

        A flush by the client (the kernel has emptied its buffer already) discards the frames that
        have arrived, and no later ones.
        """
        while self.plugged:
            try:
                packet = os.read(self._master, 4096)
            except OSError:
                return
            if not packet:
                return
            if packet[0] & termios.TIOCPKT_FLUSHREAD:
                self._arrived(time.monotonic())
            elif not packet[0]:
                data = packet[1:]
                same_rate = self._client_baud() == self.baud
                self._inbox += data if same_rate else self._rng.bytes(len(data))

    def _arrived(self, now: float) -> bytes:
        """Remove and return the bytes that have passed the wire at `now`."""
        out = []
        while self._queue and self._queue[0][0] <= now:
            out.append(self._queue.popleft()[1])
        data = b"".join(out)
        self._waiting -= len(data)
        return data

    def _client_baud(self) -> int | None:
        """Return the rate that the client has set, None if unusual."""
        if not self.plugged:
            return None
        try:
            return _RATES.get(termios.tcgetattr(self._slave)[_OUTPUT_SPEED])
        except termios.error:
            return None

    def _damaged(self, frame: bytes) -> bytes:
        if self.flip and self._rng.random() < self.flip:
            damaged = bytearray(frame)
            damaged[self._rng.integers(len(damaged))] ^= 1 << int(self._rng.integers(8))
            frame = bytes(damaged)
        if self._halve:
            self._halve = False
            frame = frame[: len(frame) // 2]
        elif self.cut and len(frame) > 1 and self._rng.random() < self.cut:
            frame = frame[: self._rng.integers(1, len(frame))]
        client = self._client_baud()
        if client != self.baud:  # sampled at another rate: more or fewer bytes, all wrong
            share = (client or 2 * self.baud) / self.baud
            frame = self._rng.bytes(max(1, round(len(frame) * min(share, 2.0))))
        return frame

    def _queue_up(self, data: bytes, now: float) -> None:
        """Put bytes on the wire after those already there: ten bits each."""
        self._free_at = max(self._free_at, now) + len(data) * BITS_PER_BYTE / self.baud
        self._queue.append((self._free_at, data))
        self._waiting += len(data)
