"""A TCP connection with one deadline for all its calls."""

import contextlib
import socket
import time
from collections.abc import Iterator
from typing import Self


class LinkError(Exception):
    """A connection failed; the text names it and the reason."""


class Connection:
    """An open connection; a call that does not end before the deadline raises LinkError."""

    def __init__(self, host: str, port: int, service: str, seconds: float) -> None:
        """Connect to a service (its name for errors); the deadline is `seconds` from now."""
        self._where = f"{service} (port {port})"
        self._seconds = seconds
        self._end = time.monotonic() + seconds
        self._buffer = b""
        with self._failures(host):
            self._socket = socket.create_connection((host, port), timeout=seconds)

    @contextlib.contextmanager
    def _failures(self, host: str = "") -> Iterator[None]:
        """Turn what the socket raises into LinkError."""
        try:
            yield
        except ConnectionRefusedError:
            raise LinkError(f"the {self._where} refuses the connection") from None
        except socket.gaierror:
            raise LinkError(f'the address "{host}" is unknown') from None
        except TimeoutError:
            late = f"does not answer within {self._seconds:g} s"
            raise LinkError(f"the {self._where} {late}") from None
        except OSError as error:
            raise LinkError(f"the {self._where}: {error.strerror or error}") from None

    def extend(self, seconds: float) -> None:
        """Set a new deadline, `seconds` from now."""
        self._seconds, self._end = seconds, time.monotonic() + seconds

    def send(self, data: bytes) -> None:
        """Send everything."""
        with self._failures():
            self._socket.settimeout(self._remaining())
            self._socket.sendall(data)

    def read(self, count: int) -> bytes:
        """Return exactly `count` bytes."""
        while len(self._buffer) < count:
            self._receive()
        out, self._buffer = self._buffer[:count], self._buffer[count:]
        return out

    def read_line(self) -> str:
        """Return the next line without its end."""
        while b"\n" not in self._buffer:
            if len(self._buffer) > 65536:
                raise LinkError(f"the {self._where} sends something else than lines")
            self._receive()
        line, _, self._buffer = self._buffer.partition(b"\n")
        return line.decode(errors="replace").strip()

    def close(self) -> None:
        """Close the connection, after up to 0.1 s for the other side to close it, too."""
        with contextlib.suppress(OSError), self._socket:
            self._socket.shutdown(socket.SHUT_WR)
            end = time.monotonic() + 0.1
            while (remaining := end - time.monotonic()) > 0:
                self._socket.settimeout(remaining)
                if not self._socket.recv(65536):
                    break

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _receive(self) -> None:
        with self._failures():
            self._socket.settimeout(self._remaining())
            data = self._socket.recv(65536)
        if not data:
            raise LinkError(f"the {self._where} closed the connection")
        self._buffer += data

    def _remaining(self) -> float:
        seconds = self._end - time.monotonic()
        if seconds <= 0:
            raise TimeoutError
        return seconds
