"""Robotiq FT 300: Modbus RTU slave 9, and a stream of its own.

Robotiq, "FT 300 Instruction Manual", chapters "Modbus RTU" and "Data stream": 19200 Bd 8N1,
100 Hz, frame `20 4E`, six int16 (N·100, N·m·1000), CRC-16/MODBUS over all before it, everything
little-endian. Writing 0200 to register 410 starts the stream, fifty bytes FF stop it.
"""

import struct
from typing import Any

import numpy as np

from hilcal.types import Floats

SLAVE = 9
HEADER = b"\x20\x4e"
SCALE = np.repeat((100.0, 1000.0), 3)
RANGE = np.repeat((300.0, 30.0), 3)
"""Full scale, N and N·m."""
STREAM, STREAM_REGISTER = 0x0200, 410
STOP_BYTES = 50
WRENCH_REGISTER = 180
READ, WRITE_ONE, WRITE_MANY = (3, 4), 6, 16
BAD_FUNCTION, BAD_ADDRESS, BAD_VALUE = 1, 2, 3

_FIRMWARE = "SIM-1.0.10\0\0"
_SERIAL = "F3004242"
_YEAR = 2024


def crc16_modbus(data: bytes | bytearray) -> int:
    """Return the CRC-16/MODBUS: polynomial x¹⁶ + x¹⁵ + x² + 1, reflected, start FFFF."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


def _words(text: str) -> list[int]:
    return [ord(a) << 8 | ord(b) for a, b in zip(text[::2], text[1::2], strict=True)]


def _checked(data: bytes) -> bytes:
    return data + struct.pack("<H", crc16_modbus(data))


class Ft300:
    """The sensor's protocol."""

    baud = 19200
    noise = (0.1, 0.005)

    def __init__(self, rate: float = 100.0) -> None:
        """Switch on: it waits for requests."""
        self.rate = rate
        self.streaming = False
        self._stop_bytes = 0
        self._inbox = bytearray()
        fixed = {500: _words(_FIRMWARE), 510: [*_words(_SERIAL), _YEAR], STREAM_REGISTER: [0]}
        self._registers = {
            start + i: word for start, words in fixed.items() for i, word in enumerate(words)
        }

    def frame(self, number: int, wrench: Floats, temperature: float) -> bytes:
        """Return one frame, see `Sensor.frame`; the sensor tells neither time nor temperature."""
        return _checked(HEADER + struct.pack("<6h", *self._counts(wrench)))

    def receive(self, data: bytes, wrench: Floats) -> bytes:
        """Answer Modbus requests; while streaming only the stop bytes count."""
        if self.streaming:
            for byte in data:
                self._stop_bytes = self._stop_bytes + 1 if byte == 0xFF else 0
                if self._stop_bytes >= STOP_BYTES:
                    self.streaming = False
            return b""
        self._inbox += data
        answer = b""
        while not self.streaming and (request := self._request()):
            answer += self._answer(request, wrench)
        return answer

    def admin(self, op: str, arguments: dict[str, Any]) -> bool:
        """No operations of its own."""
        return False

    def _counts(self, wrench: Floats) -> list[int]:
        inside = np.clip(wrench, -RANGE, RANGE)
        return [int(value) for value in np.rint(inside * SCALE)]

    def _request(self) -> bytes:
        """Take one sound request to this slave out of the inbox; empty where there is none yet."""
        box = self._inbox
        while len(box) >= 8:
            length = 9 + box[6] if box[1] == WRITE_MANY else 8
            if box[0] != SLAVE:
                del box[0]
            elif len(box) < length:
                break
            elif int.from_bytes(box[length - 2 : length], "little") != crc16_modbus(
                box[: length - 2]
            ):
                del box[0]
            else:
                request = bytes(box[:length])
                del box[:length]
                return request
        return b""

    def _answer(self, request: bytes, wrench: Floats) -> bytes:
        function = request[1]
        address, word = struct.unpack_from(">HH", request, 2)
        if function in READ:
            live = {
                WRENCH_REGISTER + i: count & 0xFFFF for i, count in enumerate(self._counts(wrench))
            }
            registers = self._registers | live
            wanted = range(address, address + word)
            if not 1 <= word <= 125:
                return _refusal(function, BAD_VALUE)
            if not all(register in registers for register in wanted):
                return _refusal(function, BAD_ADDRESS)
            words = struct.pack(f">{word}H", *(registers[register] for register in wanted))
            return _checked(bytes([SLAVE, function, len(words)]) + words)
        if function == WRITE_ONE:
            values = [word]
        elif function == WRITE_MANY:
            if len(request) != 9 + 2 * word:
                return _refusal(function, BAD_VALUE)
            values = list(struct.unpack_from(f">{word}H", request, 7))
        else:
            return _refusal(function, BAD_FUNCTION)
        if address != STREAM_REGISTER or len(values) != 1:
            return _refusal(function, BAD_ADDRESS)
        self._stop_bytes = 0
        self.streaming = values[0] == STREAM
        return _checked(request[:6])


def _refusal(function: int, code: int) -> bytes:
    return _checked(bytes([SLAVE, function | 0x80, code]))
