"""One GeoCOM exchange after another over a serial line that may do anything.

geocompy writes the requests and checks the replies; what it leaves open is settled here: a
reply without checksum is refused, whatever fails on the line is remembered, damaged exchanges
are repeated after the line has been drained, and every exchange has a deadline. geocompy never
raises from a request, and `bool` of its response is False for usable codes too, so only the
codes are looked at.
"""

import re
import termios
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import serial
from geocompy.communication import SerialConnection
from geocompy.geo import GeoCom

from hilcal.drivers.geocom_codes import BUSY, GARBLED, NULL, words
from hilcal.drivers.serial_line import close_port, drain, line_failures, open_port
from hilcal.errors import DeviceError

DEVICE = "tracker"
ANSWER_S = 1.0
"""How long an answer may take beside motors and measurements, real s."""
_FIRST_ANSWER_S = 0.7
_TRIES = 8
_PAUSE_S = 0.1
_QUIET_S, _DRAIN_S = 0.03, 0.4
_REPLY = re.compile(r"%R1P,(\d+),\d+,\d+:(\d+)(?:,.*)?$")
_UNPROTECTED = re.compile(rb"%R1P,\d+,\d+:\d+(,.*)?\r\n$")
_MISMATCH, _CLIENT_CHECKSUM = 3093, 3102


@dataclass(frozen=True, slots=True)
class Reply:
    """A reply whose checksum and transaction were right."""

    code: int  # the return code, of the line if that is not 0, else of the request
    values: tuple[Any, ...]
    """What came with it; empty where it is not of the form that was asked for."""
    host_ns: int  # `time.monotonic_ns` right after it came


class _Connection(SerialConnection):
    """geocompy's serial connection; remembers what came and what failed."""

    def __init__(self, port: serial.Serial) -> None:
        super().__init__(port)
        self.came = b""
        self.failure: Exception | None = None

    def exchange(self, cmd: str) -> str:
        """Send a request and return the reply, as geocompy asks for it."""
        self.came, self.failure = b"", None
        try:
            return super().exchange(cmd)
        except (OSError, termios.error, UnicodeDecodeError) as error:
            self.failure = error
            raise

    def receive_binary(self) -> bytes:
        """Return a line without its end; what came instead is kept in `came`."""
        self.came = self._port.read_until(self.eoabytes)
        if not self.came.endswith(self.eoabytes):
            raise TimeoutError
        return self.came.removesuffix(self.eoabytes)

    @property
    def broken(self) -> Exception | None:
        """What the port itself raised in the last exchange, if it did."""
        quiet = isinstance(self.failure, TimeoutError | UnicodeDecodeError)
        return None if quiet else self.failure


class Link:
    """A GeoCOM instrument at the other end of a serial port."""

    def __init__(self, path: str, baud: int) -> None:
        """Open the port for this program alone and see that an instrument answers.

        Raises:
            DeviceError: no port, port in use, or nobody answers in GeoCOM, within 5 s.
        """
        self._path, self._baud = path, baud
        self._port = open_port(DEVICE, path, baud, _FIRST_ANSWER_S)
        try:
            with line_failures(DEVICE, path):
                if not drain(self._port, _QUIET_S, _DRAIN_S):
                    raise DeviceError(
                        f"{DEVICE}: bytes keep coming from port {path} that nobody asked for; "
                        f"is another instrument connected there, or is {baud} Bd wrong?"
                    )
            self._connection = _Connection(self._port)
            self._instrument = self._greet()
        except BaseException:
            self.close()
            raise

    def ask(
        self,
        request: int,
        values: Sequence[int | float] = (),
        parsers: Sequence[Callable[[str], Any]] = (),
        *,
        until: float,
        seconds: float = ANSWER_S,
    ) -> Reply:
        """Send a request until it is answered without damage.

        `values` are its arguments, of which floats stay floats on the line; `parsers` one per value
        of the reply; `until` the deadline of all tries together, `time.monotonic` s; `seconds` how
        long one answer may take.

        Raises:
            DeviceError: the line is broken, mute or garbled; says which.
        """
        complaint, silent, damaged = "", 0, 0
        while damaged < _TRIES and time.monotonic() < until:
            answer, complaint = self._once(request, values, parsers, seconds, until)
            if answer is not None and answer.code not in BUSY:
                return answer
            if answer is not None:
                time.sleep(max(0.0, min(_PAUSE_S, until - time.monotonic())))
                continue
            damaged += 1
            if isinstance(self._connection.failure, TimeoutError):
                silent += 1
                if silent > 1 or self._mute(until):
                    break
        raise DeviceError(f"{DEVICE} at {self._path}: {complaint or 'no answer in time'}")

    def close(self) -> None:
        """Give the port back. Never raises, may be called twice."""
        close_port(self._port)

    def _greet(self) -> GeoCom:
        """Let geocompy make its acquaintance with the instrument."""
        with line_failures(DEVICE, self._path):
            try:
                return GeoCom(self._connection, attempts=2, checksum=True)
            except ConnectionRefusedError:
                self._raise_if_broken()
        raise DeviceError(f"{DEVICE} at {self._path}: {self._silence()}")

    def _once(
        self,
        request: int,
        values: Sequence[int | float],
        parsers: Sequence[Callable[[str], Any]],
        seconds: float,
        until: float,
    ) -> tuple[Reply | None, str]:
        """One exchange; a good answer, or the complaint about what came instead."""
        with line_failures(DEVICE, self._path):
            self._port.timeout = max(0.05, min(seconds, until - time.monotonic()))
            response = self._instrument.request(request, values, parsers)
            host_ns = time.monotonic_ns()
            self._raise_if_broken()
            reply = _REPLY.match(response.response)
            code = 0 if reply is None else int(reply[1]) or int(reply[2])
            local = int(response.error)  # geocompy's own finding, or the instrument's
            if (
                reply is not None
                and self._connection.failure is None
                and local not in (_MISMATCH, _CLIENT_CHECKSUM)
                and code not in GARBLED
            ):
                found = response.params
                several = found if isinstance(found, tuple) else (found,)
                return Reply(code, () if found is None else several, host_ns), words(code)
            drain(self._port, _QUIET_S, min(_DRAIN_S, max(0.0, until - time.monotonic())))
            self._connection.reset()
        if self._connection.failure is not None or reply is None:
            return None, self._silence()
        return None, f"answers stay damaged or out of step ({words(code or local)}); {self._hint()}"

    def _mute(self, until: float) -> bool:
        """Whether nothing comes to the simplest request either."""
        self._once(NULL, (), (), ANSWER_S, until)
        return isinstance(self._connection.failure, TimeoutError)

    def _raise_if_broken(self) -> None:
        if self._connection.broken is not None:
            raise self._connection.broken

    def _silence(self) -> str:
        came = self._connection.came
        if not came:
            return (
                f"no answer; is it switched on, connected there, and set to GeoCOM at "
                f"{self._baud} Bd?"
            )
        if _UNPROTECTED.match(came):
            return "it answers without checksum, so damage on the line would go unnoticed"
        if came.startswith(b"%R1P,"):
            return f"answers arrive damaged or cut short; {self._hint()}"
        return f"what comes is no GeoCOM; {self._hint()}"

    def _hint(self) -> str:
        return f"is {self._baud} Bd right, and does no other program use this port?"
