"""Where an exception arose in an effect that is not hilcal's own, in one line."""

import traceback

from hilcal.effects.protocol import Effect
from hilcal.errors import InputError

_OWN = "hilcal."


def failure_of(error: Exception) -> InputError | None:
    """Return the error of a method of a user's effect as one line; None where it is not one.

    The line names the file, the line in it, the effect, the method that hilcal called, and the
    exception. It is found from the traceback, so that calls of effects need no guard.
    """
    for frame, _ in traceback.walk_tb(error.__traceback__):
        effect = frame.f_locals.get("self", frame.f_locals.get("cls"))
        kind = effect if isinstance(effect, type) else type(effect)
        file = frame.f_code.co_filename
        if issubclass(kind, Effect) and not str(frame.f_globals.get("__name__")).startswith(_OWN):
            return InputError(
                f"{file}{line_in(error, file)}: effect {kind.name}: {frame.f_code.co_name} raises "
                f"{type(error).__name__}: {error}"
            )
    return None


def line_in(error: BaseException, file: str) -> str:
    """Return ", line N" with the last line of a file that an exception passed; "" for none."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == file]
    return f", line {lines[-1]}" if lines else ""
