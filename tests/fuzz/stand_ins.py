"""What stands in for clocks, ports and sockets: it gives some bytes and never waits."""

from random import Random
from typing import Any

from tests.fuzz.damage import NUMBERS


class Time:
    """A clock that advances when it is read: deadlines pass without waiting."""

    def __init__(self) -> None:
        self.now = 0.0

    def monotonic(self) -> float:
        self.now += 1e-3
        return self.now

    def monotonic_ns(self) -> int:
        return int(1e9 * self.monotonic())

    def sleep(self, seconds: float) -> None:
        self.now += max(0.0, seconds)


class Port:
    """A serial port that holds some bytes and then is silent."""

    is_open, baudrate, timeout, port, in_waiting = True, 115200, 0.1, "fuzz", 0

    def __init__(self) -> None:
        self.held = b""

    def read(self, count: int = 1) -> bytes:
        out, self.held = self.held[:count], self.held[count:]
        return out

    def read_until(self, end: bytes) -> bytes:
        out, sep, self.held = self.held.partition(end)
        return out + sep

    def write(self, data: bytes) -> int:
        return len(data)

    def open(self) -> None: ...
    def close(self) -> None: ...
    def flush(self) -> None: ...
    def reset_input_buffer(self) -> None: ...
    def reset_output_buffer(self) -> None: ...


class Socket:
    """A connection that gives some bytes in pieces and then closes."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def recv(self, count: int) -> bytes:
        out, self._data = self._data[:count], self._data[count:]
        return out

    def settimeout(self, seconds: float) -> None: ...
    def sendall(self, data: bytes) -> None: ...
    def shutdown(self, how: int) -> None: ...
    def __enter__(self) -> "Socket":
        return self

    def __exit__(self, *_: object) -> None: ...


def finite(rng: Random) -> float:
    value = rng.choice(NUMBERS)
    return float(value) if rng.random() < 0.5 else rng.uniform(-1e3, 1e3)


class instead:
    """Puts other names into a module for a while."""

    def __init__(self, module: Any, names: dict[str, Any]) -> None:
        self._module, self._names = module, names

    def __enter__(self) -> None:
        self._before = {name: getattr(self._module, name) for name in self._names}
        self._module.__dict__.update(self._names)

    def __exit__(self, *_: object) -> None:
        self._module.__dict__.update(self._before)
