"""Effects of a user's own, read from a Python file."""

import hashlib
import sys
from contextlib import redirect_stdout
from pathlib import Path
from types import CodeType, ModuleType

from hilcal.effects.added import EffectFile
from hilcal.effects.catalogue import catalogue
from hilcal.effects.check import accepted
from hilcal.effects.guard import place_of
from hilcal.effects.protocol import Effect
from hilcal.errors import InputError


def read_effects(path: Path) -> EffectFile:
    """Run a Python file and return the effects that it defines, checked.

    All classes derived from `Effect` in it, but for those whose name begins with "_".

    Raises:
        InputError: it cannot be read or run, has no effect, or one that cannot be used.
    """
    where, content = str(path), _content(path)
    hashed = hashlib.sha256(content).hexdigest()
    module = ModuleType(f"effects_from_{hashed[:16]}")
    module.__file__ = str(path.absolute())
    code = _compiled(content, module.__file__, where)
    # Dataclasses look for the module that they are in, while they are made.
    sys.modules[module.__name__] = module
    try:
        with redirect_stdout(sys.stderr):  # stdout may be for one JSON document
            exec(code, module.__dict__)  # noqa: S102 - asked for
    except (Exception, SystemExit) as error:
        place = place_of(error, module.__file__, where)
        raise InputError(f"{place}: {type(error).__name__}: {error}") from error
    finally:
        del sys.modules[module.__name__]
    kinds = [kind for kind in vars(module).values() if _is_own(kind, module)]
    if not kinds:
        raise InputError(
            f"{where}: defines no effect, a class derived from hilcal.effects.protocol.Effect; "
            "hilcal effects new NAME writes one to begin with"
        )
    there = dict.fromkeys(catalogue(), "in the catalogue")
    effects = []
    for kind in dict.fromkeys(kinds):
        effect = accepted(kind, where)
        if effect.name in there:
            raise InputError(
                f"{where}: class {kind.__name__}: effect {effect.name} is {there[effect.name]} "
                "already; choose another name"
            )
        there[effect.name] = "in this file"
        effects.append(effect)
    return EffectFile(module.__file__, hashed, tuple(effects))


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; expected a Python file of effects") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def _compiled(content: bytes, name: str, where: str) -> CodeType:
    try:
        return compile(content, name, "exec", dont_inherit=True)
    except (SyntaxError, ValueError) as error:
        line = getattr(error, "lineno", None)
        place = where if line is None else f"{where}, line {line}"
        what = getattr(error, "msg", None) or str(error)
        raise InputError(f"{place}: not Python: {what}") from None


def _is_own(kind: object, module: ModuleType) -> bool:
    """Whether something in a module is an effect that was made there."""
    return (
        isinstance(kind, type)
        and issubclass(kind, Effect)
        and kind.__module__ == module.__name__
        and not kind.__name__.startswith("_")
    )
