"""A child process that may hang or crash without harm; the other side is `children`."""

import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from hilcal.errors import undone_by

_ROOT = Path(__file__).resolve().parents[2]


def environment() -> dict[str, str]:
    """Return the environment of a child process that imports this installation of hilcal."""
    path = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": f"{_ROOT}{os.pathsep}{path}" if path else str(_ROOT)}


class WorkerError(Exception):
    """Why a worker did not carry out a request; `lost`: the process has ended."""

    def __init__(self, text: str, *, lost: bool) -> None:
        super().__init__(text)
        self.lost = lost


class Worker:
    """A child process of a kind that answers requests in JSON lines, one at a time.

    It ends with this process. Output of the client library is dropped.
    """

    def __init__(self, kind: str, arguments: tuple[str, ...], seconds: float) -> None:
        """Start the process; wait at most `seconds` until it reports that it is ready."""
        self._lock = threading.RLock()
        self._number = 0
        self._buffer = b""
        self._socket, child_socket = socket.socketpair()
        life, self._life = os.pipe()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [
                    *(sys.executable, "-P", "-m", "hilcal.drivers.ur_link.children"),
                    *(str(life), str(os.getpid()), kind, *arguments),
                ],
                stdin=child_socket.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(life,),
                env=environment(),
            )
        except OSError as error:
            self._close()
            raise WorkerError(f"cannot start a process ({error.strerror})", lost=True) from None
        finally:
            child_socket.close()
            os.close(life)
        with undone_by(self.kill):
            self._answer(0, time.monotonic() + seconds, seconds)

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    def call(self, op: str, seconds: float, **arguments: Any) -> dict[str, Any]:
        """Return the answer to a request; a worker that does not answer in time is ended."""
        end = time.monotonic() + seconds
        if not self._lock.acquire(timeout=seconds):
            raise WorkerError(f"busy for {seconds:g} s", lost=False)
        try:
            self._number += 1
            request = {"number": self._number, "op": op, **arguments}
            try:
                self._socket.sendall(json.dumps(request).encode() + b"\n")
            except OSError:
                raise self._dead() from None
            return self._answer(self._number, end, seconds)
        finally:
            self._lock.release()

    def kill(self) -> None:
        """End the process at once; may be called twice."""
        if self._process.poll() is None:
            self._process.kill()
        self._process.wait()
        self._close()

    def _answer(self, number: int, end: float, seconds: float) -> dict[str, Any]:
        while True:
            while b"\n" not in self._buffer:
                remaining = end - time.monotonic()
                try:
                    if remaining <= 0 or not select.select([self._socket], [], [], remaining)[0]:
                        self.kill()
                        raise WorkerError(f"no answer within {seconds:g} s", lost=True)
                    data = self._socket.recv(65536)
                except (OSError, ValueError):  # reset, or closed by another thread
                    data = b""
                if not data:
                    raise self._dead()
                self._buffer += data
            line, _, self._buffer = self._buffer.partition(b"\n")
            answer: dict[str, Any] = json.loads(line)
            if answer["number"] != number:  # answers a request whose caller was interrupted
                continue
            if "error" in answer:
                raise WorkerError(answer["error"], lost=False)
            return answer

    def _dead(self) -> WorkerError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        self.kill()
        code = self._process.returncode
        by = next((s.name for s in signal.Signals if s == -code), None)
        return WorkerError(f"killed by {by}" if by else f"exit code {code}", lost=True)

    def _close(self) -> None:
        self._socket.close()
        if self._life >= 0:
            life, self._life = self._life, -1
            os.close(life)
