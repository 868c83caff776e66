"""The command as it was typed, kept with what it makes: a campaign file, a revision.

The command line sets it for as long as a command works; programs that import the library have none.
"""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

COMMAND = "command"
"""Key of the command, among what a file says of itself and among the options of a revision."""
_typed: ContextVar[str | None] = ContextVar("typed", default=None)


@contextmanager
def typed(words: Sequence[str]) -> Iterator[None]:
    """Let what the block makes be said to be made by a command."""
    token = _typed.set(shlex.join(words))
    try:
        yield
    finally:
        _typed.reset(token)


def typed_now() -> dict[str, str]:
    """Return the command that works, by its key; empty where there is none."""
    words = _typed.get()
    return {} if words is None else {COMMAND: words}
