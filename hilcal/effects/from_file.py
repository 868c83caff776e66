"""Effects of a user's own, read from a Python file."""

import hashlib
import sys
import traceback
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from types import CodeType, ModuleType

from hilcal import limits
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError


def failure_of(error: Exception) -> InputError | None:
    """Return an error raised in a user's effect as one line, by its traceback; None for others."""
    for frame, _ in traceback.walk_tb(error.__traceback__):
        effect = frame.f_locals.get("self", frame.f_locals.get("cls"))
        kind = effect if isinstance(effect, type) else type(effect)
        file = frame.f_code.co_filename
        module = str(frame.f_globals.get("__name__"))
        if issubclass(kind, Effect) and not module.startswith("hilcal."):
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


@dataclass(frozen=True, slots=True, eq=False)
class EffectFile:
    """A file of effects."""

    path: str  # the file, absolute
    sha256: str  # hash (hex) of its content
    effects: tuple[type[Effect], ...]  # the effects that it defines


def read_effects(path: Path) -> EffectFile:
    """Run a Python file and return the effects in it; names that begin with "_" do not count."""
    return effects_of(_content(path), path)


def effects_of(content: bytes, path: Path) -> EffectFile:
    """Return the effects in the content of a file, see `read_effects`; it need not exist yet."""
    where = str(path)
    hashed = hashlib.sha256(content).hexdigest()
    module = ModuleType(f"effects_from_{hashed[:16]}")
    module.__file__ = str(path.absolute())
    code = _compiled(content, where)
    # Dataclasses look up the module that they are defined in.
    sys.modules[module.__name__] = module
    try:
        with redirect_stdout(sys.stderr):  # stdout may be for one JSON document
            exec(code, module.__dict__)  # noqa: S102 - a file that the user named
    except (Exception, SystemExit) as error:
        line = line_in(error, where)
        raise InputError(f"{where}{line}: {type(error).__name__}: {error}") from error
    finally:
        del sys.modules[module.__name__]
    effects = dict.fromkeys(
        kind
        for kind in vars(module).values()
        if isinstance(kind, type)
        and issubclass(kind, Effect)
        and kind.__module__ == module.__name__
        and not kind.__name__.startswith("_")
    )
    if not effects:
        raise InputError(
            f"{where}: defines no effect, a class derived from hilcal.effects.protocol.Effect; "
            "hilcal effects new NAME writes one to begin with"
        )
    return EffectFile(module.__file__, hashed, tuple(effects))


def _content(path: Path) -> bytes:
    try:
        return limits.read_bytes(path, limits.PROGRAM)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a Python file of effects") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _compiled(content: bytes, where: str) -> CodeType:
    try:
        return compile(content, where, "exec", dont_inherit=True)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        line = getattr(error, "lineno", None)
        place = where if line is None else f"{where}, line {line}"
        reason = getattr(error, "msg", None) or str(error)
        raise InputError(f"{place}: not Python: {reason}") from None
