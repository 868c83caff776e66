"""What an effect of a user's own must be, tried before anything is computed with it."""

import re

from hilcal.effects.guard import guarded
from hilcal.effects.protocol import Effect
from hilcal.effects.trial import COLUMNS, columns_of, try_out
from hilcal.errors import InputError

NAME = re.compile(r"[a-z][a-z0-9_]*")
JOINTS = (6, 7)
"""Arms to try an effect on; it has to do for one of them, since it may be made for it alone."""


def accepted(kind: type[Effect], where: str) -> type[Effect]:
    """Check an effect and return it guarded, see `guarded`.

    Args:
        kind: the class.
        where: what it is from, for messages: a file, or an entry point.

    Raises:
        InputError: one line: where, which class or effect, what is wrong with it.
    """
    if wrong := _class_problem(kind):
        raise InputError(f"{where}: class {kind.__name__} {wrong}")
    effect = guarded(kind, where)
    first: InputError | None = None
    for joints in JOINTS:
        try:
            try_out(effect, joints, f"{where}: effect {effect.name}")
        except InputError as error:
            first = first or error
        else:
            return effect
    assert first is not None  # noqa: S101 - there are arms to try
    raise first


def _class_problem(kind: type[Effect]) -> str | None:
    """Say what is wrong with the attributes of a class."""
    if missing := sorted(getattr(kind, "__abstractmethods__", ())):
        return f"lacks {' and '.join(missing)}"
    given = {key: getattr(kind, key, None) for key in ("name", "summary", "elastic")}
    name, summary = given["name"], given["summary"]
    if not isinstance(name, str) or not NAME.fullmatch(name):
        return f"has name = {name!r}; valid: lower-case letters, digits and _, a letter first"
    if not isinstance(summary, str) or not summary.strip() or "\n" in summary:
        return f"has summary = {summary!r}; valid: the law in one line"
    if not isinstance(given["elastic"], bool):
        return f"has elastic = {given['elastic']!r}; valid: True, False"
    for key, valid in (("needs", COLUMNS), ("option_names", None)):
        found = getattr(kind, key)
        texts = isinstance(found, tuple) and all(isinstance(text, str) for text in found)
        if not texts or (valid is not None and not columns_of(found) <= set(valid)):
            of = "names" if valid is None else f"some of {', '.join(valid)}"
            return f"has {key} = {found!r}; valid: a tuple of {of}"
    return None
