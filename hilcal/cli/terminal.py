"""The terminal: tables or one JSON document on stdout, all else on stderr; questions, signals."""

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
from hilcal.identification.fit_document import plain
from hilcal.present.progress import SafeConsole

WIDTH = 100


@dataclass(frozen=True, slots=True)
class Terminal:
    """The two streams."""

    json: bool  # whether stdout is for one JSON document
    people: Console  # where tables and words for people go
    progress: Console  # where progress and notices go
    out: TextIO  # where the document goes

    def show(self, parts: Iterable[RenderableType] | RenderableType) -> None:
        """Print for people."""
        if isinstance(parts, str) or not isinstance(parts, Iterable):
            parts = (parts,)
        for part in parts:
            self.people.print(part, markup=False, highlight=False)

    def notice(self, words: str) -> None:
        """Say what people should know but did not ask for; broken between words on a terminal."""
        whole = not self.progress.is_terminal
        self.progress.print(words, markup=False, highlight=False, soft_wrap=whole)

    def command(self, line: str) -> None:
        """Print a command on a line of its own, which no line's end divides, to be copied."""
        self.people.print(f"  {line}", markup=False, highlight=False, soft_wrap=True)

    def document(
        self,
        content: Mapping[str, object] | None = None,
        failed: HilcalError | None = None,
        /,
        **keys: object,
    ) -> None:
        """Print the JSON document, where it is asked for.

        With `failed`, why the command fails nevertheless, which is in the document as "error" and
        raised after printing.
        """
        whole = {**(content or {}), **keys}
        if failed is not None:
            whole |= error_document(failed, failed.exit_code)
        if self.json:
            print(json.dumps(plain(whole), allow_nan=False, indent=2), file=self.out, flush=True)
        if failed is not None:
            raise failed


def terminal(as_json: bool) -> Terminal:
    """Return the streams of a command.

    With `as_json`, `sys.stdout` becomes stderr until the command ends, see `hilcal.cli.execute`:
    what a user's effect prints must not be in the document. Where both are a terminal they are one
    console, which prints above what is in progress, not into its line.
    """
    progress, out = _console(sys.stderr), sys.stdout
    one = as_json or (progress.is_terminal and out.isatty())
    people = progress if one else _console(out)
    if as_json:
        sys.stdout = sys.stderr
    return Terminal(as_json, people, progress, out)


def _console(stream: TextIO) -> Console:
    """Return a console; 100 columns where the stream is not a terminal."""
    return SafeConsole(file=stream, width=None if stream.isatty() else WIDTH)


YES, NO = ("y", "yes"), ("n", "no", "q")


def somebody_there(t: Terminal) -> bool:
    """Whether a person sees questions and can answer them."""
    try:
        return t.progress.is_terminal and sys.stdin.isatty()
    except (AttributeError, ValueError):  # no standard input, or a closed one
        return False


def agreed(t: Terminal, question: str) -> bool:
    """Ask until the answer is yes or no; the end of the input is no.

    What was typed before the question is dropped.
    """
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
        if answer in YES:
            return True
        if answer in NO:
            return False
        t.notice(f"{answer!r} is no answer. Type y or n, and press Enter.")


POLL = 0.2  # How long a plea to end may stay unheard where a signal does not wake the sleeper, s


@contextmanager
def told_to_end(*kinds: signal.Signals) -> Iterator[Callable[[], None]]:
    """Catch signals; what is yielded waits for the first of them.

    A handler runs between two instructions of the very thread that waits, so it must take no lock:
    `threading.Event.set` would wait for ever where the thread is just inside `Event.wait`.
    """
    asked: list[int] = []

    def wait() -> None:
        while not asked:
            time.sleep(POLL)

    with handled(kinds, lambda number, _: asked.append(number)):
        yield wait


@contextmanager
def handled(
    kinds: Iterable[signal.Signals], handler: Callable[[int, FrameType | None], object]
) -> Iterator[None]:
    """Handle signals as long as the block lasts."""
    before = {kind: signal.signal(kind, handler) for kind in kinds}
    try:
        yield
    finally:
        for kind, earlier in before.items():
            signal.signal(kind, earlier)
