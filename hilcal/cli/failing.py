"""Telling why a command failed: one line for people, one document for scripts."""

import json
import re
import shutil
import sys
import textwrap
import traceback
from dataclasses import dataclass
from typing import Any, TextIO

from hilcal.errors import (
    CannotAnswerError,
    DeviceError,
    HilcalError,
    InputError,
    LimitError,
    StoppedError,
)
from hilcal.names import escaped

_COMMAND = re.compile(r"(.*:) (hilcal [^,;()]*)$")
_KINDS = {
    InputError.exit_code: "input",
    DeviceError.exit_code: "device",
    CannotAnswerError.exit_code: "cannot_answer",
    LimitError.exit_code: "limit",
    StoppedError.exit_code: "interrupted",
}


def error_document(error: HilcalError) -> dict[str, object]:
    """Return an error as a command's document holds it."""
    return _document(escaped(" ".join(str(error).split())), error.exit_code)


def _document(line: str, code: int) -> dict[str, object]:
    kind = _KINDS.get(code, "unexpected")
    return {"error": {"message": line, "kind": kind, "exit_code": code}}


class Watched:
    """A stream that knows whether anything was written to it."""

    def __init__(self, stream: TextIO) -> None:
        """Stand before a stream; everything but `write` is the stream's own."""
        self.written = False
        self._stream = stream

    def write(self, text: str) -> int:
        """Write, and take note."""
        self.written = self.written or bool(text)
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        """Return what the stream has."""
        return getattr(self._stream, name)


@dataclass(frozen=True, slots=True)
class Failures:
    """Tells people, and with --json scripts, why a command failed."""

    as_json: bool
    out: Watched  # where the document goes
    debug: bool  # whether people want to know more

    def tell(self, error: BaseException | None, message: str, code: int) -> int:
        """Say what failed in one line, and in one document; returns the exit code."""
        if self.debug and error is not None:
            traceback.print_exception(error)
        line = escaped(" ".join(message.split()))
        print(_laid_out(f"error: {line}"), file=sys.stderr)
        if self.as_json and not self.out.written:
            self.out.write(json.dumps(_document(line, code), indent=2) + "\n")
            self.out.flush()
        return code


def _laid_out(line: str) -> str:
    """Return a line as people read it: on a terminal broken between words.

    A command at its end has a line of its own there, to be copied as it stands.
    """
    if not sys.stderr.isatty():
        return line
    found = _COMMAND.match(line)
    words, command = found.groups() if found else (line, "")
    width = shutil.get_terminal_size().columns
    wrap = textwrap.TextWrapper(
        width, subsequent_indent="  ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join((*wrap.wrap(words), *([f"  {command}"] if command else ())))
