"""Batches of N states: their layout in memory, and chunks.

Arrays (N, ...) are in Fortran order: the states are the first axis, and memory runs along them.
Every elementwise operation and every `einsum` then works on long contiguous vectors, even for small
matrices. numpy preserves the order; only new arrays have to be created with it. Chunks keep
temporaries in the processor's cache.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import Field, fields, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np

from hilcal.types import Floats

CHUNK = 8200  # states, by timing; powers of two collide in few cache lines
BUDGET = 1 << 20  # numbers in a chunk's largest array, 8 MB; a choice by timing
LEAST_CHUNK = 256  # states, at least: Python's overhead grows with the number of chunks


class Record(Protocol):
    """A dataclass whose fields are arrays over the states, or None."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


R = TypeVar("R", bound=Record)


def empty(*shape: int) -> Floats:
    """Return a new array (N, ...) whose memory runs along the states."""
    return np.empty(shape, order="F")


def zeros(*shape: int) -> Floats:
    """Return a new array (N, ...) of zeros whose memory runs along the states."""
    return np.zeros(shape, order="F")


def along_states(x: Floats) -> Floats:
    """Return x (N, ...) with memory along the states: itself, or a copy."""
    return np.asfortranarray(x)


def chunks(count: int, numbers: int = 0) -> Iterator[slice]:
    """Yield slices that cover `count` states, at least one slice; `numbers` per state."""
    size = CHUNK if numbers == 0 else max(LEAST_CHUNK, min(CHUNK, BUDGET // numbers))
    for start in range(0, max(count, 1), size):
        yield slice(start, min(start + size, count))


def take(record: R, rows: slice, axis: int = 0) -> R:
    """Return the states `rows` of a record whose arrays have the states on `axis`."""
    index = (*(slice(None),) * axis, rows)
    return by_field([record], lambda arrays: arrays[0][index])


def by_field(records: Sequence[R], combine: Callable[[Sequence[Floats]], Floats]) -> R:
    """Combine records array by array, without None; other fields are those of the first record."""
    combined = {}
    for f in fields(records[0]):
        arrays = [a for r in records if isinstance(a := getattr(r, f.name), np.ndarray)]
        if arrays:
            combined[f.name] = combine(arrays)
    return replace(records[0], **combined)
