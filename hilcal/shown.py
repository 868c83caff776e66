"""How values show themselves: a few lines at a console, words and tables in a notebook.

What a value says to people is written above it (`hilcal.present`): the library names who writes it,
when asked.
"""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import pandas as pd

MOST_LINES = 15  # lines of a `repr`
WIDTH = 70  # characters of a value in it; longer ones are named by type and size
FEW = 7  # numbers of an array that are written out


class Presenter(Protocol):
    """Writes what values say; `hilcal.presenter` returns it."""

    def html_of(self, value: object) -> str:
        """Return a value as a notebook shows it."""
        ...

    def message(self, of: object) -> str:
        """Return a diagnosis in a sentence."""
        ...

    def frame_of(self, value: object) -> "pd.DataFrame":
        """Return a value as a data frame."""
        ...


def brief(value: Any) -> str:
    """Return a dataclass in at most `MOST_LINES` lines: what its `_brief` says, else its fields."""
    if (of := getattr(value, "_brief", None)) is not None:
        texts = of()
    else:
        texts = {f.name: shortened(getattr(value, f.name)) for f in fields(value) if f.repr}
    lines = [f"  {name}: {text}" for name, text in texts.items()]
    if len(lines) > MOST_LINES - 2:
        left = len(lines) - (MOST_LINES - 3)
        lines = [*lines[: MOST_LINES - 3], f"  ... and {left} more"]
    return "\n".join([f"{type(value).__name__}(", *lines, ")"])


def shortened(value: object) -> str:
    """Return a value in one short line: itself, or its type, name and size."""
    import numpy as np  # not where `hilcal` is only imported

    kind = type(value).__name__
    if isinstance(value, np.ndarray):
        few = value.ndim <= 1 and value.size <= FEW
        return f"array({np.array2string(value, precision=4)})" if few else f"array {value.shape}"
    if isinstance(value, Mapping):
        return f"{kind} of {len(value)}: {_cut(', '.join(map(str, value)))}" if value else "{}"
    if isinstance(value, tuple | list):
        whole = repr(value) if all(isinstance(v, str | int | float) for v in value) else ""
        if value and (not whole or len(whole) > WIDTH):
            return f"{len(value)} of {type(value[0]).__name__}"
        return whole or "()"
    if is_dataclass(value) or len(repr(value)) > WIDTH:
        names = getattr(value, "names", None) or getattr(value, "name", None)
        if isinstance(names, str | tuple) and names:
            return f"{kind}({_cut(names if isinstance(names, str) else ' + '.join(names))})"
        size = f" of {len(value)}" if hasattr(value, "__len__") else ""
        return kind + size
    return repr(value)


def _cut(text: str) -> str:
    return text if len(text) <= WIDTH else text[: WIDTH - 3] + "..."


class Brief:
    """A dataclass whose `repr` is at most `MOST_LINES` lines: its fields, large ones by size."""

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Put `brief` where the decorator `dataclass` would put a complete `repr`."""
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:
            type.__setattr__(cls, "__repr__", brief)


class Shown(Brief):
    """A value that notebooks show in words and tables."""

    __slots__ = ()

    def _repr_html_(self) -> str:
        return presenter().html_of(self)


class Tabular(Brief):
    """A value with a row for each of its parts."""

    __slots__ = ()

    def to_frame(self) -> "pd.DataFrame":
        """Return a pandas data frame, SI, units at the ends of the columns' names.

        Of readings: the columns of the exchange table. Of a fit: a row per reading with its pose,
        load, residual, and residual without its pose. Of a diagnosis: a row per suspect, best
        first. Of a plan: a row per reading in the order of measuring.

        Raises:
            InputError: pandas is not installed.
        """
        return presenter().frame_of(self)


def presenter() -> Presenter:
    """Return who writes what values say; the library is loaded wherever one of its values is."""
    import hilcal

    return hilcal.presenter()
