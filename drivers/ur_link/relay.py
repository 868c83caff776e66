"""Process between ur_rtde and PolyScope X that sends programs to the primary port.

    python -m hilcal.drivers.ur_link.relay HOST

ur_rtde sends its program to port 30003 only, which PolyScope X does not open. The primary port,
30001, takes the same programs, but also sends the robot's state, which ur_rtde does not read. So
ur_rtde is given an address of this computer: port 30004 there leads to the controller's 30004, port
30003 to its 30001, and the state is dropped. Prints this address; ends with its parent.
"""

import contextlib
import os
import secrets
import select
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

from hilcal.drivers.ur_link.probe import LinkError

_RTDE, _REALTIME, _PRIMARY = 30004, 30003, 30001
_TRIES = 50
_CONNECT_S = 2.0
_READY_S = 3.0
_CHUNK = 65536


def start(host: str) -> tuple[subprocess.Popen[str], str]:
    """Start a relay, which ends with this process; return the process and the address to use."""
    process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
        [sys.executable, "-P", "-m", "hilcal.drivers.ur_link.relay", host],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None  # noqa: S101 - for the type checker
    # No thread: it would receive the signal that the worker blocks, see `outliving`.
    ready = select.select([process.stdout], [], [], _READY_S)[0]
    address = process.stdout.readline().strip() if ready else ""
    if not address:
        process.kill()
        raise LinkError("no address of this computer is free for the primary port's programs")
    return process, address


def _pump(source: socket.socket, sink: Callable[[bytes], Any], peer: socket.socket) -> None:
    """Pass data on until one side ends, then shut down both."""
    with contextlib.suppress(OSError):
        while data := source.recv(_CHUNK):
            sink(data)
    for line in (source, peer):
        with contextlib.suppress(OSError):
            line.shutdown(socket.SHUT_RDWR)


def _join(client: socket.socket, host: str, port: int) -> None:
    with contextlib.ExitStack() as stack, contextlib.suppress(OSError):
        stack.enter_context(client)
        server = stack.enter_context(socket.create_connection((host, port), timeout=_CONNECT_S))
        server.settimeout(None)
        for line in (client, server):
            line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        back = (lambda data: None) if port == _PRIMARY else client.sendall
        answers = threading.Thread(target=_pump, args=(server, back, client), daemon=True)
        answers.start()
        _pump(client, server.sendall, server)
        answers.join()


def _accept(door: socket.socket, host: str, port: int) -> None:
    while True:
        client, _ = door.accept()
        threading.Thread(target=_join, args=(client, host, port), daemon=True).start()


def _doors() -> tuple[str, list[socket.socket]]:
    """Return a loopback address where both ports are free, and the listening sockets."""
    for _ in range(_TRIES):
        parts = [str(secrets.randbelow(254) + 1) for _ in range(3)]
        address, doors = ".".join(["127", *parts]), []
        try:
            for port in (_RTDE, _REALTIME):
                door = socket.socket()
                doors.append(door)
                door.bind((address, port))
                door.listen()
        except OSError:
            for door in doors:
                door.close()
        else:
            return address, doors
    return "", []


def main() -> None:
    """Listen, print the address, and pass data on until the parent ends."""
    host = sys.argv[1]
    address, doors = _doors()
    for door, port in zip(doors, (_RTDE, _PRIMARY), strict=False):
        threading.Thread(target=_accept, args=(door, host, port), daemon=True).start()
    sys.stdout.write(f"{address}\n")
    sys.stdout.flush()
    if doors:
        sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    main()
