"""The serial line of a simulated instrument: a pseudo-terminal that behaves like a UART.

Bytes take their time (8N1: ten bits each), a full buffer loses new frames, the client's rate
has to be the instrument's, and the adapter can be pulled out and put in again.
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
FIFO = 16384  # bytes that wait for a reader beyond what the terminal itself holds

_RATES = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[1:].isdigit()}
_SPEEDS = {rate: speed for speed, rate in _RATES.items()}
_OUTPUT_SPEED = 5  # index in what tcgetattr returns
_PULSE = 0.02  # longest wait in one call, s, so that an unplugged line closes soon


class PtyPort:
    """One serial line under a stable name; safe to be used from several threads.

    `dropped` frames are those that nobody read in time; `flip` and `cut` are the probabilities that
    a bit of a frame is flipped, and that it is truncated.
    """

    def __init__(self, link: Path, baud: int, rng: np.random.Generator) -> None:
        if baud not in _SPEEDS:
            raise ValueError(f"baud = {baud}; valid: {sorted(_SPEEDS)}")
        self.link, self.baud = link, baud
        self.sent = self.dropped = 0
        self.flip = self.cut = 0.0
        self.mute = False
        self._halve = False
        self._rng = rng
        self._lock = threading.RLock()
        self._inbox = bytearray()
        self._queue: deque[tuple[float, bytes]] = deque()
        self._waiting = 0  # bytes in the queue
        self._free_at = 0.0  # when the wire has finished with all that was sent
        self._master = self._slave = -1
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the line exists."""
        return self._master >= 0

    def plug(self) -> None:
        """Make a new terminal under the port's name; nothing if it is there."""
        with self._lock:
            if self.plugged:
                return
            self._master, self._slave = os.openpty()
            tty.setraw(self._slave)  # before anybody can open it: no echo
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
        """Take the terminal away: the client gets a hang-up."""
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

    def send(self, frame: bytes, born: float | None = None) -> None:
        """Put a frame on the wire, begun when `born`; it arrives when its last bit has passed."""
        with self._lock:
            if self.mute or not self.plugged:
                return
            self._absorb()
            frame = self._spoilt(frame)
            if self._waiting + len(frame) > FIFO:
                self.pump()
            if self._waiting + len(frame) > FIFO:
                self.dropped += 1
                return
            now = time.monotonic() if born is None else born
            self._queue_up(frame, now)
            self.sent += 1

    def pump(self) -> None:
        """Hand over everything whose last bit has passed, as far as the terminal takes it."""
        with self._lock:
            self._absorb()
            now = time.monotonic()
            data = self._arrived(now)
            if not data:
                return
            try:
                taken = os.write(self._master, data) if self.plugged else len(data)
            except BlockingIOError:
                taken = 0
            except OSError:
                taken = len(data)
            if taken < len(data):
                self._queue.appendleft((now, data[taken:]))
                self._waiting += len(data) - taken

    @property
    def next_arrival(self) -> float:
        """When the next frame has passed the wire, `time.monotonic`; infinity if none is on it."""
        with self._lock:
            return self._queue[0][0] if self._queue else float("inf")

    def drain(self) -> None:
        """Wait until all that was sent has passed the wire (not: has been read)."""
        while True:
            self.pump()
            with self._lock:
                left = self._free_at - time.monotonic() if self._queue else 0.0
            if left <= 0.0:
                return
            time.sleep(left)

    def read(self, timeout: float) -> bytes:
        """Return what the client has sent; empty after `timeout` s (20 ms at most)."""
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
        """Return what can go wrong on the line, by name."""
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
        """Let the instrument send and hear at another rate, Bd."""
        if baud not in _SPEEDS:
            raise ValueError(f"baud = {baud}; valid: {sorted(_SPEEDS)}")
        self.baud = int(baud)

    def state(self) -> dict[str, Any]:
        """Return the counters and faults."""
        names = ("sent", "dropped", "plugged", "baud", "flip", "cut", "mute")
        state = {name: getattr(self, name) for name in names}
        return {**state, "waiting": self._waiting, "client_baud": self._client_baud()}

    def _absorb(self) -> None:
        """Take in what the client did: packet mode puts a status byte before its data.

        A flush of the client's input (the kernel's part of it is gone already) throws away
        what had come by then and no more: an answer that comes after it is seen.
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
                right = self._client_baud() == self.baud
                self._inbox += data if right else self._rng.bytes(len(data))

    def _arrived(self, now: float) -> bytes:
        """Take out of the queue what has passed the wire by now."""
        out = []
        while self._queue and self._queue[0][0] <= now:
            out.append(self._queue.popleft()[1])
        data = b"".join(out)
        self._waiting -= len(data)
        return data

    def _client_baud(self) -> int | None:
        """Return the rate that the client has set, None where it is no common one."""
        if not self.plugged:
            return None
        try:
            return _RATES.get(termios.tcgetattr(self._slave)[_OUTPUT_SPEED])
        except termios.error:
            return None

    def _spoilt(self, frame: bytes) -> bytes:
        if self.flip and self._rng.random() < self.flip:
            spoilt = bytearray(frame)
            spoilt[self._rng.integers(len(spoilt))] ^= 1 << int(self._rng.integers(8))
            frame = bytes(spoilt)
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
        """Let bytes follow what is on the wire: ten bits each."""
        self._free_at = max(self._free_at, now) + len(data) * BITS_PER_BYTE / self.baud
        self._queue.append((self._free_at, data))
        self._waiting += len(data)
