"""A serial port opened for this program alone; whatever goes wrong is one clear line.

For a driver: `port = open_port("tracker", path, 19200)`, then every read and write inside
`with line_failures("tracker", path):`. pyserial reports an unplugged adapter as
SerialException (read, write), OSError (in_waiting) or termios.error (reset_input_buffer), the
last of which is not an OSError; all of them become DeviceError here.
"""

import contextlib
import errno
import os
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Protocol

import serial

from hilcal.errors import DeviceError, InputError

BY_ID = Path("/dev/serial/by-id")
"""Where Linux lists serial adapters by names that do not change when they are replugged."""


def open_port(device: str, path: str, baud: int, timeout: float = 0.5) -> serial.Serial:
    """Open a serial port, 8N1, raw, locked against every other program that asks.

    `device` is its part in the cell, for messages; `baud` the rate, Bd; `timeout` of reads and
    writes, s.

    Raises:
        DeviceError: there is no such port, it is in use by another program, may not be used, or
            is no serial port; the line names the port and what to do.
        InputError: no port has this rate.
    """
    try:
        return serial.Serial(
            path, baud, timeout=timeout, write_timeout=max(timeout, 0.5), exclusive=True
        )
    except (OSError, termios.error) as error:
        raise DeviceError(f"{device}: {_why_not_open(path, error)}") from None
    except (ValueError, OverflowError):
        raise InputError(
            f"{device}: {baud} is no rate of port {path}; valid are e.g. 9600, 19200, 115200"
        ) from None


@contextlib.contextmanager
def line_failures(device: str, path: str) -> Iterator[None]:
    """Turn whatever pyserial and termios raise on a broken line into DeviceError.

    Raises:
        DeviceError: the adapter is gone, or the port failed otherwise.
    """
    try:
        yield
    except serial.SerialTimeoutException:
        raise DeviceError(
            f"{device}: port {path} takes no more bytes; check cable and power"
        ) from None
    except (OSError, termios.error) as error:
        raise DeviceError(f"{device}: {_why_broken(path, error)}") from None


def drain(port: serial.Serial, quiet: float, limit: float) -> bool:
    """Throw away what comes until the line has been quiet for so long, s; False after `limit` s."""
    now = time.monotonic()
    end, still_since = now + limit, now
    while now < end:
        waiting = port.in_waiting
        if waiting:
            port.read(waiting)
            still_since = time.monotonic()
        elif now - still_since >= quiet:
            return True
        time.sleep(min(0.005, quiet))
        now = time.monotonic()
    return False


class Closable(Protocol):
    """What can be closed."""

    def close(self) -> None:
        """Close it."""


def close_port(port: Closable) -> None:
    """Give the port back, whatever state it is in. Never raises, may be called twice."""
    with contextlib.suppress(OSError, termios.error):
        port.close()


def _why_not_open(path: str, error: Exception) -> str:
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


def _why_broken(path: str, error: Exception) -> str:
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
