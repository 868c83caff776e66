"""Reading TOML into checked sections; every error is one clear line."""

import difflib
import inspect
import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic.fields import FieldInfo

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_names

Number = Annotated[float, Strict()]
NonNegative = Annotated[float, Strict(), Field(ge=0)]
Positive = Annotated[float, Strict(), Field(gt=0)]
STORED = "stored"  # key of the context of a validation
_WHOLE = 1 << 63
_SHORT = 100
Vector3 = tuple[Number, Number, Number]


class Section(BaseModel):
    """One section of a file: immutable, finite numbers only, unknown keys refused.

    The description of a field states what is valid and completes "it must be ...". The class's
    docstring has it, as "key: description | example in TOML"; `WORDS` are abbreviations in it. A
    section without one must be "a section [key]".
    """

    # validators are built when they are needed: the process of a device needs none
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, defer_build=True)
    WORDS: ClassVar[Mapping[str, str]] = {}

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Set descriptions and examples of the fields from the docstring."""
        for entry in re.split(r"\n(?=\w+: )", inspect.cleandoc(cls.__doc__ or "")):
            key, _, text = " ".join(entry.split()).partition(": ")
            if key in cls.__annotations__ and key in cls.model_fields:
                description, _, example = text.partition(" | ")
                for name, phrase in cls.WORDS.items():
                    description = description.replace(name, phrase)
                field = cls.model_fields[key]
                field.description = description
                field.examples = [tomllib.loads(f"x = {example}")["x"]] if example else None
        for key, field in cls.model_fields.items():
            if field.description is None and section_of(field) is not None:
                field.description = f"a section [{key}]"


S = TypeVar("S", bound=Section)


def load_section(path: Path, section: type[S]) -> S:
    """Read a TOML file as `section`; an InputError names the line, the unknown key or bad value."""
    return check_section(read_toml(path), section, path.name)


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file as a dictionary."""
    try:
        text = limits.read_text(path, limits.SETTINGS, "no such file; expected a TOML file")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not UTF-8 text (byte {error.start}); expected TOML") from None
    for number, line in enumerate(text.split("\n"), start=1):
        if line.count(".") > limits.TOML_DOTS:
            raise InputError(
                f"{path.name}: line {number} has more than {limits.TOML_DOTS} dots; "
                "valid: TOML with sections"
            )
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{path.name}: nested too deeply; valid: TOML with sections") from None
    except tomllib.TOMLDecodeError as error:
        where = f"(at line {max(1, len(text.splitlines()))}, end of document)"
        message = str(error).replace("(at end of document)", where)
        raise InputError(f"{path.name}: TOML syntax error: {message}") from None
    except ValueError as error:  # an integer of thousands of digits
        raise InputError(f"{path.name}: not TOML: {error}") from None
    _check_whole(data, path.name)
    return data


def _check_whole(data: dict[str, Any], where: str) -> None:
    """Refuse integers of more than 64 bits, which Python reads from hexadecimal digits."""
    pending: list[Any] = [data]
    while pending:
        inner = pending.pop()
        if isinstance(inner, int) and not -_WHOLE <= inner < _WHOLE:
            raise InputError(f"{where}: a whole number of {inner.bit_length()} bits; valid: of 64")
        pending += (
            inner.values() if isinstance(inner, dict) else inner if isinstance(inner, list) else ()
        )


def check_section(data: object, section: type[S], where: str, stored: bool = False) -> S:
    """Check a dictionary against `section`; `where` names its origin in InputErrors of one line.

    A `stored` document was checked when it was written: checks that were added since do not apply.
    """
    check_names(data, where)
    try:
        return section.model_validate(data, context={STORED: stored})
    except ValidationError as error:
        raise InputError(f"{where}: {_message(error, section)}") from None


def check_json(text: str, section: type[S], where: str) -> S:
    """Check a stored JSON document; InputErrors as of `read_json`, and of its keys."""
    return check_section(read_json(text, where), section, where, stored=True)


