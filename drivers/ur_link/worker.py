"""The parent's side of a worker: a child process that may hang or crash without harm."""

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

_ROOT = Path(__file__).resolve().parents[2]


def environment() -> dict[str, str]:
    """Return the environment of a child process that has to import this very program."""
    path = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": f"{_ROOT}{os.pathsep}{path}" if path else str(_ROOT)}


class WorkerError(Exception):
    """A worker did not carry out a request; the text gives the reason.

    Attributes:
        lost: the process is gone (it crashed, or was ended because it did not answer).
    """

    def __init__(self, text: str, *, lost: bool) -> None:
        """Keep the cause."""
        super().__init__(text)
        self.lost = lost


class Worker:
    """A child process `python -m MODULE` that answers requests in JSON lines.

    It ends when this process ends, however that happens (see `child`). What the client library
    prints is dropped. Calls of several threads are taken one after the other.
    """

    def __init__(self, module: str, arguments: tuple[str, ...], seconds: float) -> None:
        """Start the process and wait until it reports that it is ready, for so many seconds.

        Raises:
            WorkerError: it did not get ready; it is gone.
        """
        self._lock = threading.RLock()
        self._number = 0
        self._buffer = b""
        self._socket, theirs = socket.socketpair()
        life, self._life = os.pipe()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-P", "-m", module, str(life), str(os.getpid()), *arguments],
                stdin=theirs.fileno(),
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
                pass_fds=(life,),
                env=environment(),
            )
        except OSError as error:
            self._let_go()
            raise WorkerError(f"cannot start a process ({error.strerror})", lost=True) from None
        finally:
            theirs.close()
            os.close(life)
        try:
            self._answer(0, time.monotonic() + seconds, seconds)
        except BaseException:
            self.kill()
            raise

    @property
    def pid(self) -> int:
        """Its process number."""
        return self._process.pid

    @property
    def alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def call(self, op: str, seconds: float, **arguments: Any) -> dict[str, Any]:
        """Return the answer to a request; a worker that does not answer in time is ended.

        Raises:
            WorkerError: refused, crashed or no answer in time.
        """
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
        self._let_go()

    def _answer(self, number: int, end: float, seconds: float) -> dict[str, Any]:
        while True:
            while b"\n" not in self._buffer:
                left = end - time.monotonic()
                try:
                    if left <= 0 or not select.select([self._socket], [], [], left)[0]:
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
            if answer["number"] != number:  # of a request whose caller was interrupted
                continue
            if "error" in answer:
                raise WorkerError(answer["error"], lost=False)
            return answer

    def _dead(self) -> WorkerError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        self.kill()
        code = self._process.returncode
        try:
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        except ValueError:
            how = f"exit code {code}"
        return WorkerError(how, lost=True)

    def _let_go(self) -> None:
        self._socket.close()
        if self._life >= 0:
            life, self._life = self._life, -1
            os.close(life)
