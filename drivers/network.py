"""What the drivers of instruments in a network share: addresses, and failures as one clear line."""

import contextlib
import re
from collections.abc import Iterator

from hilcal.config.cell import Tracker
from hilcal.errors import DeviceError, InputError

_ADDRESS = re.compile(r"([\w.-]+)(?::(\d{1,5}))?")


def address(section: str, driver: str, host: str | None, port: int) -> tuple[str, int]:
    """Return the host and the port of an instrument: "address" or "address:port".

    Raises:
        InputError: the address is missing, or none.
    """
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
    """Turn what sockets raise into DeviceError.

    Raises:
        DeviceError: no answer in time, refused, or the connection failed.
    """
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
        said = error.strerror or str(error)
        raise DeviceError(f"{device} at {where}: the connection failed ({said})") from None


def own_axes(tracker: Tracker, driver: str, port: int) -> tuple[str, int]:
    """Return host and port of a tracker that measures in its own axes.

    Raises:
        InputError: [tracker] lacks the host, or states another frame.
    """
    found = address("[tracker]", driver, tracker.host, port)
    if tracker.frame != "tracker":
        raise InputError(
            f'[tracker] frame = "{tracker.frame}": this instrument measures in its own axes; it '
            'must be "tracker"'
        )
    return found
