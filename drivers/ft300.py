"""Robotiq FT 300 and FT 300-S over serial: registers over Modbus RTU, then a stream.

Robotiq FT 300 Instruction Manual: 19200 Bd, slave 9, registers 500 firmware, 510 to 513 serial
number; 0x0200 in register 410 starts the stream of 100 frames per second; fifty bytes FF end the
stream. Frame: `20 4E`; six int16, N × 100 and N·m × 1000; CRC-16/MODBUS; all little-endian. A
streaming sensor answers no request; it streams on after the program that started it has died.
minimalmodbus makes the requests, on a line that may be noisy or streaming. Modbus over Serial Line,
Specification and Implementation Guide V1.02 (modbus.org, 2006).
"""

import contextlib
import termios
from collections.abc import Callable
from typing import TypeVar

import minimalmodbus
import numpy as np
import serial

from hilcal.config import CellConfig
from hilcal.drivers import force_stream as fs
from hilcal.drivers.force_stream import DEVICE
from hilcal.drivers.links import close_port, crc_modbus, drain, line_failures, open_port
from hilcal.errors import DeviceError, undone_by
from hilcal.measuring.devices import ForceSensorDevice
from hilcal.types import Floats

BAUD = 19200
SLAVE = 9
RATE_HZ = 100.0
FIRMWARE, SERIAL_NUMBER = (500, 6), (510, 4)
STREAM_REGISTER, STREAM = 410, 0x0200
STOP = b"\xff" * 50
RANGE = np.repeat((300.0, 30.0), 3)  # full scale, N and N·m
COMPONENTS = ("Fx", "Fy", "Fz", "Mx", "My", "Mz")
FIRST_FRAME_S = 0.5
T = TypeVar("T")
QUIET_S, TRIES, WRITE_MULTIPLE = 0.03, 2, 16


class NoAnswerError(DeviceError):
    """No valid answer came; `heard`: whether any bytes came."""

    def __init__(self, heard: bool) -> None:
        super().__init__("no answer")
        self.heard = heard


class RefusedError(DeviceError):
    """The device answered that it refuses the request."""


def read_registers(port: serial.Serial, address: int, count: int) -> tuple[int, ...]:
    """Return `count` holding registers (16 bits each) from `address` on."""
    return tuple(_ask(port, lambda device: device.read_registers(address, count)))


def start_stream(port: serial.Serial) -> None:
    """Start the stream; raises as `read_registers` does."""
    _ask(port, lambda device: device.write_register(STREAM_REGISTER, STREAM, 0, WRITE_MULTIPLE))


def _ask(port: serial.Serial, request: Callable[[minimalmodbus.Instrument], T]) -> T:
    heard = False
    device = minimalmodbus.Instrument(port, SLAVE)
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


def _overload(wrench: Floats, status: int) -> str:
    """What to report where a component is at the end of its range, else an empty string."""
    worst = int(np.argmax(np.abs(wrench) / RANGE))
    if abs(wrench[worst]) < 0.9999 * RANGE[worst]:
        return ""
    unit = "N" if worst < 3 else "N·m"
    return (
        f"the FT 300 is loaded over its range: {COMPONENTS[worst]} = {wrench[worst]:.4g} {unit} "
        f"of ±{RANGE[worst]:.0f} {unit}; take the load off"
    )


SENSOR = fs.SensorFormat(
    name="Robotiq FT 300",
    frame=fs.FrameFormat(b"\x20\x4e", 16, crc_modbus),
    body=np.dtype([("wrench", "<i2", 6)]),
    unit=1.0 / np.repeat((100.0, 1000.0), 3),
    losses=lambda: fs.ByArrival(RATE_HZ),
    overload=_overload,
)


def open_force_sensor(config: CellConfig) -> ForceSensorDevice:
    """Open the port of [force_sensor], identify the sensor, and start the stream."""
    section = fs.checked_config(config)
    path = fs.serial_port(section)
    port = open_port(DEVICE, path, section.baud or BAUD, timeout=0.1)
    with (
        undone_by(lambda: close_port(port)),
        undone_by(lambda: _stop(port)),
        line_failures(DEVICE, path),
    ):
        firmware, number = _start(port)
    name = f"{SENSOR.name}, serial number {number}"
    facts = (("firmware", firmware),)
    stream = fs.ForceStream(port, SENSOR, name, facts, before_close=lambda: _stop(port))
    return stream.started(FIRST_FRAME_S)


def _start(port: serial.Serial) -> tuple[str, str]:
    """Start the stream; return firmware and serial number."""
    heard = False
    for _ in range(2):
        port.write(STOP)  # it may still stream for a program that was killed
        drain(port, quiet=0.06, limit=0.25)
        try:
            firmware = _text(port, *FIRMWARE)
            number = _text(port, *SERIAL_NUMBER)
            start_stream(port)
            return firmware, number
        except NoAnswerError as error:
            heard = heard or error.heard
        except RefusedError as error:
            raise DeviceError(
                f"{DEVICE}: port {port.port}: it does not stream, {error}; is it an FT 300?"
            ) from None
    complaint = (
        "the bytes received are no answer; the rate is wrong, the line is disturbed, or it is no "
        "FT 300"
        if heard
        else "nobody answers; check the sensor's power, its cable and the rate"
    )
    raise DeviceError(f"{DEVICE}: port {port.port} at {port.baudrate} Bd: {complaint}")


def _text(port: serial.Serial, address: int, count: int) -> str:
    """Registers as text, two letters in each; as hexadecimal digits where they are not ASCII."""
    try:
        registers = read_registers(port, address, count)
    except RefusedError:
        return "unknown"
    data = b"".join(value.to_bytes(2, "big") for value in registers)
    text = data.rstrip(b"\0 ").decode("latin-1")
    return text if text and text.isascii() and text.isprintable() else data.hex()


def _stop(port: serial.Serial) -> None:
    """End the stream; never raises."""
    with contextlib.suppress(OSError, termios.error):
        port.write(STOP)
        port.flush()
