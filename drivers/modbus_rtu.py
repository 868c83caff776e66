"""Holding registers over Modbus RTU by minimalmodbus, on a line that may be noisy or streaming.

Modbus over Serial Line, Specification and Implementation Guide V1.02 (modbus.org, 2006).
"""

from collections.abc import Callable
from typing import TypeVar

import minimalmodbus
import serial

from hilcal.drivers.serial_line import drain
from hilcal.errors import DeviceError

T = TypeVar("T")
QUIET_S = 0.03
TRIES = 2
WRITE_MULTIPLE = 16


class NoAnswerError(DeviceError):
    """No sound answer came; `heard` is whether anything came at all."""

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
    return tuple(_ask(port, slave, lambda device: device.read_registers(address, count)))


def write_register(port: serial.Serial, slave: int, address: int, value: int) -> None:
    """Write one register; raises as `read_registers` does."""
    _ask(port, slave, lambda device: device.write_register(address, value, 0, WRITE_MULTIPLE))


def _ask(port: serial.Serial, slave: int, request: Callable[[minimalmodbus.Instrument], T]) -> T:
    heard = False
    device = minimalmodbus.Instrument(port, slave)
    for _ in range(TRIES):
        drain(port, QUIET_S, 4 * QUIET_S)
        try:
            return request(device)
        except minimalmodbus.SlaveReportedException as error:
            raise RefusedError(f"the request is refused ({error})") from None
        except minimalmodbus.NoResponseError:
            continue
        except minimalmodbus.ModbusException:
            heard = True
    raise NoAnswerError(heard)
