"""Display of values: a few lines at a console, text and tables in a notebook."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pandas as pd

MOST_LINES = 15  # lines of a `repr`
WIDTH = 70  # characters of a value in a `repr`; longer values are named by type and size
MOST_WRITTEN = 7  # numbers of an array that are written out


def brief(value: Any) -> str:
    """Return a dataclass in at most `MOST_LINES` lines: by its `_brief`, else by its fields."""
    lines = [f"  {name}: {text}" for name, text in texts_of(value).items()]
    if (hidden := len(lines) - (MOST_LINES - 3)) > 1:
        lines = [*lines[: MOST_LINES - 3], f"  ... and {hidden} more"]
    return "\n".join([f"{type(value).__name__}(", *lines, ")"])


def texts_of(value: Any) -> dict[str, str]:
    """Return what `brief` shows of a dataclass, by name."""
    if (describe := getattr(value, "_brief", None)) is not None:
        return dict(describe())
    return {f.name: shortened(getattr(value, f.name)) for f in fields(value) if f.repr}


def shortened(value: object) -> str:
    """Return a value in one short line: itself, or its type, name and size."""
    import numpy as np  # not at `import hilcal`

    kind = type(value).__name__
    if isinstance(value, np.ndarray):
        few = value.ndim <= 1 and value.size <= MOST_WRITTEN
        return f"array({np.array2string(value, precision=4)})" if few else f"array {value.shape}"
    if isinstance(value, Mapping):
        return f"{kind} of {len(value)}: {_cut(', '.join(map(str, value)))}" if value else "{}"
    if isinstance(value, tuple | list):
        text = repr(value) if all(isinstance(v, str | int | float) for v in value) else ""
        if value and (not text or len(text) > WIDTH):
            return f"{len(value)} of {type(value[0]).__name__}"
        return text or "()"
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
    """A dataclass whose `repr` is at most `MOST_LINES` lines: its fields, large ones by size.

    Notebooks show results as their reports, other values as a table of the same lines.
    """

    __slots__ = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Set `brief` as `repr`, so that the decorator `dataclass` makes none."""
        super().__init_subclass__(**options)
        if "__repr__" not in cls.__dict__:
            type.__setattr__(cls, "__repr__", brief)

    def _repr_html_(self) -> str:
        return str(presenter("notebook").html_of(self))


class Tabular(Brief):
    """A value with a row for each of its parts."""

    __slots__ = ()

    def to_frame(self) -> "pd.DataFrame":
        """Return a pandas data frame in SI units, with the unit at the end of a column's name.

        Readings have the columns of the exchange table. A fit has a row per reading with pose,
        load, residual, and residual of the fit without the pose. A diagnosis has a row per suspect,
        best first. A plan has a row per reading in the order of measuring. A compensation has a row
        per point: corrected joint values, and errors before and after.
        """
        frame: pd.DataFrame = presenter("notebook").frame_of(self)
        return frame


def presenter(module: str) -> Any:
    """Import a module of `hilcal.present`, a higher layer, when its texts are needed."""
    return import_module(f"hilcal.present.{module}")
