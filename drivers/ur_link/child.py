"""The child's side of a worker: ends with its parent, answers requests in JSON lines.

The client library can hold the interpreter's lock for ever, so no thread and no handler in
Python can notice there that the parent is gone. Its end is therefore told by the kernel: the
parent holds the writing end of a pipe on which nothing is ever sent; when the parent ends,
however it ends, the pipe closes and SIGIO ends this process (fcntl(2), O_ASYNC; signal(7)).
Unlike PR_SET_PDEATHSIG this does not depend on the thread that started the child.
"""

import contextlib
import fcntl
import json
import os
import select
import signal
import socket
import sys
from collections.abc import Callable, Iterator
from typing import Any

_NICE = -10


def end_with_parent(life: int, parent: int) -> None:
    """End this process when the parent ends; Ctrl-C is for the parent alone.

    `life` is the file descriptor of the reading end of the parent's pipe, `parent` its number.
    """
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
        """Take over standard input."""
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
    """Begin a worker process; returns the line to the parent and the other arguments.

    Where it is allowed, the process and its later threads go before others: it needs little
    time, but in time.
    """
    life, parent = int(sys.argv[1]), int(sys.argv[2])
    end_with_parent(life, parent)
    with contextlib.suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, _NICE)
    return Line(parent), sys.argv[3:]
