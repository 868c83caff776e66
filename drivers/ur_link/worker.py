"""A child process that may hang or crash without harm: the parent's side, then the child's.

The client library can hold the interpreter's lock for ever, so that no thread and no handler in
Python can notice there that the parent is gone. Its end is therefore told by the kernel: the
parent holds the writing end of a pipe on which nothing is ever sent; when the parent ends,
however it ends, the pipe closes and SIGIO ends the child (fcntl(2), O_ASYNC; signal(7)). Unlike
PR_SET_PDEATHSIG this does not depend on the thread that started the child.
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
    """Return the environment of a child process that has to import this very program."""
    path = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": f"{_ROOT}{os.pathsep}{path}" if path else str(_ROOT)}


class WorkerError(Exception):
    """A worker did not carry out a request, and why; `lost`: the process is gone."""

    def __init__(self, text: str, *, lost: bool) -> None:
        super().__init__(text)
        self.lost = lost


class Worker:
    """A child process `python -m MODULE` that answers requests in JSON lines, one after the other.

    It ends when this process ends. What the client library prints is dropped.
    """

    def __init__(self, module: str, arguments: tuple[str, ...], seconds: float) -> None:
        """Start the process and wait until it reports that it is ready, for so many seconds."""
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


_NICE = -10


def end_with_parent(life: int, parent: int) -> None:
    """End this process when the parent ends, which closes the pipe `life`; never by Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGIO, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGIO})
    fcntl.fcntl(life, fcntl.F_SETOWN, os.getpid())
    fcntl.fcntl(life, fcntl.F_SETFL, fcntl.fcntl(life, fcntl.F_GETFL) | os.O_ASYNC)
    if select.select([life], [], [], 0)[0] or os.getppid() != parent:
        os._exit(0)  # it ended meanwhile


@contextlib.contextmanager
def outliving(seconds: float) -> Iterator[None]:
    """Finish what must not be left half done, also when the parent ends meanwhile.

    The end is put off for at most so many seconds; then SIGALRM, which no lock holds up either,
    ends the process whether it is done or not.
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
    """Requests from the parent and answers to it, over the socket that is standard input."""

    def __init__(self, parent: int) -> None:
        self._parent = parent
        self._socket = socket.socket(fileno=os.dup(sys.stdin.fileno()))
        self._buffer = b""

    def next(self, seconds: float) -> dict[str, Any] | None:
        """Return the next request, None if none came in time; ends the process at its end."""
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
        """Answer the request of that number; 0 is the answer to being started."""
        try:
            self._socket.sendall(json.dumps({"number": number, **content}).encode() + b"\n")
        except OSError:
            os._exit(0)


def answered(
    line: Line, request: dict[str, Any], do: Callable[[dict[str, Any]], dict[str, Any]]
) -> bool:
    """Answer a request by what `do` returns, or by what it raises; whether it was carried out."""
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
    """Begin a worker process; the line to the parent, and the other arguments."""
    life, parent = int(sys.argv[1]), int(sys.argv[2])
    end_with_parent(life, parent)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    return Line(parent), sys.argv[3:]
