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
TRIES = 3
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
        NoAnswerError: no sound answer, three times.
        RefusedError: the device has no such registers.
        OSError: the port failed; termios.error likewise.
    """
    answer = _ask(port, struct.pack(">BBHH", slave, READ, address, count), 3 + 2 * count)
    return struct.unpack(f">{count}H", answer[3:])


def write_register(port: serial.Serial, slave: int, address: int, value: int) -> None:
    """Write one register; raises as `read_registers` does."""
    _ask(port, struct.pack(">BBHHBH", slave, WRITE, address, 1, 2, value), 6)


def _ask(port: serial.Serial, request: bytes, size: int) -> bytes:
    """Return a sound answer of `size` bytes (without checksum)."""
    heard = False
    for _ in range(TRIES):
        drain(port, QUIET_S, 4 * QUIET_S)  # also the silence that a request begins with
        port.write(request + _crc(request))
        answer = _answer(port, request, size)
        heard = heard or bool(answer)
        sound = len(answer) >= 5 and _crc(answer[:-2]) == answer[-2:]
        if not sound or answer[0] != request[0]:
            continue
        if answer[1] == request[1] | REFUSED:
            address = int.from_bytes(request[2:4], "big")
            raise RefusedError(f"register {address} refused (Modbus exception {answer[2]})")
        if answer[1] == request[1] and len(answer) == size + 2:
            return answer[:-2]
    raise NoAnswerError(heard)


def _answer(port: serial.Serial, request: bytes, size: int) -> bytes:
    """Read until the answer is complete, or its time is up."""
    end = time.monotonic() + ANSWER_S
    answer = b""
    while time.monotonic() < end:
        refused = len(answer) > 1 and answer[1] == request[1] | REFUSED
        if len(answer) >= (5 if refused else size + 2):
            break
        answer += port.read(port.in_waiting)
        time.sleep(0.002)
    return answer


def _crc(data: bytes) -> bytes:
    return crc_modbus(data).to_bytes(2, "little")
