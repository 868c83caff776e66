"""Whether the computers of a cell answer on the network."""

import socket
import time
from collections.abc import Mapping

from hilcal.doctor.finding import Finding

NETWORK = "network"
SECONDS = 1.0
"""How long an answer may take, s. A choice: on a cell's own network it takes a millisecond."""
SLOW = 0.02
"""Time of connecting that a controller in the same room never needs, s. A choice."""


def reachable(host: str, services: Mapping[int, str], seconds: float = SECONDS) -> list[Finding]:
    """Return whether each service of a host accepts a connection; nothing is sent.

    Args:
        host: name or address.
        services: what is reached there, by TCP port.
        seconds: how long each may take.
    """
    try:
        address = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)[0][4][0]
    except (OSError, UnicodeError) as error:
        mend = "check the address in the cell, or name the host in /etc/hosts"
        said = f"its name is not known ({getattr(error, 'strerror', None) or error})"
        return [Finding(NETWORK, host, "problem", said, mend)]
    out = []
    for port, what in services.items():
        name, begun = f"{what}, {host} port {port}", time.monotonic()
        try:
            with socket.create_connection((str(address), port), seconds):
                took = time.monotonic() - begun
        except TimeoutError:
            mend = "check cable, address and network of the cell; is the controller switched on?"
            out.append(Finding(NETWORK, name, "problem", f"no answer in {seconds:g} s", mend))
        except OSError as error:
            mend = "check the address, and that the service is enabled on the controller"
            out.append(Finding(NETWORK, name, "problem", f"{error.strerror or error}", mend))
        else:
            said = f"answers in {1e3 * took:.1f} ms"
            if took > SLOW:
                mend = "connect by cable, without other networks between"
                out.append(Finding(NETWORK, name, "warning", said, mend))
            else:
                out.append(Finding(NETWORK, name, "ok", said))
    return out
