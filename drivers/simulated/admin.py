"""Common parts of the processes of simulated devices: admin line, and ending with the parent.

The admin line, for faults and tests, takes JSON lines over a Unix socket.
"""

import argparse
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NoReturn

from hilcal.errors import DeviceError, HilcalError

Handler = Callable[[str, dict[str, Any]], Any]

PRIORITY = -10
"""Niceness of a started device, where the system permits it. Without it, a device on a busy
computer runs up to 0.1 s late; a driver counts an arm as lost after 0.2 s."""


def ask(path: Path, op: str, timeout: float = 5.0, **arguments: Any) -> Any:
    """Send one request to the simulated device behind `path` and return its answer."""
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line:
            line.settimeout(timeout)
            line.connect(str(path))
            line.sendall(json.dumps({"op": op, **arguments}).encode() + b"\n")
            with line.makefile("rb") as stream:
                answer = json.loads(stream.readline() or b'{"error": "closed without an answer"}')
    except (OSError, ValueError) as error:
        raise DeviceError(f"simulated device at {path.name}: {error}") from None
    if "error" in answer:
        raise DeviceError(f"simulated device at {path.name}: {answer['error']}")
    return answer["result"]


def serve(path: Path, handler: Handler) -> None:
    """Answer requests in a daemon thread; `handler(op, arguments)` returns a value for JSON.

    An exception is returned to the client. The socket file appears only when it answers.
    """
    new = path.with_name(path.name + ".new")
    new.unlink(missing_ok=True)
    server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    server.bind(str(new))
    new.chmod(0o600)  # for this user only; a bound socket does not answer yet
    server.listen(16)
    os.replace(new, path)

    def talk(line: socket.socket) -> None:
        with line, line.makefile("rwb") as stream:
            for request in stream:
                try:
                    arguments = json.loads(request)
                    result = handler(str(arguments.pop("op")), arguments)
                    answer = {"result": result}
                except Exception as error:  # any failure is reported to the client
                    answer = {"error": f"{type(error).__name__}: {error}"}
                try:
                    stream.write(json.dumps(answer).encode() + b"\n")
                    stream.flush()
                except OSError:
                    return

    def listen() -> None:
        while True:
            line, _ = server.accept()
            threading.Thread(target=talk, args=(line,), daemon=True).start()

    threading.Thread(target=listen, daemon=True).start()


class Operations:
    """The operations of a device: functions by name, with named arguments.

    A result None is answered with the state. `die` ends the process at once, like a crash.
    """

    def __init__(
        self, functions: Mapping[str, Callable[..., Any]], state: Callable[[], Any] | None = None
    ) -> None:
        self._state = state or (lambda: None)
        self.functions = {**functions, "die": threading.Timer(0.02, os._exit, (70,)).start}
        if state is not None:
            self.functions["state"] = state

    def __call__(self, op: str, arguments: dict[str, Any]) -> Any:
        """Carry out an operation."""
        if op not in self.functions:
            raise ValueError(f"unknown op {op!r}; valid: {', '.join(self.functions)}")
        result = self.functions[op](**arguments)
        return self._state() if result is None else result


def setter(target: object, name: str, kind: Callable[[Any], Any] = bool) -> Callable[..., None]:
    """Return the operation that sets an attribute to its single argument, of any name, or True."""

    def store(**arguments: Any) -> None:
        (value,) = arguments.values() or (True,)
        setattr(target, name, kind(value))

    return store


NETWORK: dict[str, dict[str, Any]] = {"--host": {"required": True}, "--port": {"type": int}}
NOISE: dict[str, dict[str, Any]] = {
    f"--{name}-std": {"type": float, "nargs": 2, "required": True}
    for name in ("range", "transverse")
}


Arguments = argparse.Namespace
Device = tuple[Handler, Callable[[], None]]
"""The operations of a device, and the step that it repeats."""


def run(
    doc: str | None,
    name: str,
    start: Callable[[Arguments], Device],
    options: Mapping[str, dict[str, Any]] | None = None,
) -> NoReturn:
    """Run the process of a device; its admin line is DIR/NAME.sock.

    It ends at once when standard input closes, whose other end the parent holds. `options`:
    arguments of `add_argument` by option. `start` makes the device from the parsed options; if it
    cannot, the process ends with the error's exit code.
    """
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--directory", type=Path, required=True, help="where the devices meet")
    parser.add_argument("--seed", type=int, default=0, help="of everything random")
    for option, keywords in (options or {}).items():
        parser.add_argument(option, **keywords)
    parsed = parser.parse_args()

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        os._exit(0)

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent only
    threading.Thread(target=wait, daemon=True).start()
    try:
        handler, step = start(parsed)
    except HilcalError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(error.exit_code)
    serve(parsed.directory / f"{name}.sock", handler)
    with suppress(PermissionError):  # a device never waits for a computer's other programs
        os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
    while True:
        step()
