"""Effects of a user's own, from files: part of the catalogue as long as a scope lasts."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

from hilcal.effects.protocol import Effect


@dataclass(frozen=True, slots=True, eq=False)
class EffectFile:
    """A file of effects.

    Attributes:
        path: the file, absolute.
        sha256: hash (hex) of its content.
        effects: the effects that it defines.
    """

    path: str
    sha256: str
    effects: tuple[type[Effect], ...]


_ADDED: ContextVar[tuple[EffectFile, ...]] = ContextVar("files of effects", default=())


def added() -> tuple[EffectFile, ...]:
    """Files whose effects are in the catalogue here."""
    return _ADDED.get()


def file_of(name: str) -> EffectFile | None:
    """Return the file that an effect is from, or None for one that is there without a file."""
    return next((f for f in added() if any(e.name == name for e in f.effects)), None)


def add(file: EffectFile) -> None:
    """Add the effects of a file, until the surrounding scope ends."""
    _ADDED.set((*_ADDED.get(), file))


@contextmanager
def scope(*files: EffectFile) -> Iterator[None]:
    """Let the effects of files, and of all that are added inside, be there inside only."""
    before = _ADDED.set((*_ADDED.get(), *files))
    try:
        yield
    finally:
        _ADDED.reset(before)
