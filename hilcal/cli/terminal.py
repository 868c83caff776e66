"""The terminal: tables or one JSON document on stdout, the rest on stderr; questions, signals."""

import contextlib
import json
import signal
import sys
import termios
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import TextIO

from rich.console import Console, RenderableType

from hilcal.cli import error_document
from hilcal.errors import HilcalError
from hilcal.identification.fit_document import with_nulls
from hilcal.present.progress import SafeConsole

WIDTH = 100


@dataclass(frozen=True, slots=True)
class Terminal:
    """The two streams."""

    json: bool  # whether stdout is for one JSON document
    people: Console  # for tables and sentences
    progress: Console  # for progress and notices
    out: TextIO  # for the document

    def show(self, parts: Iterable[RenderableType] | RenderableType) -> None:
        """Print for people."""
        if isinstance(parts, str) or not isinstance(parts, Iterable):
            parts = (parts,)
        for part in parts:
            self.people.print(part, markup=False, highlight=False)

    def notice(self, message: str) -> None:
        """Print a remark to stderr; a terminal wraps it between words."""
        self.progress.print(
            message, markup=False, highlight=False, soft_wrap=not self.progress.is_terminal
        )

    def command(self, line: str) -> None:
        """Print a command on one unwrapped line, to be copied."""
        self.people.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)

    def document(
        self,
        content: Mapping[str, object] | None = None,
        failed: HilcalError | None = None,
        /,
        **keys: object,
    ) -> None:
        """Print the JSON document, with --json; then raise `failed`, which is its part "error"."""
        document = {**(content or {}), **keys}
        if failed is not None:
            document |= error_document(failed, failed.exit_code)
        if self.json:
            text = json.dumps(with_nulls(document), allow_nan=False, indent=2)
            print(text, file=self.out, flush=True)
        if failed is not None:
            raise failed


def terminal(as_json: bool) -> Terminal:
    """Return the streams of a command.

    With `as_json`, `sys.stdout` becomes stderr until the command ends (see `hilcal.cli.execute`),
    so that output of a user's effect does not get into the document. Where both streams are a
    terminal they share a console, which prints above the line of progress.
    """
    progress, out = _console(sys.stderr), sys.stdout
    shared = as_json or (progress.is_terminal and out.isatty())
    people = progress if shared else _console(out)
    if as_json:
        sys.stdout = sys.stderr
    return Terminal(as_json, people, progress, out)


def _console(stream: TextIO) -> Console:
    """Return a console; 100 columns where the stream is not a terminal."""
    return SafeConsole(file=stream, width=None if stream.isatty() else WIDTH)


YES, NO = ("y", "yes"), ("n", "no", "q")


def person_present(t: Terminal) -> bool:
    """Whether a person sees questions and can answer them."""
    try:
        return t.progress.is_terminal and sys.stdin.isatty()
    except (AttributeError, ValueError):  # no standard input, or a closed one
        return False


def confirmed(t: Terminal, question: str) -> bool:
    """Ask until what is typed after the question is yes or no; the end of the input is no."""
    with contextlib.suppress(termios.error, OSError, ValueError):
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while True:
        t.progress.print(
            f"{question} y = yes, n = no: ", end="", markup=False, highlight=False, style="bold"
        )
        answer = sys.stdin.readline()
        if not answer:
            t.notice("")
            return False
        answer = answer.strip().lower()
        if answer in (*YES, *NO):
            return answer in YES
        t.notice(f"{answer!r} is not an answer. Type y or n, and press Enter.")


POLL = 0.2  # Longest delay of the reaction to a signal that does not interrupt the sleep, s


@contextmanager
def end_signals(*kinds: signal.Signals) -> Iterator[Callable[[], None]]:
    """Catch signals; yields a function that waits for the first of them.

    The handler runs in the waiting thread, so it must take no lock: `threading.Event.set` would
    deadlock inside `Event.wait`.
    """
    received: list[int] = []

    def wait() -> None:
        while not received:
            time.sleep(POLL)

    with handled(kinds, lambda number, _: received.append(number)):
        yield wait


@contextmanager
def handled(
    kinds: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]
) -> Iterator[None]:
    """Handle signals as long as the block lasts."""
    previous = {kind: signal.signal(kind, handler) for kind in kinds}
    try:
        yield
    finally:
        for kind, former in previous.items():
            signal.signal(kind, former)
