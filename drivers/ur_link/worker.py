"""A child process that may hang or crash without harm: first the parent's side, then the child's.

In the child the client library can hold the interpreter's lock for ever, so that no thread and no
signal handler in Python can notice the end of the parent. The kernel therefore ends the child: the
parent holds the writing end of a pipe on which nothing is sent; when the parent ends, in any way,
the pipe closes and SIGIO ends the child (fcntl(2), O_ASYNC; signal(7)). Unlike PR_SET_PDEATHSIG
this does not depend on the thread that started the child.
"""

import contextlib
import fcntl
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

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
    """A child process `python -m MODULE` that answers requests in JSON lines, one at a time.

    It ends with this process. Output of the client library is dropped.
    """

    def __init__(self, module: str, arguments: tuple[str, ...], seconds: float) -> None:
        """Start the process; wait at most `seconds` until it reports that it is ready."""
        self._lock = threading.RLock()
        self._number = 0
        self._buffer = b""
        self._socket, child_socket = socket.socketpair()
        life, self._life = os.pipe()
        try:
            self._process = subprocess.Popen(  # noqa: S603 - our own interpreter and module
                [sys.executable, "-P", "-m", module, str(life), str(os.getpid()), *arguments],
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
        try:
            self._answer(0, time.monotonic() + seconds, seconds)
        except BaseException:
            self.kill()
            raise

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
        try:
            how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
        except ValueError:
            how = f"exit code {code}"
        return WorkerError(how, lost=True)

    def _close(self) -> None:
        self._socket.close()
        if self._life >= 0:
            life, self._life = self._life, -1
            os.close(life)


_NICE = -10


def end_with_parent(life: int, parent: int) -> None:
    """End this process with the parent, whose end closes the pipe `life`; ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGIO})
    fcntl.fcntl(life, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(life, fcntl.F_SETFL, fcntl.fcntl(life, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([life], [], [], 0)[0] or os.getppid() != parent:
        os._exit(0)  # the parent has ended meanwhile


@contextlib.contextmanager
def outliving(seconds: float) -> Iterator[None]:
    """Finish an indivisible task although the parent ends meanwhile.

    The end of this process is postponed by at most `seconds`; then SIGALRM, which no lock delays,
    ends the process, finished or not.
    """
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGIO})
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGIO})


class Line:
    """Requests from the parent and answers, over the socket at standard input."""

    def __init__(self, parent: int) -> None:
        self._parent = parent
        self._socket = socket.socket(fileno=os.dup(sys.stdin.fileno()))
        self._buffer = b""

    def next(self, seconds: float) -> dict[str, Any] | None:
        """Return the next request, None if none comes in time; at the end of the line, exit."""
        while b"\n" not in self._buffer:
            if os.getppid() != self._parent:
                os._exit(0)
            if not select.select([self._socket], [], [], max(0.0, seconds))[0]:
                return None
            try:
                data = self._socket.recv(65536)
            except ConnectionError:
                data = b""
            if not data:
                os._exit(0)
            self._buffer += data
        request, _, self._buffer = self._buffer.partition(b"\n")
        out: dict[str, Any] = json.loads(request)
        return out

    def answer(self, number: int, **content: Any) -> None:
        """Answer the request with this number; 0 reports the start."""
        try:
            self._socket.sendall(json.dumps({"number": number, **content}).encode() + b"\n")
        except OSError:
            os._exit(0)


def answered(
    line: Line, request: dict[str, Any], do: Callable[[dict[str, Any]], dict[str, Any]]
) -> bool:
    """Answer a request with the result or the exception of `do`; return whether it succeeded."""
    try:
        result = do(request)
    except Exception as error:
        line.answer(request["number"], error=words(error))
        return False
    line.answer(request["number"], **result)
    return True


def words(error: BaseException) -> str:
    """Return an exception in one line."""
    text = " ".join(str(error).split())
    return text or type(error).__name__


def start() -> tuple[Line, list[str]]:
    """Set up a worker process; return the line to the parent and the other arguments."""
    life, parent = int(sys.argv[1]), int(sys.argv[2])
    end_with_parent(life, parent)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    return Line(parent), sys.argv[3:]
