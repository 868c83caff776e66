"""Errors that a user can act on; each carries the exit code of the command line."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager


class HilcalError(Exception):
    """Base of all errors that are reported in one line, without a traceback."""

    exit_code = 1


class InputError(HilcalError):
    """Wrong input; the message states what is wrong, where, and what is valid."""

    exit_code = 2


class MissingPackageError(InputError, NotImplementedError):
    """A package is not installed; the message states how to install it.

    It is a `NotImplementedError` so that notebooks show the `repr` of a value instead.
    """


class DeviceError(HilcalError):
    """A device failed or did not answer."""

    exit_code = 3


class MovedFileError(DeviceError):
    """An open campaign was deleted, replaced or moved; the message states where readings are."""


class CannotAnswerError(HilcalError):
    """The data cannot answer the question; the message states what to measure."""

    exit_code = 4


class LimitError(HilcalError):
    """A stated limit is exceeded."""

    exit_code = 5


class StoppedError(HilcalError):
    """A person stopped the program; the message states what is stored and how to resume."""

    exit_code = 130


@contextmanager
def undone_by(undo: Callable[[], object]) -> Iterator[None]:
    """Call `undo` where the block fails, an interrupt included, and raise the error."""
    try:
        yield
    except BaseException:
        undo()
        raise


def expect(value: object, classes: type | tuple[type, ...], name: str, valid: str) -> None:
    """Refuse an argument of another class, in words for the author of a script."""
    if not isinstance(value, classes):
        given = "None" if value is None else f"of class {type(value).__name__}"
        raise InputError(f"{name} is {given}; valid: {valid}")
