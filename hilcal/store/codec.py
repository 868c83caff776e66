"""The codec of all stored values: to JSON by their fields, and back by their types.

A dataclass becomes an object of its fields; arrays and tuples become lists; infinite numbers, which
JSON lacks, become the texts "inf" and "-inf". When decoding, a missing field has its default, and
unknown fields are ignored, so that files of older programs can be read.
"""

import base64
import json
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from hilcal import limits
from hilcal.errors import InputError
from hilcal.names import check_names
from hilcal.toml import parse_json
from hilcal.types import Floats
from hilcal.whole_file import replace_file

T = TypeVar("T")
_hints = cache(get_type_hints)
LARGEST = 1e9  # upper bound of all lengths, angles, masses, forces and parameters, in SI units


def encode(value: Any) -> Any:
    """Return a value as JSON."""
    if is_dataclass(value):
        return {f.name: encode(getattr(value, f.name)) for f in fields(value) if f.init}
    if isinstance(value, np.ndarray):
        return encode(value.tolist())
    if isinstance(value, float) and np.isinf(value):
        return str(value)
    if isinstance(value, Mapping):
        return {str(k): encode(v) for k, v in value.items()}
    return [encode(v) for v in value] if isinstance(value, tuple | list) else value


def decode(kind: Any, content: Any) -> Any:
    """Return a value of a type from the JSON of `encode`; raises as Python's conversions do."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):  # of a type and None
        return None if content is None else decode(arguments[0], content)
    if origin is Literal:
        if content not in arguments:
            raise ValueError(f"{content!r} is none of {arguments}")
        return content
    if origin is np.ndarray:
        return np.array(content, dtype=get_args(arguments[1])[0])
    if origin is tuple:
        kinds = arguments[:1] * len(content) if arguments[1:] == (...,) else arguments
        return tuple(decode(k, v) for k, v in zip(kinds, content, strict=True))
    if origin is not None and issubclass(origin, Mapping):
        return {str(k): decode(arguments[1], v) for k, v in content.items()}
    if isinstance(kind, type) and is_dataclass(kind):
        hints = _hints(kind)
        required = {f.name for f in fields(kind) if f.default is f.default_factory is MISSING}
        names = [f.name for f in fields(kind) if f.init and f.name in {*content, *required}]
        return kind(**{name: decode(hints[name], content[name]) for name in names})
    if kind is float:
        return float(content)
    if kind in (str, int, bool) and type(content) is not kind:
        raise TypeError(f"{content!r} is no {kind.__name__}")
    return content


def numbers(
    name: str, values: object, shape: Sequence[int] = (), *, minimum: float = -LARGEST
) -> Floats:
    """Return numbers as an array; a ValueError for another shape, or a number out of range."""
    array = np.asarray(values, dtype=float)
    if array.shape != tuple(shape):
        raise ValueError(f"{name} has shape {array.shape}; expected {tuple(shape)}")
    if not np.all((array >= minimum) & (array <= LARGEST)):
        raise ValueError(f"{name} has a number that is out of range")
    return array


def frames(name: str, values: object, *, several: bool = False) -> Floats:
    """Return a frame (4, 4), or K frames; a ValueError if a matrix is not a frame."""
    array = np.asarray(values, dtype=float)
    numbers(name, array, (*array.shape[:several], 4, 4))
    turn = array[..., :3, :3]
    orthonormal = np.allclose(turn @ np.swapaxes(turn, -1, -2), np.eye(3), atol=1e-6)
    rotation = orthonormal and np.all(np.linalg.det(turn) > 0.0)
    if not rotation or np.any(array[..., 3, :] != [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"{name} is not a homogeneous matrix of a rotation and a translation")
    return array


def pack(values: Floats) -> str:
    """Return numbers as base64 of their little-endian doubles, without rounding."""
    return base64.b64encode(np.ascontiguousarray(values, dtype="<f8").tobytes()).decode("ascii")


def unpack(text: str) -> Floats:
    """Return the numbers (N,) that `pack` wrote."""
    return np.frombuffer(base64.b64decode(text), dtype="<f8").astype(float)


def write_document(path: Path, content: Mapping[str, object], indent: int | None = None) -> None:
    """Write a document to a JSON file."""
    replace_file(path, json.dumps(content, indent=indent, allow_nan=False) + "\n")


def read_document(
    content: object, name: str, form: str, versions: tuple[int, ...], read: Callable[[Any], T]
) -> T:
    """Return what `read` makes of a document; an InputError for another format or version."""
    if not isinstance(content, dict) or content.get("format") != form:
        raise InputError(f'no {name}; valid: a JSON document with "format": "{form}"')
    if content.get("version") not in versions:
        readable = "version" + "s" * (len(versions) > 1) + " " + " and ".join(map(str, versions))
        raise InputError(
            f"a {name} of version {content.get('version')}, written by hilcal "
            f"{content.get('hilcal')}; this program reads {readable}"
        )
    check_names({k: v for k, v in content.items() if k != "source"}, name)
    try:
        return read(content)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
        raise InputError(f"a damaged {name}: {error!r}") from None


@limits.bounded
def read_file(path: Path, name: str, read: Callable[[Any], T]) -> T:
    """Return the value that `read` makes of a JSON file's content."""
    try:
        missing = f"no such file; expected a {name}"
        content = parse_json(limits.read_text(path, limits.DOCUMENT, missing))
    except json.JSONDecodeError as error:
        raise InputError(f"{path}: no {name}: it is no JSON from line {error.lineno} on") from None
    except ValueError as error:
        raise InputError(f"{path}: no {name}: {error}") from None
    try:
        return read(content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
