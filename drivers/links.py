"""Serial ports, their checksums, and network addresses; every failure becomes an error of one line.

Drivers read and write inside `with line_failures(device, path):` or `network_failures`. pyserial
reports an unplugged adapter as SerialException (read, write), OSError (in_waiting) or termios.error
(reset_input_buffer), which is not an OSError: all become DeviceError.
"""

import contextlib
import errno
import functools
import os
import re
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import serial

from hilcal.config.cell import Tracker
from hilcal.errors import DeviceError, InputError

BY_ID = Path("/dev/serial/by-id")
"""Where Linux lists serial adapters by names that replugging does not change."""


def open_port(device: str, path: str, baud: int, timeout: float = 0.5) -> serial.Serial:
    """Open a serial port, 8N1, raw, locked against other programs."""
    try:
        return serial.Serial(
            path, baud, timeout=timeout, write_timeout=max(timeout, 0.5), exclusive=True
        )
    except (OSError, termios.error) as error:
        raise DeviceError(f"{device}: {_opening_failure(path, error)}") from None
    except (ValueError, OverflowError):
        raise InputError(
            f"{device}: {baud} is no rate of port {path}; valid are e.g. 9600, 19200, 115200"
        ) from None


@contextlib.contextmanager
def line_failures(device: str, path: str) -> Iterator[None]:
    """Turn what pyserial and termios raise on a broken line into DeviceError."""
    try:
        yield
    except serial.SerialTimeoutException:
        raise DeviceError(
            f"{device}: port {path} takes no more bytes; check cable and power"
        ) from None
    except (OSError, termios.error) as error:
        raise DeviceError(f"{device}: {_line_failure(path, error)}") from None


def drain(port: serial.Serial, quiet: float, limit: float) -> bool:
    """Discard input until the line has been quiet for `quiet` s; return False after `limit` s."""
    now = time.monotonic()
    end, quiet_since = now + limit, now
    while now < end:
        waiting = port.in_waiting
        if waiting:
            port.read(waiting)
            quiet_since = time.monotonic()
        elif now - quiet_since >= quiet:
            return True
        time.sleep(min(0.005, quiet))
        now = time.monotonic()
    return False


def close_port(port: Any) -> None:
    """Close the port in whatever state it is. Never raises; may be called twice."""
    with contextlib.suppress(OSError, termios.error):
        port.close()


def _opening_failure(path: str, error: Exception) -> str:
    number = getattr(error, "errno", None)
    if number in (errno.EAGAIN, errno.EBUSY):
        return f"port {path} is in use by another program; end that one, then try again"
    if number in (errno.EACCES, errno.EPERM):
        return f"no right to use port {path}; add the user to the group that owns it (dialout)"
    if number in (errno.ENOENT, errno.ENODEV, errno.ENXIO):
        return f"there is no port {path}; is its adapter plugged in? {_ports()}"
    if number == errno.EIO:
        return f"port {path} does not work (input/output error); replug its adapter"
    if number in (errno.EISDIR, errno.ENOTTY, errno.EINVAL) or not Path(path).is_char_device():
        return f"{path} is not a serial port; {_ports()}"
    return f"port {path} cannot be opened ({os.strerror(number) if number else error})"


def _line_failure(path: str, error: Exception) -> str:
    if not os.path.exists(path):
        return f"port {path} is gone; was its adapter unplugged?"
    number = error.args[0] if isinstance(error, termios.error) else getattr(error, "errno", None)
    if number in (errno.EIO, errno.ENXIO, errno.ENODEV, None):
        return f"port {path} was lost; was its adapter unplugged, or does a second program read it?"
    return f"port {path} failed ({os.strerror(number)})"


def _ports() -> str:
    """Names of the adapters that are plugged in, for a message."""
    names = sorted(map(str, BY_ID.iterdir())) if BY_ID.is_dir() else []
    return f"plugged in: {', '.join(names[:4])}" if names else f"{BY_ID} lists no adapter"


@functools.cache
def _table(polynomial: int) -> tuple[int, ...]:
    """Return the remainders of the 256 values of a byte."""
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (polynomial if value & 1 else 0)
        table.append(value)
    return tuple(table)


def crc16(data: bytes, start: int = 0, polynomial: int = 0xA001) -> int:
    """Return the CRC-16 with a reflected polynomial, byte by byte; the defaults give CRC-16/ARC."""
    crc, table = start, _table(polynomial)
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return crc


def crc_modbus(data: bytes) -> bytes:
    """Return the two bytes of CRC-16/MODBUS: initial value FFFF."""
    return crc16(data, 0xFFFF).to_bytes(2, "little")


def crc_x25(data: bytes) -> bytes:
    """Return the two bytes of CRC-16/X-25: polynomial 1021, initial value FFFF, inverted."""
    return (crc16(data, 0xFFFF, 0x8408) ^ 0xFFFF).to_bytes(2, "little")


_ADDRESS = re.compile(r"([\w.-]+)(?::(\d{1,5}))?")


def address(section: str, driver: str, host: str | None, port: int) -> tuple[str, int]:
    """Split `host`, "address" or "address:port"; `port` is the default."""
    if host is None:
        raise InputError(
            f'{section} driver = "{driver}" lacks "host": the address of the instrument in the '
            f'network, e.g. "192.168.0.1" (port {port}) or "192.168.0.1:{port}"'
        )
    match = _ADDRESS.fullmatch(host)
    if match is None or not 0 < int(match[2] or port) < 1 << 16:
        raise InputError(
            f'{section} host = "{host}" is no address; valid: e.g. "192.168.0.1" (port {port}) or '
            f'"192.168.0.1:{port}"'
        )
    return match[1], int(match[2] or port)


@contextlib.contextmanager
def network_failures(device: str, where: str) -> Iterator[None]:
    """Turn what sockets raise into DeviceError."""
    try:
        yield
    except TimeoutError:
        raise DeviceError(
            f"{device} at {where}: no answer; is it switched on, in this network, and not busy?"
        ) from None
    except ConnectionRefusedError:
        raise DeviceError(
            f"{device} at {where}: it refuses the connection; is this its address and its port?"
        ) from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise DeviceError(f"{device} at {where}: the connection failed ({reason})") from None


def check_tracker_frame(tracker: Tracker) -> None:
    """Refuse any [tracker] frame but "tracker": the instrument measures in its own axes."""
    if tracker.frame != "tracker":
        raise InputError(
            f'[tracker] frame = "{tracker.frame}": this instrument measures in its own axes; it '
            'must be "tracker"'
        )
