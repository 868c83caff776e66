"""Reading and writing registers over Modbus RTU: one request, one answer.

Modbus over Serial Line, Specification and Implementation Guide V1.02 (modbus.org, 2006).
"""

import struct
import time

import serial

from drivers.frames import crc_modbus
from drivers.serial_line import drain
from hilcal.errors import DeviceError

ANSWER_S = 0.25
QUIET_S = 0.03
TRIES = 2
READ, WRITE = 3, 16
REFUSED = 0x80


class NoAnswerError(DeviceError):
    """Nothing came that could be an answer; `heard` tells whether anything came at all."""

    def __init__(self, heard: bool) -> None:
        """Without a text: the caller knows what device it is."""
        super().__init__("no answer")
        self.heard = heard


class RefusedError(DeviceError):
    """The device answered that it does not do this."""


def read_registers(port: serial.Serial, slave: int, address: int, count: int) -> tuple[int, ...]:
    """Return `count` holding registers (16 bits each) from an address on.

    Raises:
        NoAnswerError: no sound answer, twice.
        RefusedError: the device has no such registers.
        OSError: the port failed; termios.error likewise.
    """
    answer = _ask(port, struct.pack(">BBHH", slave, READ, address, count), 3 + 2 * count)
    return struct.unpack(f">{count}H", answer[3:])


def write_register(port: serial.Serial, slave: int, address: int, value: int) -> None:
    """Write one register; raises as `read_registers` does."""
    _ask(port, struct.pack(">BBHHBH", slave, WRITE, address, 1, 2, value), 6)


def _ask(port: serial.Serial, request: bytes, size: int) -> bytes:
    """Return a sound answer of `size` bytes (without checksum), whatever comes around it."""
    heard = False
    for _ in range(TRIES):
        drain(port, QUIET_S, 4 * QUIET_S)  # also the silence that a request begins with
        port.write(request + _crc(request))
        end, got = time.monotonic() + ANSWER_S, b""
        while time.monotonic() < end:
            got += port.read(port.in_waiting)
            if answer := _sound(got, request[:2], size):
                return answer
            refusal = _sound(got, bytes([request[0], request[1] | REFUSED]), 3)
            if refusal:
                address = int.from_bytes(request[2:4], "big")
                raise RefusedError(f"register {address} refused (Modbus exception {refusal[2]})")
            time.sleep(0.002)
        heard = heard or bool(got)
    raise NoAnswerError(heard)


def _sound(data: bytes, begin: bytes, size: int) -> bytes:
    """The first message of `size` bytes with this beginning and a right checksum, else b""."""
    at = data.find(begin)
    while 0 <= at <= len(data) - size - 2:
        message, crc = data[at : at + size], data[at + size : at + size + 2]
        if _crc(message) == crc:
            return message
        at = data.find(begin, at + 1)
    return b""


def _crc(data: bytes) -> bytes:
    return crc_modbus(data).to_bytes(2, "little")
