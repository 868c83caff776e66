"""Errors that a user can act on; each carries the exit code of the command line."""


class HilcalError(Exception):
    """Base of all errors that are reported in one line, without a traceback."""

    exit_code = 1


class InputError(HilcalError):
    """Wrong input: says what is wrong, where, and what would be valid."""

    exit_code = 2


class MissingPackageError(InputError, NotImplementedError):
    """A package is not installed: says how to install it.

    A notebook that shows a value shows its `repr` then, since this is a `NotImplementedError`, too.
    """


class DeviceError(HilcalError):
    """A device failed or did not answer."""

    exit_code = 3


class MovedFileError(DeviceError):
    """A campaign was deleted, replaced or moved while it was open; says where its readings are."""


class CannotAnswerError(HilcalError):
    """The data cannot answer the question; says what to measure."""

    exit_code = 4


class LimitError(HilcalError):
    """A limit that was given is not kept."""

    exit_code = 5


class StoppedError(HilcalError):
    """A person stopped it; says what is safe and how to go on."""

    exit_code = 130
