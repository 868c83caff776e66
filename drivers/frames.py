"""Frames out of a stream of bytes: find the header, verify the checksum, else look on."""

from collections.abc import Callable
from dataclasses import dataclass


def crc_table(polynomial: int) -> tuple[int, ...]:
    """Return the 256 remainders of a reflected 16-bit polynomial, for one byte at a time.

    D. V. Sarwate, Computation of cyclic redundancy checks via table look-up, CACM 31 (1988).
    """
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (polynomial if value & 1 else 0)
        table.append(value)
    return tuple(table)


_MODBUS = crc_table(0xA001)
_X25 = crc_table(0x8408)


def crc_modbus(data: bytes) -> int:
    """Return CRC-16/MODBUS: polynomial 0x8005 reflected, start 0xFFFF; 0x4B37 for b"123456789"."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _MODBUS[(crc ^ byte) & 0xFF]
    return crc


def crc_x25(data: bytes) -> int:
    """Return CRC-16/X-25: polynomial 0x1021 reflected, start and end 0xFFFF; 0x906E likewise."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ _X25[(crc ^ byte) & 0xFF]
    return crc ^ 0xFFFF


@dataclass(frozen=True, slots=True)
class FrameFormat:
    """What a frame of fixed length looks like: header, body, two bytes of checksum."""

    header: bytes  # the bytes that every frame begins with
    size: int  # of a whole frame, bytes
    checksum: Callable[[bytes], bytes]
    """What the last two bytes must be, from all the bytes before them."""
    weak: bool = False
    """Whether the checksum is a mere sum; then a frame counts only once the header of the next one
    follows it directly."""


class Deframer:
    """Finds frames in bytes that come in pieces; after a bad one it gives up one byte only.

    A 16-bit checksum passes 1 of 65536 wrong candidates, and while looking for the next header
    every byte is a candidate. So a frame that does not follow a good one directly counts only
    once a second good frame follows it directly.

    Attributes:
        corrupt: frames with a wrong checksum; several candidates inside one length count once.
        skipped: bytes that belonged to no good frame; both from the first good frame on, for
            who begins to listen comes into the middle of one.
    """

    def __init__(self, frame: FrameFormat) -> None:
        """Start without any bytes, not in step with the sender."""
        self.frames = self.corrupt = self.skipped = 0
        self._format = frame
        self._buffer = bytearray()
        self._in_step = self._begun = False
        self._taken = 0  # position in the stream of the buffer's first byte
        self._bad_until = 0  # stream position up to which a bad frame has been counted

    def push(self, data: bytes) -> list[bytes]:
        """Take bytes, return the bodies (without header and checksum) of the frames they end."""
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
            if good and (not self._in_step or self._format.weak):
                needed = len(header) if self._in_step else size
                if len(buffer) - at < size + needed:
                    break  # the next frame will tell
                next_ = at + size
                good = buffer.startswith(header, next_) if self._in_step else self._good(next_)
            if good:
                self._in_step = self._begun = True
                out.append(bytes(buffer[at + len(header) : at + size - 2]))
                at += size
            else:
                if self._taken + at >= self._bad_until:
                    self.corrupt += self._begun
                    self._bad_until = self._taken + at + size
                self._skip(1)
                at += 1
        del buffer[:at]
        self._taken += at
        self.frames += len(out)
        return out

    def _skip(self, count: int) -> None:
        """Count bytes that belong to no frame."""
        if count:
            self.skipped += count * self._begun
            self._in_step = False

    def _good(self, at: int) -> bool:
        """Whether a frame with a right checksum begins there."""
        frame = bytes(self._buffer[at : at + self._format.size])
        checksum = self._format.checksum
        return frame.startswith(self._format.header) and checksum(frame[:-2]) == frame[-2:]