def read_json(text: str, where: str) -> Any:
    """Return the content of a JSON document; InputError if invalid, too deep or too large."""
    try:
        return parse_json(text)
    except json.JSONDecodeError as error:
        raise InputError(f"{where}: not JSON: {error.msg} (line {error.lineno})") from None
    except ValueError as error:
        raise InputError(f"{where}: not JSON: {error}") from None


def parse_json(text: str) -> Any:
    """Return the content of a JSON text; a ValueError for an invalid, too deep or too large one."""
    if sum(map(text.count, ",:[{")) > limits.VALUES:
        raise ValueError(f"more than {limits.VALUES / 1e6:.0f} million values")
    try:
        return json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError("nested too deeply") from None


def _whole(digits: str) -> int:
    if len(digits) > _SHORT:
        raise ValueError(f"a whole number of {len(digits)} digits")
    return int(digits)


def suggest(name: str, valid: Sequence[str]) -> str:
    """Return ' (did you mean "x"?)' for a close name; long names, which take long, are skipped."""
    near = [v for v in islice(valid, 1000) if len(v) <= _SHORT]
    close = difflib.get_close_matches(name, near, n=1) if len(name) <= _SHORT else ()
    return f' (did you mean "{close[0]}"?)' if close else ""


@dataclass(frozen=True, slots=True)
class _Place:
    """Place of an error: header as `[tool]` or empty, section, key, and element of a vector."""

    header: str
    section: type[Section]
    key: str = ""
    field: FieldInfo | None = None
    element: int | None = None


def _message(error: ValidationError, root: type[Section]) -> str:
    """Return one line for the first error; unknown keys first, since they explain missing ones."""
    first = min(error.errors(include_url=False), key=lambda e: e["type"] != "extra_forbidden")
    kind = first["type"]
    place = _locate(root, first["loc"], inside=kind in ("value_error", "extra_forbidden"))
    if kind == "extra_forbidden":
        unknown, valid = str(first["loc"][-1]), list(place.section.model_fields)
        thing = "key" if place.header else "section or key"
        return (
            f'{place.header or "the file"} has no {thing} "{unknown}"{suggest(unknown, valid)}; '
            f"valid here: {', '.join(valid)}"
        )
    must = place.field.description if place.field is not None else None
    must = f"it must be {must}" if must else first["msg"]
    if kind == "value_error":
        return f"{place.header} {first['ctx']['error']}".strip()
    if kind == "missing" and place.element is None:
        return f'{place.header or "the file"} lacks "{place.key}": {must}'
    complete = place.element is None or kind == "missing"
    element = "" if complete else f", element {place.element}"
    value = _show(first["input"])
    return f"{place.header} {place.key}{element} = {value} is not valid: {must}".strip()


def _locate(root: type[Section], loc: tuple[int | str, ...], *, inside: bool) -> _Place:
    """Return the place of an error from its location, through the sections to the key."""
    place = _Place("", root)
    for i, part in enumerate(loc):
        if isinstance(part, int):  # of an array of sections
            place = replace(place, header=f"[{place.header}] number {part + 1}")
            continue
        field = place.section.model_fields.get(part)
        inner = section_of(field)
        if inner is None:
            numbers = [p + 1 for p in loc[i + 1 :] if isinstance(p, int)]
            return replace(place, key=part, field=field, element=next(iter(numbers), None))
        if i == len(loc) - 1 and not inside:  # the section itself is missing or not a section
            return replace(place, key=part, field=field)
        place = _Place(f"[{part}]", inner)
    return place


def section_of(field: FieldInfo | None) -> type[Section] | None:
    """Return the section class inside a field's annotation, if any."""
    pending: list[Any] = [] if field is None else [field.annotation]
    while pending:
        kind = pending.pop()
        if isinstance(kind, type) and issubclass(kind, Section):
            return kind
        pending.extend(getattr(kind, "__args__", ()))
    return None


def _show(value: object) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else f"{text[:57]}..."
