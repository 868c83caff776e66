"""A guard around effects that did not come with the program: what fails is named, in one line."""

import functools
import sys
import traceback
from abc import ABCMeta
from collections.abc import Callable
from contextlib import redirect_stdout
from types import FunctionType
from typing import Any, cast, get_args

import numpy as np

from hilcal.effects.protocol import (
    Columns,
    Effect,
    Field,
    LoadChange,
    Parameter,
    Response,
    Situation,
)
from hilcal.errors import HilcalError, InputError
from hilcal.types import Floats


def guarded(kind: type[Effect], where: str) -> type[Effect]:
    """Return the effect with every method that it defines checked while it is used.

    What a method raises becomes an InputError that names the effect, where it is from and the
    line; so do results of a wrong shape, or with numbers that are not finite.
    """
    body: dict[str, object] = {"__module__": kind.__module__, "__doc__": kind.__doc__}
    for base in reversed(kind.__mro__[: kind.__mro__.index(Effect)]):
        for name, member in vars(base).items():
            if not hasattr(Effect, name) or (name.startswith("_") and name != "__init__"):
                continue
            if isinstance(member, FunctionType):
                body[name] = _guard(member, kind.name, where)
            elif isinstance(member, property) and isinstance(member.fget, FunctionType):
                body[name] = property(_guard(member.fget, kind.name, where))
            elif isinstance(member, classmethod) and isinstance(member.__func__, FunctionType):
                body[name] = classmethod(_guard(member.__func__, kind.name, where))
    return cast(type[Effect], ABCMeta(kind.__name__, (kind,), body))


def _guard(method: FunctionType, effect: str, where: str) -> Callable[..., Any]:
    said = method.__name__
    check = _CHECKS.get(said)

    @functools.wraps(method)
    def call(self: Any, *given: Any, **named: Any) -> Any:
        try:
            with redirect_stdout(sys.stderr):  # stdout may be for one JSON document
                found = method(self, *given, **named)
        except HilcalError:
            raise
        except Exception as error:
            place = place_of(error, method.__code__.co_filename, where)
            raise InputError(
                f"{place}: effect {effect}: {said} raises {type(error).__name__}: {error}"
            ) from error
        wrong = None if check is None else check(self, found, *given, *named.values())
        if wrong:
            raise InputError(f"{where}: effect {effect}: {said} {wrong}")
        return found

    return call


def place_of(error: BaseException, filename: str, where: str) -> str:
    """Return `where` with the line of a file in which an exception arose, if it did there."""
    frames = traceback.extract_tb(error.__traceback__)
    lines = [frame.lineno for frame in frames if frame.filename == filename]
    return f"{where}, line {lines[-1]}" if lines else where


def _parameters(effect: Effect, found: object) -> str | None:
    if not isinstance(found, tuple) or not found:
        return f"are {found!r}; expected a tuple of one Parameter or more"
    for p in found:
        if not isinstance(p, Parameter):
            return f"hold {p!r}; expected Parameter(name, unit, scale, meaning)"
        texts = all(isinstance(t, str) for t in (p.name, p.unit, p.meaning))
        if not texts or not p.name:
            return f"hold {p!r}; expected texts as name, unit and meaning"
        scale = p.scale
        if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale < np.inf:
            return f"{p.name}: scale = {scale!r}; expected an ordinary magnitude, more than 0"
    names = [p.name for p in found]
    twice = [name for name in names if names.count(name) > 1]
    return f"hold {twice[0]!r} twice" if twice else None


def _columns(effect: Effect, found: object, s: Situation) -> str | None:
    if not isinstance(found, tuple) or not all(isinstance(c, Columns) for c in found):
        return f"returns {type(found).__name__}; expected a tuple of Columns"
    size, (count, n) = len(effect.parameters), s.angle.shape
    for c in found:
        if c.field not in get_args(Field):
            return f"has the field {c.field!r}; valid: {', '.join(get_args(Field))}"
        wrong = _indices("parameter", c.parameter, size)
        if not wrong and c.field in ("dq", "twist"):
            wrong = _indices("element", c.element, n if c.field == "dq" else n + 1)
            if not wrong and np.shape(c.element) != np.shape(c.parameter):
                wrong = f"has {len(c.element)} elements for {len(c.parameter)} parameters"
        if wrong:
            return wrong
        per = (len(c.parameter),) if c.field in ("dq", "scale") else (len(c.parameter), 6)
        wrong = _array(f"{c.field} values", c.values, ((count, *per), (1, *per)))
        if wrong:
            return wrong
    return None


def _response(
    effect: Effect, found: object, theta: Floats, s: Situation, change: Floats
) -> str | None:
    if not isinstance(found, Response):
        return f"returns {type(found).__name__}; expected a Response"
    per, n = change.shape[:2], s.angle.shape[1]
    wrong = None
    if found.dq is not None:
        wrong = _array("dq", found.dq, ((*per, n),))
    if not wrong and found.twist is not None:
        wrong = _array("twist", found.twist, ((*per, n + 1, 6),))
    return wrong


def _load_change(effect: Effect, found: object, theta: Floats) -> str | None:
    if found is None or isinstance(found, LoadChange):
        return None
    return f"returns {type(found).__name__}; expected a LoadChange or None"


def _wrench_change(effect: Effect, found: object, theta: Floats, s: Situation) -> str | None:
    return None if found is None else _array("wrenches", found, ((len(s.angle), 6),))


def _wrench_columns(effect: Effect, found: object, theta: Floats, s: Situation) -> str | None:
    count, n = s.angle.shape
    shape = (count, len(effect.parameters), n + 1, 6)
    return None if found is None else _array("wrenches", found, (shape,))


def _indices(what: str, found: object, size: int) -> str | None:
    """Say what is wrong with (P,) indices."""
    a = np.asarray(found)
    if a.ndim != 1 or a.dtype.kind not in "iu":
        return f"has {what} = {found!r}; expected an array (P,) of whole numbers"
    if a.size and (a.min() < 0 or a.max() >= size):
        return f"has {what} = {a.tolist()}; valid: 0 to {size - 1}"
    return None


def _array(what: str, found: object, shapes: tuple[tuple[int, ...], ...]) -> str | None:
    """Say what is wrong with an array: its shape, or a number that is not finite."""
    if not isinstance(found, np.ndarray) or found.dtype.kind not in "fiub":
        return f"has {what} of type {type(found).__name__}; expected an array of numbers"
    if found.shape not in shapes:
        expected = " or ".join(str(shape) for shape in dict.fromkeys(shapes))
        return f"has {what} of shape {found.shape}; expected {expected}"
    if not np.isfinite(found).all():
        return f"has {what} that are not finite, first in state {_first(found) + 1}"
    return None


def _first(found: Floats) -> int:
    rows = np.isfinite(found).reshape(len(found), -1).all(axis=1)
    return int(np.argmin(rows))


_CHECKS: dict[str, Callable[..., str | None]] = {
    "parameters": _parameters,
    "columns": _columns,
    "response": _response,
    "load_change": _load_change,
    "wrench_change": _wrench_change,
    "wrench_columns": _wrench_columns,
}
